"""Training with Lightning: L1 on normalised ranges, rays at continuous directions (paper, Sec. III-B)."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import ModelCheckpoint, TQDMProgressBar
from lightning.pytorch.loggers import CSVLogger
from torch.utils.data import DataLoader

from ilnet import data, metrics, models, simulate
from ilnet.scan import Scan
from ilnet.sensor import preset

__all__ = ["PRESETS", "Preset", "Training", "train"]

INPUT = "paper-16x1024"
OUTPUT = "paper-64x1024"
TOWN = "town01"
# Towns that differ by their seed: streets to learn from, and one to choose by. Seed 0, the default, is left for tests.
TRAIN_SEEDS = (1, 2, 3, 4)
HELD_OUT_SEED = 5
HELD_OUT_SCANS = 8
# Steps.
VALIDATE_EVERY = 200
CHECKPOINT_EVERY = 100


@dataclass(frozen=True)
class Preset:
    """The size of a network and of its training."""

    blocks: int
    """Residual blocks of the encoder."""
    steps: int
    """Optimiser steps."""
    rate: float
    """Highest learning rate; it rises over the first steps and falls to 0 as a cosine."""
    crops: int = 16
    """Crops in a step."""
    columns: int = 128
    """Columns of a crop."""
    queries: int = 2048
    """Rays per crop."""
    dropout: float = 0.0
    """In the attention blocks."""

    def arguments(self, name: str) -> dict[str, Any]:
        """What differs from the own defaults of the model called `name`."""
        return {"blocks": self.blocks} | ({} if name == "liif" else {"dropout": self.dropout})


PRESETS = {"tiny": Preset(blocks=4, steps=150, rate=1e-3)}


class Training(lightning.LightningModule):
    """One network, its loss, its schedule and its validation.

    Args:
        model: What is trained; it has a `norm_range`.
        held_out: Pairs of an input scan and the scan to be predicted.
        rate: Highest learning rate.
        run: What tells this run from others; kept in its checkpoints.
    """

    def __init__(self, model: models.ILN | models.LIIF, held_out: list[list[Scan]], rate: float, run: dict[str, Any]):
        super().__init__()
        self.model, self.held_out, self.rate, self.run = model, held_out, rate, run

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Lets `train` refuse to go on with a run of another kind."""
        checkpoint["run"] = self.run

    def training_step(self, batch: data.Batch, index: int) -> torch.Tensor:
        """L1 between ranges scaled to [-1, 1]."""
        predicted = self.model(batch.image, batch.queries, wrap=batch.wrap)
        loss = (predicted - batch.ranges).abs().mean() * (2 / self.model.norm_range)
        self.log("loss", loss, prog_bar=True)
        return loss

    def validation_step(self, number: int, index: int) -> None:
        """Measures one held-out scan."""
        scan, truth = self.held_out[number]
        for name, value in metrics.compare(self.model.ranges(scan, truth.sensor).float(), truth).items():
            self.log(f"val/{name}", value, prog_bar=name in ("mae", "iou"), batch_size=1)

    def configure_optimizers(self) -> Any:
        """Adam; the rate warms up and decays to 0."""
        optimizer = torch.optim.Adam(self.parameters(), lr=self.rate)
        steps = int(self.trainer.estimated_stepping_batches)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, self.rate, steps, pct_start=min(0.3, 100 / steps))
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


def train(
    name: str, preset_name: str, out: Path, steps: int | None = None, seed: int = 0, **arguments: Any
) -> dict[str, float]:
    """Trains a model and writes its weights and figures; goes on where an interrupted run in `out` stopped.

    Args:
        name: One of `models.TRAINABLE`.
        preset_name: One of `PRESETS`.
        out: Folder for `NAME.safetensors`, and below `NAME/` the checkpoint of an unfinished run and the figures of
            each start, `from-step-N/metrics.csv`.
        steps: Overrides the preset's.
        seed: Of the initial weights and the rays, 0 or more.
        **arguments: Override the model's.

    Returns:
        The figures of the final weights on held-out scans.

    Raises:
        ValueError: If there is no such model or preset, or `out` holds an interrupted run of another kind.
    """
    if preset_name not in PRESETS:
        raise ValueError(f"unknown preset {preset_name!r}; known are {', '.join(PRESETS)}")
    if name not in models.TRAINABLE:
        raise ValueError(f"model {name!r} cannot be trained; these can: {', '.join(models.TRAINABLE)}")
    size = PRESETS[preset_name]
    steps = size.steps if steps is None else steps
    arguments = {**size.arguments(name), **arguments}
    run = {"preset": preset_name, "steps": steps, "seed": seed, **arguments}
    last = out / name / "last.ckpt"
    start = _steps_done(last, run)

    device = simulate.best_device()
    lightning.seed_everything(seed, verbose=False)
    model = models.create(name, **arguments)
    assert isinstance(model, models.ILN | models.LIIF)
    streets = [data.street(TOWN, s, device) for s in TRAIN_SEEDS]
    rays = data.ContinuousRays(streets, preset(INPUT), size.crops, size.columns, size.queries, seed, start)
    held_out = data.held_out_scans(
        data.street(TOWN, HELD_OUT_SEED, device), HELD_OUT_SCANS, [preset(INPUT), preset(OUTPUT)]
    )
    training = Training(model, held_out, size.rate, run)
    scans: DataLoader[int] = DataLoader(range(len(held_out)), batch_size=None)  # type: ignore[arg-type]
    trainer = lightning.Trainer(
        max_steps=steps,
        precision="bf16-mixed",
        accelerator=device.type,
        devices=1,
        val_check_interval=VALIDATE_EVERY,
        num_sanity_val_steps=0,
        log_every_n_steps=10,
        logger=CSVLogger(out, name=name, version=f"from-step-{start}"),
        callbacks=[
            ModelCheckpoint(last.parent, last.stem, every_n_train_steps=CHECKPOINT_EVERY, enable_version_counter=False),
            TQDMProgressBar(),
        ],
        enable_model_summary=False,
    )
    trainer.fit(training, DataLoader(rays, batch_size=None), scans, ckpt_path=last if start else None)
    if trainer.interrupted:
        raise KeyboardInterrupt
    figures = {key: round(value, 4) for key, value in trainer.validate(training, scans, verbose=False)[0].items()}
    models.save(model, out / f"{name}.safetensors", name, arguments, **run, held_out=figures)
    last.unlink(missing_ok=True)
    return figures


def _steps_done(checkpoint: Path, run: dict[str, Any]) -> int:
    """How far the interrupted run behind a checkpoint came; 0 where there is none. ValueError if it is not `run`."""
    if not checkpoint.exists():
        return 0
    state = torch.load(checkpoint, weights_only=True, map_location="cpu")
    if state["run"] != run:
        raise ValueError(
            f"{checkpoint} is an interrupted run of {state['run']}, not of {run}: "
            "go on with that one, delete the file, or choose another --out"
        )
    return state["global_step"]

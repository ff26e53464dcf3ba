"""Training with Lightning: L1 on normalised ranges (paper, Sec. III-B).

What is learned from are rays cast at continuous directions while training goes on, or, as in the paper, the pixels of
images stored on disk. Under `torchrun` several processes share each batch.
"""

import atexit
import math
import multiprocessing
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import Checkpoint, ModelCheckpoint, TQDMProgressBar
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from torch import nn
from torch.utils.data import DataLoader

from ilnet import data, models
from ilnet.learning import metrics
from ilnet.scan import Pair
from ilnet.sensor import PAPER_INPUT, PAPER_TARGET, format_size, preset
from ilnet.world import places, simulate, towns

__all__ = ["PRESETS", "Preset", "Training", "train"]

# What the best weights predict best.
VALIDATION = preset("paper-64x1024")
# What the best weights are chosen by: scans of towns that no training sees. (Seed 0, the default, is that of training.)
HELD_OUT = {"town01": 1, "town03": 1, "town05": 1}
HELD_OUT_SCANS = 4
PRECISION: Any = "bf16-mixed"
# Validations in a training, and the fewest and most steps between them.
VALIDATIONS = 20
VALIDATE_EVERY = 50, 2000
# Steps.
CHECKPOINT_EVERY = 100


@dataclass(frozen=True)
class Preset:
    """The size of a network and of its training."""

    steps: int = 0
    """Optimiser steps; 0 where `epochs` tells them."""
    epochs: int = 0
    """How often each stored scan is seen; 0 where `steps` tells it."""
    halve_after: tuple[int, ...] = ()
    """Epochs after which the learning rate is halved. Where empty, it rises over the first steps and falls to 0 as a
    cosine."""
    rate: float = 1e-3
    """Highest learning rate."""
    blocks: int = 16
    """Residual blocks of the encoder."""
    crops: int = 8
    """Crops in a step."""
    columns: int = 64
    """Columns of a crop."""
    queries: int = 1024
    """Rays per crop."""
    dropout: float = 0.0
    """In the attention blocks."""
    towns: tuple[str, ...] = towns.TRAIN
    """Where continuous rays are cast."""

    def arguments(self, name: str) -> dict[str, Any]:
        """What differs from the own defaults of the model called `name`."""
        own: dict[str, dict[str, Any]] = {"liif": {"blocks": self.blocks}, "lidar-sr": {}}
        return own.get(name, {"blocks": self.blocks, "dropout": self.dropout})


PRESETS = {
    # As the authors' code does it, on stored images; days on a GPU.
    "paper": Preset(
        epochs=1000, halve_after=(200, 400, 600, 800), rate=1e-4, crops=16, columns=1024, queries=16_384, dropout=0.1
    ),
    # Full-size networks: an hour and a half, and ten minutes, on two cores; LIIF takes half as long again. Many small
    # steps get further in that time than few large ones.
    "laptop": Preset(steps=20_000),
    "small": Preset(steps=2000),
    # A minute or two, for the course.
    "tiny": Preset(steps=400, blocks=4, towns=("town01", "town02")),
}


class Training(lightning.LightningModule):
    """One network, its loss, its schedule and its validation.

    Args:
        model: What is trained; it has a `norm_range`.
        held_out: Pairs of an input scan and the scan to be predicted.
        probe: More such pairs, whose figures are logged and decide nothing.
        rate: Highest learning rate.
        halve_after: Steps after which the rate is halved; where empty, it follows one cycle.
        run: What tells this run from others; kept in its checkpoints.
    """

    def __init__(
        self,
        model: models.Model,
        held_out: Sequence[Pair],
        rate: float,
        halve_after: Sequence[int] = (),
        run: dict[str, Any] | None = None,
        probe: Sequence[Pair] = (),
    ):
        super().__init__()
        self.model, self.rate, self.halve_after, self.run = model, rate, halve_after, run
        self.pairs = {"val": held_out, "test": probe}
        self.figures = nn.ModuleDict({kind: metrics.ScanMetrics() for kind, pairs in self.pairs.items() if pairs})
        self.begun = time.monotonic()

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Lets `train` refuse to go on with a run of another kind, and count its time."""
        checkpoint["run"], checkpoint["seconds"] = self.run, time.monotonic() - self.begun

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Counts the time of the run that goes on."""
        self.begun = time.monotonic() - checkpoint["seconds"]

    def training_step(self, batch: data.Batch, index: int) -> torch.Tensor:
        """L1 between ranges scaled to [-1, 1]."""
        predicted = self.model(batch.image, batch.queries, wrap=batch.wrap)
        loss = (predicted - batch.ranges).abs().mean() * (2 / self.model.norm_range)
        if not loss.isfinite():
            file = Path(self.trainer.default_root_dir) / f"step-{self.global_step}.pt"
            torch.save({"batch": batch._asdict(), "model": self.model.state_dict()}, file)
            raise ValueError(f"the loss of step {self.global_step} is {loss}; its batch and the weights are in {file}")
        self.log("loss", loss, prog_bar=True)
        return loss

    def validation_step(self, place: tuple[str, int], index: int) -> None:
        """Measures one scan: of which kind, and its number."""
        kind, number = place
        scan, truth = self.pairs[kind][number]
        with torch.autocast(self.device.type, enabled=False):  # as `evaluate` measures
            self.figures[kind].update(self.model.ranges(scan, truth.sensor), truth)  # type: ignore[operator]

    def on_validation_epoch_end(self) -> None:
        """Logs the means over all scans of all processes."""
        training = self.trainer.state.fn == "fit"  # and not the last word on the weights that were chosen
        self.log("seconds", time.monotonic() - self.begun, logger=training)
        for kind, figures in self.figures.items():
            for name, value in figures.compute().items():  # type: ignore[operator]
                shown = kind == "val" and name in ("mae", "iou")
                self.log(f"{kind}/{name}", value.float(), prog_bar=shown, logger=training)
            figures.reset()  # type: ignore[operator]

    def configure_optimizers(self) -> Any:
        """Adam; the rate warms up and decays to 0, or is halved now and then."""
        # While the head of a network with a prior is next to zero, so are the gradients of its encoder: Adam would blow
        # up their noise, and the features with it, were its eps not above them.
        optimizer = torch.optim.Adam(self.parameters(), lr=self.rate, eps=1e-6)
        steps = int(self.trainer.estimated_stepping_batches)
        schedule: torch.optim.lr_scheduler.LRScheduler
        if self.halve_after:
            schedule = torch.optim.lr_scheduler.MultiStepLR(optimizer, list(self.halve_after), 0.5)
        else:
            schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, self.rate, steps, pct_start=min(0.3, 100 / steps))
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


def train(
    name: str,
    preset_name: str,
    out: Path,
    steps: int | None = None,
    seed: int = 0,
    archive: Path | None = None,
    target: tuple[int, int] = PAPER_TARGET.shape,
    probe: Sequence[Pair] = (),
    **arguments: Any,
) -> dict[str, float]:
    """Trains a model and writes its weights and figures; goes on where an interrupted run in `out` stopped.

    Started by `torchrun`, all its processes share each batch, and the result is that of one process but for rounding.

    Args:
        name: One of `models.TRAINABLE`.
        preset_name: One of `PRESETS`.
        out: Folder for `NAME.safetensors`, and below `NAME/` the checkpoints of an unfinished run and the logs of each
            start, `from-step-N/` with metrics.csv and what TensorBoard reads.
        steps: Overrides the preset's.
        seed: Of the initial weights and the rays, 0 or more.
        archive: Stored images to learn from instead of continuous rays; see `data.open_archive`. LiDAR-SR has no other
            way to learn.
        target: Size (rows, columns) of the stored images to learn from; the one that LiDAR-SR predicts, of which it
            learns all pixels in sectors of scans.
        probe: Pairs of an input scan and the scan to be predicted, whose figures are logged as `test/...` and decide
            nothing.
        **arguments: Override the model's.

    Returns:
        The figures on held-out scans of the weights that were best there.

    Raises:
        ValueError: If there is no such model or preset, images are missing or of a size that does not fit, `out` holds
            an interrupted run of another kind, or the loss is not a number.
    """
    if preset_name not in PRESETS:
        raise ValueError(f"unknown preset {preset_name!r}; known are {', '.join(PRESETS)}")
    if name not in models.TRAINABLE:
        raise ValueError(f"model {name!r} cannot be trained; these can: {', '.join(models.TRAINABLE)}")
    size = PRESETS[preset_name]
    source = PAPER_INPUT.shape
    if archive is None and (size.epochs or name == "lidar-sr"):
        raise ValueError(
            f"{name} with preset {preset_name} learns from stored images: make some with `python -m ilnet simulate "
            f"--sizes {format_size(source)},{format_size(target)} --out DIR`, and name them with --data DIR"
        )
    if name == "lidar-sr":
        if target[0] % source[0] or target[1] % source[1]:
            raise ValueError(
                f"size is {format_size(target)}; for lidar-sr it should be a multiple of {format_size(source)}"
            )
        arguments = {"rows": target[0] // source[0], "columns": target[1] // source[1], **arguments}
    stored = None if archive is None else data.open_archive(archive)
    per_epoch = -(-len(stored) // size.crops) if stored else 0
    steps = steps or size.steps or size.epochs * per_epoch
    arguments = {**size.arguments(name), **arguments}
    learns_from = f"{format_size(target)} of {archive}" if archive else "continuous rays"
    run = {"preset": preset_name, "steps": steps, "seed": seed, "data": learns_from, **arguments}
    folder = out / name
    start = _steps_done(folder / "last.ckpt", run)

    device = simulate.best_device()
    number, processes = int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1))
    lightning.seed_everything(seed, verbose=False)
    model = models.create(name, **arguments)
    samples = _samples(name, size, stored, target, seed, start, (number, processes), device)
    output = PAPER_INPUT.resize(*target) if name == "lidar-sr" else VALIDATION
    held_out: list[Pair] = [
        (pair[0], pair[1])
        for town, held_out_seed in HELD_OUT.items()
        for pair in places.held_out_scans(
            places.town(town, held_out_seed, device), HELD_OUT_SCANS, [PAPER_INPUT, output]
        )
    ]
    training = Training(model, held_out, size.rate, [epoch * per_epoch for epoch in size.halve_after], run, probe)
    numbered = [
        (kind, place) for kind, pairs in training.pairs.items() for place in range(number, len(pairs), processes)
    ]
    scans: DataLoader[tuple[str, int]] = DataLoader(numbered, batch_size=None)  # type: ignore[arg-type]
    best = ModelCheckpoint(folder, "best", monitor="val/iou", mode="max", enable_version_counter=False)
    trainer = lightning.Trainer(
        max_steps=steps,
        precision=PRECISION,
        accelerator=device.type,
        **_processes(processes),
        use_distributed_sampler=False,
        val_check_interval=min(max(VALIDATE_EVERY[0], steps // VALIDATIONS), VALIDATE_EVERY[1], steps),
        num_sanity_val_steps=0,
        log_every_n_steps=10,
        default_root_dir=folder,
        logger=[kind(out, name=name, version=f"from-step-{start}") for kind in (CSVLogger, TensorBoardLogger)],
        callbacks=[best, _Last(folder / "last.ckpt"), TQDMProgressBar()],
        enable_model_summary=False,
    )
    batches = DataLoader(samples, batch_size=None, **_workers(device))
    trainer.fit(training, batches, scans, ckpt_path=folder / "last.ckpt" if start else None)
    if trainer.interrupted:
        raise KeyboardInterrupt
    figures = _validate(trainer, training, scans)
    if best.best_model_score is not None and best.best_model_score > figures["val/iou"]:
        state = torch.load(best.best_model_path, weights_only=True, map_location="cpu")
        training.load_state_dict(state["state_dict"])
        figures = _validate(trainer, training, scans)
    if trainer.is_global_zero:
        models.save(model, out / f"{name}.safetensors", name, arguments, **run, held_out=figures)
        for file in folder.glob("*.ckpt"):
            file.unlink()
    return figures


class _Last(Checkpoint):
    """Keeps what an interrupted run goes on from: every so many steps, and after each validation.

    Never between a step and its validation, which the run that goes on would leave out. Being a `Checkpoint`, it is
    called behind the one that keeps the best, and so remembers how good that was.
    """

    def __init__(self, file: Path):
        self.file = file

    def on_train_batch_end(self, trainer: lightning.Trainer, *_: Any) -> None:
        step = trainer.global_step
        if step % CHECKPOINT_EVERY == 0 and step % trainer.val_check_interval:
            trainer.save_checkpoint(self.file)

    def on_validation_end(self, trainer: lightning.Trainer, *_: Any) -> None:
        if trainer.state.fn == "fit":
            trainer.save_checkpoint(self.file)


def _samples(
    name: str,
    size: Preset,
    stored: data.Archive | data.RangeImageTree | None,
    target: tuple[int, int],
    seed: int,
    start: int,
    part: tuple[int, int],
    device: torch.device,
) -> data.ContinuousRays | data.StoredImages:
    if stored is None:
        streets = [places.town(town, 0, device) for town in size.towns]
        return data.ContinuousRays(streets, PAPER_INPUT, size.crops, size.columns, size.queries, seed, start, part)
    source = PAPER_INPUT.shape
    if name == "lidar-sr":
        # It learns from all that it predicts: of as many scans, since its batch norm fails with one, but half as wide.
        scans, sector = size.crops, source[1] if size.epochs else size.columns // 2
        queries = math.prod(target) * sector // source[1]
    else:  # as many columns and as many queries as the crops have, in whole scans
        scans, sector = max(1, size.crops * size.columns // source[1]), None
        queries = size.crops * size.queries // scans
    return data.StoredImages(
        stored, format_size(source), format_size(target), scans, queries, seed, start, part, sector
    )


def _workers(device: torch.device) -> dict[str, Any]:
    """Who makes batches: a process beside the training, where there are cores to spare for it."""
    # On two cores it takes more than it gives: a batch is drawn in a sixth of the time of a step.
    spare = device.type == "cpu" and torch.get_num_threads() > 2 and "fork" in multiprocessing.get_all_start_methods()
    return {"num_workers": 1, "multiprocessing_context": "fork"} if spare else {}


def _processes(number: int) -> dict[str, Any]:
    """How Lightning is told of the processes that `torchrun` started."""
    if number == 1:
        return {"devices": 1}
    # Lightning leaves a group of CPU processes open, whose threads now and then abort the interpreter on its way out.
    atexit.unregister(_close_group)
    atexit.register(_close_group)
    here = int(os.environ["LOCAL_WORLD_SIZE"])
    return {"strategy": "ddp", "devices": here, "num_nodes": number // here}


def _close_group() -> None:
    if torch.distributed.is_initialized():
        torch.distributed.destroy_process_group()


def _validate(trainer: lightning.Trainer, training: Training, scans: DataLoader[tuple[str, int]]) -> dict[str, float]:
    trainer.validate(training, scans, verbose=False)
    found = trainer.callback_metrics
    return {key: round(float(value), 4) for key, value in found.items() if key.partition("/")[0] in training.pairs}


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

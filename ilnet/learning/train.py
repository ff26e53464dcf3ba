"""Training with Lightning: the loss of each model, by default L1 on normalised ranges (paper, Sec. III-B).

A network learns from rays that are cast at continuous directions while it trains or, as in the paper, from pixels of
images stored on disk. Under `torchrun` several processes share each batch.
"""

import atexit
import math
import multiprocessing
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
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
from ilnet.sensor import PAPER_INPUT, PAPER_TARGET, Sensor, format_size, preset
from ilnet.world import places, simulate, towns

__all__ = [
    "HELD_OUT_SCANS",
    "HELD_OUT_SENSORS",
    "PRESETS",
    "VALIDATION",
    "Preset",
    "Training",
    "held_out_pairs",
    "learns_from_images",
    "train",
]

# The sensor whose scans a training predicts when it is validated.
VALIDATION = preset("paper-64x1024")
# The best weights are chosen on scans of these towns, by seed. No training sees them: trainings use seed 0.
HELD_OUT = {"town01": 1, "town03": 1, "town05": 1}
HELD_OUT_SCANS = 4
# Sensors that a network for any sensor is validated with as well, a quarter of their beams kept, once in each town.
HELD_OUT_SENSORS = "hdl-64e", "os0-128", "os1-64"
# Limits of some networks: the highest learning rate, and the gradient norm to which longer gradients are clipped. The
# likelihood is steep where a network is sure, and at a rate of 1e-3 long runs collapse.
RATES = {"iln-surfaces": 4e-4}
LARGEST_GRADIENT = {"iln-surfaces": 10.0}
PRECISION = "bf16-mixed"
# How many validations a training has, and the fewest and the most steps between them.
VALIDATIONS = 20
VALIDATE_EVERY = 50, 2000
# Steps between checkpoints, and between readings of the loss.
CHECKPOINT_EVERY = 100
READ_EVERY = 10


@dataclass(frozen=True)
class Preset:
    """The size of a network and of its training."""

    steps: int = 0
    """Optimiser steps; 0 if `epochs` decides."""
    epochs: int = 0
    """How often each stored scan is seen; 0 if `steps` decides."""
    halve_after: tuple[int, ...] = ()
    """Epochs after which the learning rate is halved. If empty, the rate rises over the first steps and falls to 0 as
    a cosine."""
    rate: float = 1e-3
    """Highest learning rate."""
    blocks: int = 16
    """Residual blocks of the encoder."""
    crops: int = 8
    """Crops per step."""
    columns: int = 64
    """Columns per crop."""
    queries: int = 1024
    """Rays per crop."""
    dropout: float = 0.0
    """Dropout rate in the attention blocks."""
    towns: tuple[str, ...] = towns.TRAIN
    """Towns in which continuous rays are cast."""

    def arguments(self, name: str) -> dict[str, Any]:
        """Returns the preset's arguments for the model called `name`."""
        own: dict[str, dict[str, Any]] = {
            "liif": {"blocks": self.blocks},
            "lidar-sr": {},
            "iln-surfaces": {"blocks": self.blocks // 2},
        }
        return own.get(name, {"blocks": self.blocks, "dropout": self.dropout})


PRESETS = {
    # As the authors' code does it, on stored images; days on a GPU. Five things differ. Adam's eps is 1e-6 and theirs
    # 1e-8, below which 5.9 % of the gradients of a start lie. A step is in bfloat16, theirs in float32: for that,
    # `train` takes precision="32-true". A batch may hold the last scans of one epoch and the first of the next; theirs
    # ends with the epoch. The weights with the best IoU on held-out scans are kept, theirs are those of epoch 400. They
    # are stored as float16.
    "paper": Preset(
        epochs=1000, halve_after=(200, 400, 600, 800), rate=1e-4, crops=16, columns=1024, queries=16_384, dropout=0.1
    ),
    # Networks of full size. On two cores `laptop` takes an hour and a half and `small` ten minutes; LIIF takes half as
    # long again. In that time many small steps get further than few large ones.
    "laptop": Preset(steps=20_000),
    "small": Preset(steps=2000),
    # A minute or two, for the course.
    "tiny": Preset(steps=400, blocks=4, towns=("town01", "town02")),
}


class Training(lightning.LightningModule):
    """One network, its loss, its schedule and its validation.

    Args:
        model: The model to train, see `Model.loss`.
        held_out: Pairs of an input scan and the scan to be predicted.
        rate: Highest learning rate.
        halve_after: Steps after which the rate is halved; None for one cycle, in which it rises, then falls to 0.
        run: What tells this run from others; kept in its checkpoints.
        probe: More such pairs. Their figures are logged and decide nothing.
    """

    def __init__(
        self,
        model: models.Model,
        held_out: Sequence[Pair],
        rate: float,
        halve_after: Sequence[int] | None = None,
        run: dict[str, Any] | None = None,
        probe: Sequence[Pair] = (),
    ):
        super().__init__()
        self.model, self.rate, self.halve_after, self.run = model, rate, halve_after, run
        self.pairs = {"val": held_out, "test": probe}
        self.figures = nn.ModuleDict({kind: metrics.ScanMetrics() for kind, pairs in self.pairs.items() if pairs})
        self.begun = time.monotonic()

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Adds what `train` needs to refuse a run of another kind, and the time spent."""
        checkpoint["run"], checkpoint["seconds"] = self.run, time.monotonic() - self.begun

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Goes on counting from the time spent before the interruption."""
        self.begun = time.monotonic() - checkpoint["seconds"]

    def transfer_batch_to_device(self, batch: Any, device: torch.device, dataloader_idx: int) -> Any:
        """Moves the tensors of a batch; Lightning itself refuses a batch that holds a frozen dataclass, the sensor."""
        if not isinstance(batch, data.Batch):
            return super().transfer_batch_to_device(batch, device, dataloader_idx)
        return batch.to(device)

    def training_step(self, batch: data.Batch, index: int) -> torch.Tensor:
        """Returns the loss of the model, see `Model.loss`."""
        loss = self.model.loss(*batch)
        self.log("loss", loss, prog_bar=True)
        return loss

    def validation_step(self, place: tuple[str, int], index: int) -> None:
        """Measures the prediction of one scan, given its kind ("val" or "test") and number."""
        kind, number = place
        scan, truth = self.pairs[kind][number]
        with torch.autocast(self.device.type, enabled=False):  # as `evaluate` measures
            self.figures[kind].update(self.model.ranges(scan, truth.sensor), truth)  # type: ignore[operator]

    def on_validation_epoch_end(self) -> None:
        """Logs the means over all scans of all processes."""
        training = self.trainer.state.fn == "fit"  # the figures of the chosen weights are returned, not logged
        self.log("seconds", time.monotonic() - self.begun, logger=training)
        for kind, figures in self.figures.items():
            for name, value in figures.compute().items():  # type: ignore[operator]
                shown = kind == "val" and name in ("mae", "iou")
                self.log(f"{kind}/{name}", value.float(), prog_bar=shown, logger=training)
            figures.reset()  # type: ignore[operator]

    def configure_optimizers(self) -> Any:
        """Returns Adam, with a rate that warms up and decays to 0, or is halved after some steps."""
        # The head of a network with a prior starts at zero, and with it the gradients of the encoder. A smaller eps
        # would let Adam scale up their noise.
        optimizer = torch.optim.Adam(self.parameters(), lr=self.rate, eps=1e-6)
        steps = int(self.trainer.estimated_stepping_batches)
        schedule: torch.optim.lr_scheduler.LRScheduler
        if self.halve_after is not None:
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
    sensors: Sequence[Sensor] | None = None,
    probe: Sequence[Pair] = (),
    make: Callable[..., models.Model] | None = None,
    validations: int = VALIDATIONS,
    precision: str = PRECISION,
    **arguments: Any,
) -> dict[str, float]:
    """Trains a model and writes its weights and figures; an interrupted run in `out` goes on where it stopped.

    Under `torchrun` all processes share each batch. The result is that of one process but for rounding.

    Args:
        name: One of `models.TRAINABLE`.
        preset_name: One of `PRESETS`.
        out: Folder for `NAME.safetensors`. Its folder `NAME/` holds the checkpoints of an unfinished run, and for each
            start a folder `from-step-N/` with metrics.csv and the logs that TensorBoard reads.
        steps: Optimiser steps, instead of the preset's.
        seed: Seed of the initial weights and of the rays, 0 or more.
        archive: Stored images to learn from instead of continuous rays; see `data.open_archive`. LiDAR-SR needs them.
        target: Size (rows, columns) of the stored images to learn from. LiDAR-SR predicts images of this size, and
            learns all of their pixels, in sectors of scans.
        sensors: Input sensors of the continuous rays; if empty, each batch has one that is made up, see
            `data.ContinuousRays`. By default the paper's, and for iln-surfaces any.
        probe: Pairs of an input scan and the scan to be predicted. Their figures are logged as `test/...` and decide
            nothing.
        make: What makes the untrained model from its arguments, by default `models.create`. Its weights should be those
            of a model called `name`, as which they are written; its loss may be another one.
        validations: How often held-out scans are measured. The weights that were best there are written.
        precision: Lightning's name of the precision of a step: "bf16-mixed", or "32-true" for float32.
        **arguments: Arguments of the model; they override the preset's.

    Returns:
        The figures on held-out scans, with the weights that were best there.

    Raises:
        ValueError: If there is no such model or preset, images are missing or of a size that does not fit, `out` holds
            an interrupted run of another kind, there are `sensors` as well as an `archive`, a process has no GPU of its
            own, or a loss is not finite.
    """
    plan = _plan(name, preset_name, steps, seed, archive, target, sensors, make, validations, precision, arguments)
    start = _steps_done(out / name / "last.ckpt", plan.run)
    training, batches, scans = _build(plan, start, probe)
    return _run(plan, training, batches, scans, out, start)


def held_out_pairs(kinds: Sequence[tuple[Sensor, Sensor, int]], device: torch.device) -> list[list[Pair]]:
    """Scans the towns in which no network trains and on which all that is chosen is chosen, `HELD_OUT`.

    Args:
        kinds: The sensor of the input, the sensor to predict, and the number of scans in each town.
        device: Device of the scans.

    Returns:
        For each kind the pairs of scans, town by town.
    """
    streets = [places.town(town, seed, device) for town, seed in HELD_OUT.items()]
    return [
        [(scan, truth) for place in streets for scan, truth in places.held_out_scans(place, count, [source, wanted])]
        for source, wanted, count in kinds
    ]


def learns_from_images(name: str, preset_name: str) -> bool:
    """Returns whether a model with a preset can learn from stored images only."""
    return name == "lidar-sr" or (preset_name in PRESETS and PRESETS[preset_name].epochs > 0)


@dataclass(frozen=True)
class _Plan:
    """What a training does, its arguments checked."""

    name: str
    make: Callable[..., models.Model]
    """Makes the untrained model from `arguments`."""
    size: Preset
    arguments: dict[str, Any]
    """Arguments of the model."""
    steps: int
    validations: int
    precision: str
    seed: int
    stored: data.Archive | data.RangeImageTree | None
    """Stored images to learn from; None for continuous rays."""
    per_epoch: int
    """Steps in which each stored scan is seen once."""
    target: tuple[int, int]
    sensors: Sequence[Sensor]
    """Input sensors of the continuous rays; if empty, each batch has one that is made up."""
    run: dict[str, Any]
    """What tells this run from others; kept in its checkpoints and beside its weights."""


def _plan(
    name: str,
    preset_name: str,
    steps: int | None,
    seed: int,
    archive: Path | None,
    target: tuple[int, int],
    sensors: Sequence[Sensor] | None,
    make: Callable[..., models.Model] | None,
    validations: int,
    precision: str,
    arguments: dict[str, Any],
) -> _Plan:
    """Checks the arguments of `train` and completes them from the preset."""
    if preset_name not in PRESETS:
        raise ValueError(f"preset_name is {preset_name!r}; it should be one of {', '.join(PRESETS)}")
    if name not in models.TRAINABLE:
        raise ValueError(f"name is {name!r}; it should be one of {', '.join(models.TRAINABLE)}, which can be trained")
    size, source = PRESETS[preset_name], PAPER_INPUT.shape
    given, wanted = format_size(source), format_size(target)
    if archive is None and learns_from_images(name, preset_name):
        raise ValueError(
            f"archive is None; it should be a folder of stored images of {given} and {wanted}, from which {name} with "
            f"preset {preset_name} learns: see `ilnet.data.generate`"
        )
    if name == "lidar-sr":
        if target[0] % source[0] or target[1] % source[1]:
            raise ValueError(f"target is {wanted}; for lidar-sr it should be a multiple of {given}")
        arguments = {"rows": target[0] // source[0], "columns": target[1] // source[1], **arguments}
    if archive is not None and sensors is not None:
        raise ValueError("sensors is given; it should be None with an archive, whose images have their own sensor")
    stored = None if archive is None else data.open_archive(archive)
    per_epoch = -(-len(stored) // size.crops) if stored else 0
    steps = steps or size.steps or size.epochs * per_epoch
    arguments = {**size.arguments(name), **arguments}
    learns_from: dict[str, Any] = {"data": f"{wanted} of {archive}"}
    if sensors is None:
        sensors = () if name == "iln-surfaces" else (PAPER_INPUT,)
    if archive is None:
        names = [sensor.name or sensor.size for sensor in sensors] or ["any"]
        learns_from = {"data": "continuous rays", "sensors": names}
    variant = {"variant": make.__name__} if make else {}
    rounded = {"precision": precision} if precision != PRECISION else {}
    run = {"preset": preset_name, "steps": steps, "seed": seed, **rounded, **learns_from, **variant, **arguments}
    make = make or partial(models.create, name)
    return _Plan(
        name, make, size, arguments, steps, validations, precision, seed, stored, per_epoch, target, sensors, run
    )


def _build(
    plan: _Plan, start: int, probe: Sequence[Pair]
) -> tuple[Training, DataLoader[data.Batch], DataLoader[tuple[str, int]]]:
    """Returns the training, its batches from step `start` on, and the numbers of the scans that validate it."""
    device, part = _device(), (int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1)))
    lightning.seed_everything(plan.seed, verbose=False)
    model = plan.make(**plan.arguments)
    samples = _samples(plan, start, part, device)
    held_out = [pair for pairs in held_out_pairs(_validation(plan), device) for pair in pairs]
    halve_after = [epoch * plan.per_epoch for epoch in plan.size.halve_after] if plan.size.epochs else None
    if halve_after and plan.name == "lidar-sr":
        halve_after = []  # the authors' rate stays as it is
    rate = min(plan.size.rate, RATES.get(plan.name, math.inf))
    training = Training(model, held_out, rate, halve_after, plan.run, probe)
    number, processes = part
    numbered = [(kind, i) for kind, pairs in training.pairs.items() for i in range(number, len(pairs), processes)]
    scans: DataLoader[tuple[str, int]] = DataLoader(numbered, batch_size=None)  # type: ignore[arg-type]
    return training, DataLoader(samples, batch_size=None, **_workers(device)), scans


def _run(
    plan: _Plan,
    training: Training,
    batches: DataLoader[data.Batch],
    scans: DataLoader[tuple[str, int]],
    out: Path,
    start: int,
) -> dict[str, float]:
    """Trains, chooses the best weights, writes them to `out` and returns their figures."""
    folder, steps = out / plan.name, plan.steps
    best = ModelCheckpoint(folder, "best", monitor="val/iou", mode="max", enable_version_counter=False)
    last = folder / "last.ckpt"
    trainer = lightning.Trainer(
        max_steps=steps,
        precision=plan.precision,  # type: ignore[arg-type]
        accelerator=simulate.best_device().type,
        **_processes(int(os.environ.get("WORLD_SIZE", 1))),
        use_distributed_sampler=False,
        val_check_interval=min(max(VALIDATE_EVERY[0], steps // plan.validations), VALIDATE_EVERY[1], steps),
        num_sanity_val_steps=0,
        gradient_clip_val=LARGEST_GRADIENT.get(plan.name),
        log_every_n_steps=READ_EVERY,
        default_root_dir=folder,
        logger=[kind(out, name=plan.name, version=f"from-step-{start}") for kind in (CSVLogger, TensorBoardLogger)],
        callbacks=[_Watch(folder), best, _Last(last), TQDMProgressBar(refresh_rate=READ_EVERY)],
        enable_model_summary=False,
    )
    trainer.fit(training, batches, scans, ckpt_path=last if start else None)
    if trainer.interrupted:
        raise KeyboardInterrupt
    figures = _validate(trainer, training, scans)
    if best.best_model_score is not None and best.best_model_score > figures["val/iou"]:
        state = torch.load(best.best_model_path, weights_only=True, map_location="cpu")
        training.load_state_dict(state["state_dict"])
        figures = _validate(trainer, training, scans)
    if trainer.is_global_zero:
        file = out / f"{plan.name}.safetensors"
        card = plan.run | {"minutes": round((time.monotonic() - training.begun) / 60, 1), "held_out": figures}
        models.save(training.model, file, plan.name, plan.arguments, **card)
        for checkpoint in folder.glob("*.ckpt"):
            checkpoint.unlink()
    return figures


class _Watch(lightning.Callback):
    """Stops all processes together when a loss is not finite, and keeps what shows why.

    The losses of several steps are read at once: a GPU has to wait whenever the host reads one. They are read before
    each validation and each checkpoint as well, so that neither sees spoilt weights.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        self.unread: list[tuple[torch.Tensor, data.Batch]] = []
        self.weights: dict[str, torch.Tensor] = {}

    def on_train_start(self, trainer: lightning.Trainer, training: lightning.LightningModule) -> None:
        self._remember(training)

    def on_train_batch_end(
        self, trainer: lightning.Trainer, training: lightning.LightningModule, outputs: Any, batch: Any, index: int
    ) -> None:
        self.unread.append((outputs["loss"], batch))
        if len(self.unread) == READ_EVERY:
            self._read(trainer, training)

    def on_validation_start(self, trainer: lightning.Trainer, training: lightning.LightningModule) -> None:
        self._read(trainer, training)

    def on_save_checkpoint(
        self, trainer: lightning.Trainer, training: lightning.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        self._read(trainer, training)

    def _remember(self, training: lightning.LightningModule) -> None:
        self.weights = {name: weight.clone() for name, weight in training.get_submodule("model").state_dict().items()}

    def _read(self, trainer: lightning.Trainer, training: lightning.LightningModule) -> None:
        if not self.unread:
            return
        losses, count = torch.stack([loss for loss, _ in self.unread]), len(self.unread)
        first = torch.arange(count, device=losses.device).where(~losses.isfinite(), count).min()
        if torch.distributed.is_initialized():
            torch.distributed.all_reduce(first, torch.distributed.ReduceOp.MIN)
        if (number := int(first)) == count:
            self.unread.clear()
            self._remember(training)
            return
        start = trainer.global_step - count
        (loss, batch), step = self.unread[number], start + number
        if loss.isfinite():
            raise ValueError(f"the loss of step {step} is not finite in another process")
        process = f"-process-{trainer.global_rank}" if trainer.world_size > 1 else ""
        file = self.folder / f"step-{step}{process}.pt"
        file.parent.mkdir(parents=True, exist_ok=True)
        # Plain values, since `torch.load` refuses classes. `Sensor(**...)` makes the sensor again.
        sensor = {key: getattr(batch.sensor, key) for key in ("min_range", "max_range", "norm_range", "name")}
        sensor |= {key: torch.tensor(getattr(batch.sensor, key)) for key in ("elevations", "azimuths")}
        torch.save({"batch": batch._asdict() | {"sensor": sensor}, "model": self.weights}, file)
        raise ValueError(
            f"the loss of step {step} is {loss:g}; it should be finite: "
            f"{file} holds the batch, and the weights of step {start}"
        )


class _Last(Checkpoint):
    """Writes the checkpoint from which an interrupted run goes on: every so many steps, and after each validation.

    It never writes between a step and its validation: the run that goes on would leave the validation out. Lightning
    calls it after the `ModelCheckpoint` before it, so that the file holds the best score so far.
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


def _validation(plan: _Plan) -> list[tuple[Sensor, Sensor, int]]:
    """Returns what validates a training: the input sensor, the sensor to predict, and the number of scans per town."""
    if plan.name == "lidar-sr":
        return [(PAPER_INPUT, PAPER_INPUT.resize(*plan.target), HELD_OUT_SCANS)]
    others = [] if plan.sensors else [preset(name) for name in HELD_OUT_SENSORS]
    return [
        (PAPER_INPUT, VALIDATION, HELD_OUT_SCANS),
        *((sensor.decimate(sensor.shape[0] // 4), sensor, 1) for sensor in others),
    ]


def _samples(
    plan: _Plan, start: int, part: tuple[int, int], device: torch.device
) -> data.ContinuousRays | data.StoredImages:
    size, target, source = plan.size, plan.target, PAPER_INPUT
    if plan.stored is None:
        streets = [places.town(town, 0, device) for town in size.towns]
        return data.ContinuousRays(
            streets, plan.sensors, size.crops, size.columns, size.queries, plan.seed, start, part
        )
    columns = source.shape[1]
    if plan.name == "lidar-sr":
        # It learns all pixels that it predicts: of whole scans, as the authors do, or of a sector of each. Batch norm
        # needs several scans.
        scans, sector = size.crops, None if size.epochs else size.columns // 2
        queries = math.prod(target) * (sector or columns) // columns
    else:  # as many columns and as many queries as the crops have, in whole scans
        scans, sector = max(1, size.crops * size.columns // columns), None
        queries = size.crops * size.queries // scans
    sizes = source.size, format_size(target)
    return data.StoredImages(plan.stored, *sizes, scans, queries, plan.seed, start, part, sector)


def _device() -> torch.device:
    """Returns the device of this process: `torchrun` numbers the processes of a machine, and each has its own GPU."""
    device = simulate.best_device()
    if device.type != "cuda":
        return device
    number, gpus = int(os.environ.get("LOCAL_RANK", 0)), torch.cuda.device_count()
    if number >= gpus:
        raise ValueError(f"LOCAL_RANK is {number}; it should be below {gpus}: start one process for each GPU")
    torch.cuda.set_device(number)
    return torch.device("cuda", number)


def _workers(device: torch.device) -> dict[str, Any]:
    """Returns arguments for a `DataLoader`: a worker process makes the batches if there are cores to spare."""
    # On two cores a worker costs more than it saves: drawing a batch takes a sixth of the time of a step.
    spare = device.type == "cpu" and torch.get_num_threads() > 2 and "fork" in multiprocessing.get_all_start_methods()
    return {"num_workers": 1, "multiprocessing_context": "fork"} if spare else {}


def _processes(number: int) -> dict[str, Any]:
    """Returns the arguments that tell Lightning of the processes that `torchrun` started."""
    if number == 1:
        return {"devices": 1}
    # Lightning leaves the group of CPU processes open. Its threads sometimes abort the interpreter at exit.
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
    """Returns the steps of the interrupted run in a checkpoint, 0 if there is none; ValueError if it is not `run`."""
    if not checkpoint.exists():
        return 0
    state = torch.load(checkpoint, weights_only=True, map_location="cpu")
    if state["run"] != run:
        raise ValueError(
            f"{checkpoint} is an interrupted run of {state['run']}, not of {run}: "
            "continue that one, delete the file, or choose another folder"
        )
    return state["global_step"]

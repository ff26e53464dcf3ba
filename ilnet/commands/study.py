"""What experiments share: the networks that they train, the scans that they measure, and how they write and draw."""

import csv
import importlib.metadata
import json
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from matplotlib.figure import Figure

from ilnet import models
from ilnet.learning import evaluate, train
from ilnet.scan import Pair
from ilnet.sensor import PAPER_INPUT, Sensor
from ilnet.world import simulate, towns

__all__ = ["COLOURS", "FIGURES", "SERIES", "Study", "by_case", "grouped_bars", "loaded", "made_with", "spans"]

# Experiments that compare the networks that ship, unless a preset is given to train others.
_SHIPPED = "table", "real", "confidence", "sensors", "alignment", "where", "odometry", "thin"

FIGURES = {"iou": "IoU", "mae": "MAE [m]", "floating": "floating"}
"""The figures that are compared over several seeds, and what they are called."""

# Distinguishable for the colour-blind, and in print.
SERIES = "#0072b2", "#e69f00", "#009e73", "#cc79a7"
COLOURS = {
    "liif": "#d55e00",
    "iln": "#0072b2",
    "iln-surfaces": "#009e73",
    "lidar-sr": "#cc79a7",
    "bilinear": "#999999",
}


@dataclass(frozen=True)
class Study:
    """What experiments share.

    Attributes:
        preset: Preset of each training, one of `train.PRESETS`. If None, trainings are `small`, and other methods are
            compared with the networks that ship with the package.
        out: Folder for weights, numbers and figures.
        scans: Number of test scans from each test town.
        seeds: Number of trainings where their spread is shown.
        archive: Stored images, to compare with continuous rays and to train LiDAR-SR at those of `sizes` that it holds.
            If None, both are left out.
        measured: Files of measured scans. Their names without suffix differ, since results bear them.
        named: Models of the table of a tree of `.rimg` files; if there is none, those of the other table.
        stored_scans: Number of its scans; None for all.
        used: Files of the networks that were trained for an experiment, in this run or before.
        sizes: Sizes that are predicted, those of the paper.

    Raises:
        ValueError: If two measured files have one name.
    """

    preset: str | None
    out: Path
    scans: int = 20
    seeds: int = 3
    archive: Path | None = None
    measured: tuple[Path, ...] = ()
    named: tuple[str, ...] = ()
    stored_scans: int | None = None
    used: set[Path] = field(default_factory=set, init=False, repr=False)
    sizes: ClassVar[Sequence[tuple[int, int]]] = ((64, 1024), (128, 2048), (256, 4096))

    def __post_init__(self) -> None:
        files: dict[str, Path] = {}
        for path in self.measured:
            if (other := files.setdefault(path.stem, path)) is not path:
                raise ValueError(f"measured holds {other} and {path}; their names should differ: rename one of them")

    @cached_property
    def probe(self) -> list[Pair]:
        """Test scans that are measured during a training."""
        output = PAPER_INPUT.resize(*self.sizes[0])
        return [pair for town in towns.TEST for pair in evaluate.town_pairs(town, 4, output)]

    def trained(self, label: str, name: str, **options: Any) -> Path:
        """Trains a network unless its weights exist; returns their file. Options are those of `train.train`."""
        folder = self.out / "weights" / label
        file = folder / f"{name}.safetensors"
        if not file.exists():
            train.train(name, self.preset or "small", folder, **options)
        self.used.add(file)
        return file

    def followed(self, name: str, seed: int = 0) -> Path:
        """Returns the same for a network with the preset's own arguments, and logs test figures during training.

        It learns from the paper's input sensor, by which it is tested.
        """
        return self.trained(f"{name}-{seed}", name, seed=seed, sensors=[PAPER_INPUT], probe=self.probe)

    def networks(self) -> dict[str, str | Path]:
        """Returns the networks that are compared with other methods."""
        return {name: self.trained(name, name) if self.preset else name for name in ("liif", "iln", "iln-surfaces")}

    def pairs(self, output: Sensor, source: Sensor = PAPER_INPUT) -> list[Pair]:
        """Returns test scans of `source`, and those of `output` that should be predicted from them."""
        return [pair for town in towns.TEST for pair in evaluate.town_pairs(town, self.scans, output, source)]

    def compare(
        self, files: Mapping[str, str | Path | models.Model], sizes: Sequence[tuple[int, int]] = ()
    ) -> list[dict[str, Any]]:
        """Measures models in the test towns, at all `sizes` by default; their rows bear the names in `files`."""
        on_device = loaded(files)
        rows: list[dict[str, Any]] = []
        for size in sizes or self.sizes:
            rows += evaluate.measure(on_device, self.pairs(PAPER_INPUT.resize(*size)))
        return rows

    def measured_once(self, networks: Mapping[Path, models.Model]) -> dict[Path, list[dict[str, Any]]]:
        """Returns the rows of `compare` for networks by the files of their weights, beside which it keeps the rows."""
        kept = {file: file.with_suffix(f".{self.scans}-scans.json") for file in networks}
        missing = {str(file): model for file, model in networks.items() if not kept[file].exists()}
        rows = self.compare(missing) if missing else []
        for file in map(Path, missing):
            part = file.with_suffix(".part")
            part.write_text(json.dumps([row for row in rows if row["model"] == str(file)]))
            part.replace(kept[file])
        return {file: json.loads(kept[file].read_text()) for file in networks}

    def write(self, name: str, rows: Sequence[dict[str, Any]]) -> None:
        """Writes rows to NAME.csv, and to about.json what they were made with.

        Args:
            name: That of the experiment, or of a part of it: EXPERIMENT-PART.
            rows: At least one, all with the same keys.
        """
        self.out.mkdir(parents=True, exist_ok=True)
        shipped = self.preset is None and name.partition("-")[0] in _SHIPPED
        trained = f"networks trained with preset {self.preset or 'small'}"
        networks = "the networks that ship" if shipped else trained
        if any(row.get("model") == "lidar-sr" for row in rows):
            networks += f"; LiDAR-SR trained with preset {self.preset or 'small'}"
        self._sign(name, {"networks": networks})
        with open(self.out / f"{name}.csv", "w", newline="") as file:
            writer = csv.DictWriter(file, rows[0], lineterminator="\n")
            writer.writeheader()
            writer.writerows(
                {key: round(v, 4) if isinstance(v, float) else v for key, v in row.items()} for row in rows
            )

    def run(self, name: str, experiment: Callable[["Study"], None]) -> None:
        """Runs an experiment, and adds to about.json by which command, at which commit and in how many minutes."""
        begun = time.monotonic()
        self.used.clear()
        experiment(self)
        options = [f"--scans {self.scans}", f"--seeds {self.seeds}"]
        options += [f"--preset {self.preset}"] if self.preset else []
        options += ["--data DIR"] if self.archive else []
        options += [f"--model {model}" for model in self.named]
        options += ["--measured FILE ..."] if self.measured else []
        command = f"python -m ilnet experiment {name} {' '.join(options)}"
        about = {"command": command, "commit": _commit(), "minutes": round((time.monotonic() - begun) / 60, 1)}
        if self.used:
            about["training_minutes"] = round(sum(models.card(file).get("minutes", 0) for file in self.used), 1)
        self._sign(name, about)

    def _sign(self, name: str, about: dict[str, Any]) -> None:
        """Adds to about.json what an experiment was made with."""
        made = made_with(self.out)
        made[name] = made.get(name, {}) | about
        (self.out / "about.json").write_text(json.dumps(made, indent=1) + "\n")


def _commit() -> str:
    """Returns the commit of this code or, where it is installed, its version."""
    git = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty"]
    try:
        return subprocess.run(git, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return f"version {importlib.metadata.version('ilnet')}"


def loaded(files: Mapping[str, str | Path | models.Model]) -> dict[str, models.Model]:
    """Returns models where the scans of `evaluate` are."""
    found = {label: file if isinstance(file, models.Model) else models.load(file) for label, file in files.items()}
    return {label: model.to(simulate.best_device()) for label, model in found.items()}


def made_with(folder: Path) -> dict[str, Any]:
    """Returns what each experiment in a folder was made with, by its name."""
    file = folder / "about.json"
    return dict(json.loads(file.read_text())) if file.exists() else {}


def grouped_bars(study: Study, name: str, rows: Sequence[dict[str, Any]], cases: Sequence[str]) -> None:
    """Draws IoU by case and model.

    Args:
        study: Says where to.
        name: Of the experiment.
        rows: One for each case and model. Models that differ after a comma share a colour; all but "right" are hatched.
        cases: The case of each row, as it is written below its bars.
    """
    kinds, names = list(dict.fromkeys(cases)), list(dict.fromkeys(row["model"] for row in rows))
    figure = Figure(figsize=(10, 3.4), layout="constrained")
    axis = figure.subplots()
    width = 0.8 / len(names)
    for number, model in enumerate(names):
        values = [row["iou"] for row in rows if row["model"] == model]
        at = np.arange(len(kinds)) + width * (number - (len(names) - 1) / 2)
        kind, comma, _ = model.partition(",")
        wrong = comma and not model.endswith("right")
        axis.bar(
            at,
            values,
            width,
            label=model,
            color=COLOURS.get(kind, "#555555"),
            hatch="////" if wrong else None,
            edgecolor="white",
            linewidth=0,
        )
    axis.set_xticks(range(len(kinds)), kinds, fontsize=6 if len(kinds) > 6 else 8)
    axis.set_ylabel("IoU")
    axis.legend(fontsize=8)
    figure.savefig(study.out / f"{name}.png", dpi=120)


def by_case(rows: Sequence[Mapping[str, Any]], keys: Sequence[str]) -> dict[tuple[str, ...], dict[str, list[float]]]:
    """Returns the `FIGURES` of all seeds, by the values of `keys`, given rows of an experiment."""
    found: dict[tuple[str, ...], dict[str, list[float]]] = {}
    for row in rows:
        figures = found.setdefault(tuple(row[key] for key in keys), {name: [] for name in FIGURES})
        for name, values in figures.items():
            values.append(float(row[name]))
    return found


def spans(rows: Sequence[Mapping[str, Any]], keys: Sequence[str]) -> list[dict[str, Any]]:
    """Returns for each case of `by_case` the means over the seeds and, of several seeds, their spans."""
    table = []
    for case, figures in by_case(rows, keys).items():
        line: dict[str, Any] = dict(zip(keys, case, strict=True))
        for name, values in figures.items():
            line[name] = f"{np.mean(values):.3f}"
            if len(values) > 1:
                line[name] += f" ({min(values):.3f} to {max(values):.3f})"
        table.append(line)
    return table

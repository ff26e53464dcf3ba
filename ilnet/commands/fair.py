"""Fair comparisons: values, corrections and weights with all else equal; queries at right and at wrong angles.

Of each neighbour t of a query the decoder predicts one number h_t. The three kinds differ in nothing but what it means:

    values        r̂ = Σ_t a_t v(h_t)              the paper's Eq. (2); a_t are the bilinear areas
    corrections   r̂ = Σ_t a_t (r_t + Δ(h_t))      values, anchored to the measured ranges r_t
    weights       r̂ = Σ_t softmax(h)_t r_t        the paper's Eq. (3)

Here v(h) = (h + 1) R / 2 and Δ(h) = h R / 2, with R = `norm_range`. Each kind has LIIF's decoder, a multilayer
perceptron (MLP) that sees one neighbour at a time, or ILN's, attention among the four. Each starts as in the paper or
from bilinear interpolation: the last layer of corrections starts at zero, and so does that of weights, to whose h_t
log a_t is added. Values first learn the answers of bilinear interpolation, for `REHEARSAL` steps that are not counted.

Two cases more control what attention is worth: weights by ILN's decoder without its attention, and with all the rest.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import nn

from ilnet import models, scan_files
from ilnet.commands.study import FIGURES, SERIES, Study, by_case, grouped_bars, loaded
from ilnet.learning import evaluate
from ilnet.models import ILN, LIIF
from ilnet.models.base import OFFSET_SCALE, normalised
from ilnet.scan import Scan
from ilnet.sensor import Sensor
from ilnet.world import simulate
from kernels import area_blend, gather_blend, gather_neighbours

__all__ = [
    "CONTROL",
    "DECODERS",
    "FAIR_KEYS",
    "KINDS",
    "REHEARSAL",
    "STARTS",
    "alignment",
    "answer",
    "fair",
    "rehearsing",
    "variant",
]

KINDS = ("values", "corrections", "weights")
DECODERS = {"MLP": "liif", "attention": "iln"}
"""The decoders, and the models that have them."""
CONTROL = "feed-forward"
"""What stays of the decoder with attention when its attention is taken away."""
STARTS = ("as the paper", "from bilinear")
FAIR_KEYS = "kind", "decoder", "start", "size"
"""The columns that tell the cases of `fair` apart."""
REHEARSAL = 200
"""Steps in which values learn bilinear interpolation before they start from it."""

# One network apart from what is compared. LIIF's hidden layers are narrower than the paper's, so that a step of either
# decoder takes about as long.
_MODELS = DECODERS | {CONTROL: "iln"}
_SIZE = {name: {"features": 32, "blocks": 8} | ({"hidden": 128} if name == "MLP" else {}) for name in _MODELS}
_TRAINING = {"steps": 1000, "validations": 2, "precision": "32-true"}


def answer(
    kind: str,
    h: torch.Tensor,
    image: torch.Tensor,
    queries: torch.Tensor,
    wrap: bool,
    prior: str = "none",
    norm_range: float = 100.0,
    backend: str = "warp",
) -> torch.Tensor:
    """Returns ranges (B, Q) [m], given the number that was predicted for each neighbour; the formulas stand above.

    Args:
        kind: One of `KINDS`.
        h: (B, Q, 4), the predicted numbers.
        image: (B, H, W) measured ranges [m].
        queries: (B, Q, 2) pixel coordinates.
        wrap: Whether the last column of the image is beside the first.
        prior: What weights start from, see `kernels.gather_blend`.
        norm_range: R [m].
        backend: "warp" or "torch".
    """
    if kind == "weights":
        return gather_blend(image, queries, h, prior, wrap, area_floor=1e-4, backend=backend)
    half = norm_range / 2
    if kind == "values":
        return area_blend((h + 1) * half, queries, backend)
    measured, _ = gather_neighbours(image.unsqueeze(1), queries, wrap, backend)
    return area_blend(measured.squeeze(-1) + h * half, queries, backend)


class _FeedForward(ILN):
    """ILN whose neighbours do not look at one another: D = 0, but with the feed-forward layer of D = 1."""

    def encode(self, image: torch.Tensor, wrap: bool, sensor: Sensor | None = None) -> Any:
        return self.encoder(normalised(image, self.norm_range), wrap)

    def scores(self, encoded: Any, queries: torch.Tensor, wrap: bool) -> torch.Tensor:
        z, offsets = gather_neighbours(encoded, queries, wrap, self.backend)
        z = z + self.position(offsets * OFFSET_SCALE)
        for block in self.blocks:
            z = z + block.feed_forward(z)  # type: ignore[operator]
        return self.head(z).squeeze(-1)


class _Compared:
    """A network of which only the meaning of the predicted numbers is changed; see `variant`."""

    kind: str
    prior: str
    rehearses: bool

    def decode(self, encoded: Any, image: torch.Tensor, queries: torch.Tensor, wrap: bool) -> torch.Tensor:
        predict = self.values if isinstance(self, LIIF) else self.scores  # type: ignore[attr-defined]
        h = predict(encoded, queries, wrap).float()
        norm_range, backend = self.norm_range, self.backend  # type: ignore[attr-defined]
        return answer(self.kind, h, image, queries, wrap, self.prior, norm_range, backend)

    def is_fused(self, encoded: Any) -> bool:
        return False

    def loss(self, image: torch.Tensor, queries: torch.Tensor, ranges: torch.Tensor, *rest: Any) -> torch.Tensor:
        if self.rehearses:
            ranges = models.create("bilinear")(image, queries, rest[0])
        return super().loss(image, queries, ranges, *rest)  # type: ignore[misc]


def variant(kind: str, decoder: str, start: str, rehearsed: Path | None = None) -> Callable[..., models.Model]:
    """Returns what makes an untrained network, for `train.train`.

    Args:
        kind: One of `KINDS`.
        decoder: One of `DECODERS`, or `CONTROL`.
        start: One of `STARTS`.
        rehearsed: The weights that values start from, where they start from bilinear interpolation.
    """
    parent: type[models.Model] = {"MLP": LIIF, "attention": ILN, CONTROL: _FeedForward}[decoder]
    bilinear = start == STARTS[1]
    prior = "bilinear" if bilinear and kind == "weights" else "none"
    names = {"kind": kind, "prior": prior, "rehearses": False}
    made = type(f"{kind} by {decoder}, {start}", (_Compared, parent), names)

    def make(**arguments: Any) -> models.Model:
        model = made(**arguments)
        model.kind, model.prior = kind, prior  # ILN has a prior of its own
        if rehearsed is not None:
            model.load_state_dict(models.load(rehearsed).state_dict())
        elif bilinear:
            last = (model.value if decoder == "MLP" else model.head)[-1]
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)
        return model

    make.__name__ = made.__name__
    return make


def rehearsing(decoder: str) -> Callable[..., models.Model]:
    """Returns what makes a network of values that learns the answers of bilinear interpolation."""
    plain = variant("values", decoder, STARTS[0])

    def make(**arguments: Any) -> models.Model:
        model = plain(**arguments)
        model.rehearses = True  # type: ignore[assignment]
        return model

    make.__name__ = f"bilinear by {decoder}"
    return make


def fair(study: Study) -> None:
    """The paper's claim, one thing at a time: values, corrections and weights, with all else equal.

    Each is trained with either decoder and from either start, for 1000 steps in float32 on the same rays.
    """
    rows = []
    cases = *product(KINDS, DECODERS, STARTS), *product(("weights",), (CONTROL,), STARTS)
    for seed in range(study.seeds):
        files = {case: _trained(study, *case, seed) for case in cases}
        measured = study.measured_once({file: _read(file, *case) for case, file in files.items()})
        for case, file in files.items():
            named = dict(zip(FAIR_KEYS, case, strict=False)) | {"seed": seed}
            rows += [named | {key: row[key] for key in ("size", "scans", *FIGURES)} for row in measured[file]]
    study.write("fair", rows)
    _draw(study, rows)


def _trained(study: Study, kind: str, decoder: str, start: str, seed: int) -> Path:
    name, size = _MODELS[decoder], _SIZE[decoder]
    rehearsed = None
    if kind == "values" and start == STARTS[1]:
        options = {**_TRAINING, "steps": REHEARSAL, "validations": 1}
        label = f"fair-rehearsal-{decoder}-{seed}"
        rehearsed = study.trained(label, name, seed=seed, make=rehearsing(decoder), **options, **size)
    make = variant(kind, decoder, start, rehearsed)
    label = f"fair-{kind}-{decoder}-{start.replace(' ', '-')}-{seed}"
    return study.trained(label, name, seed=seed, make=make, **_TRAINING, **size)


def _read(file: Path, kind: str, decoder: str, start: str) -> models.Model:
    model = variant(kind, decoder, start)(**_SIZE[decoder])
    model.load_state_dict(models.load(file).state_dict())
    return model.eval()


def alignment(study: Study) -> None:
    """The same networks, asked at the right angles and at the wrong ones: what a slip in published code costs.

    Rows 0, 4, 8, … of a measured scan are kept, and all are predicted. *right* gives each row its own elevation.
    *wrong* spreads the rows that are kept evenly over the whole field of view, of which they lack the last rows.
    """
    if not study.measured:
        raise ValueError("no measured scans are named: give some with --measured FILE, such as frames of your sensor")
    networks = study.networks()
    compared = loaded({"planes": "planes"} | {name: networks[name] for name in ("iln", "iln-surfaces")})
    rows = []
    for path in study.measured:
        truth = scan_files.read(path).to(simulate.best_device())
        sensor, ranges = truth.sensor, truth.ranges[::4]
        tables = {
            "right": sensor.elevations[::4],
            "wrong": np.linspace(sensor.elevations[0], sensor.elevations[-1], len(ranges)),
        }
        for queries, elevations in tables.items():
            scan = Scan(ranges, replace(sensor, elevations=elevations, name=""))
            for row in evaluate.measure(compared, [(scan, truth)]):
                rows.append({"scan": path.stem, "queries": queries, **row})
    study.write("alignment", rows)
    labelled = [row | {"model": f"{row['model']}, {row['queries']}"} for row in rows]
    grouped_bars(study, "alignment", labelled, [f"{row['scan']}\nfrom every fourth row" for row in rows])


def _draw(study: Study, rows: Sequence[Mapping[str, Any]]) -> None:
    """Draws IoU and MAE of each case at each size: means over the seeds, and their spans."""
    found = by_case(rows, FAIR_KEYS)
    sizes = list(dict.fromkeys(size for *_, size in found))
    cases = list(product((*DECODERS, CONTROL), STARTS))
    figure = Figure(figsize=(11, 5.6), layout="constrained")
    grid = figure.subplots(2, len(sizes), sharex=True, sharey="row", squeeze=False)
    for line, (key, words) in zip(grid, (("iou", "IoU"), ("mae", "MAE [m]")), strict=True):
        for axis, size in zip(line, sizes, strict=True):
            for (number, kind), (at, (decoder, start)) in product(enumerate(KINDS), enumerate(cases)):
                figures = found.get((kind, decoder, start, size))
                if figures is None:
                    continue
                where, label = at + 0.2 * (number - 1), kind if at == 0 else None
                axis.plot([where, where], [min(figures[key]), max(figures[key])], color=SERIES[number])
                axis.plot(where, np.mean(figures[key]), "ovs"[number], color=SERIES[number], label=label)
            axis.grid(axis="y", alpha=0.3)
        line[0].set_ylabel(words)
    for axis, size in zip(grid[0], sizes, strict=True):
        axis.set_title(size)
    for axis in grid[-1]:
        names = [f"{decoder}, {start}" for decoder, start in cases]
        axis.set_xticks(range(len(cases)), names, fontsize=7, rotation=35, ha="right")
    grid[0][-1].legend(fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5), frameon=False)
    figure.savefig(study.out / "fair.png", dpi=120)

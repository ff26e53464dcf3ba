"""Does it help to see people, bicycles and poles? The simulator knows which thing each ray meets."""

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from tqdm import tqdm  # type: ignore[import-untyped]

from ilnet import models
from ilnet.commands.study import COLOURS, Study, loaded
from ilnet.scan import Scan
from ilnet.sensor import PAPER_INPUT, Sensor
from ilnet.world import places, simulate, towns
from ilnet.world.effects import nearer
from kernels import Mesh

__all__ = ["BINS", "ENOUGH", "NEAR", "TARGET", "thin"]

ENOUGH = 10
"""Points that a thing should get."""
NEAR = 0.05
"""How far a point may be from the surface that its ray meets [m]."""
TARGET = PAPER_INPUT.resize(128, 2048)
"""The sensor with many beams, and what is predicted from `PAPER_INPUT`."""
BINS = (0, 10, 20, 40, 80)
"""Ends of the ranges by which things are told apart [m]."""

# What it meets `ENOUGH` times is in sight.
_FINE = PAPER_INPUT.resize(256, 4096)
_KINDS = {"poles": (), "people": towns.PEOPLE, "bicycles": towns.BICYCLES}
_COLOURS = COLOURS | {"16 beams": "#000000", "128 beams": "#e69f00", "planes": "#cc79a7"}


def thin(study: Study) -> None:
    """Ours: the share of poles, people and bicycles that get 10 points within 5 cm of where their rays meet them.

    Inputs are scans of 16x1024 and of 128x2048, and 128x2048 predicted from 16x1024. A thing is in sight if a sensor
    of 256x4096 meets it 10 times. Poles are lamps, signs, traffic lights, bollards and power poles.
    """
    files = {"planes": "planes"} | {name: study.networks()[name] for name in ("iln", "iln-surfaces")}
    compared = loaded(files)
    counts: dict[str, list[np.ndarray]] = {}
    kinds, ranges = [], []
    frames = {
        name: models.Upsampler(model, PAPER_INPUT, TARGET, device=simulate.best_device())
        for name, model in compared.items()
    }
    with tqdm(total=len(towns.TEST) * study.scans, unit="scan", desc="thin") as progress:
        for town in towns.TEST:
            place = places.town(town, device=simulate.best_device())
            for number in place.spread(study.scans):
                kind, away, found = _counted(place, number, frames)
                kinds.append(kind)
                ranges.append(away)
                for name, points in found.items():
                    counts.setdefault(name, []).append(points)
                progress.update()
    rows = _rows(np.concatenate(kinds), np.concatenate(ranges), {n: np.concatenate(c) for n, c in counts.items()})
    study.write("thin", rows)
    _draw(study, rows)


def _counted(
    place: places.Place, number: int, frames: Mapping[str, models.Upsampler]
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Counts the points on each thin thing in sight of a waypoint.

    Returns:
        For each thing its kind, a number in `_KINDS`; its range [m]; and by input the number of its points.
    """
    assert place.town is not None
    pose = place.pose(number)
    things = towns.draw(place.town, pose[:3, 3].numpy(), number)
    poles = place.town.poles
    owners = np.full(len(place.triangles), -1)
    for pole, (first, last) in enumerate(poles):
        owners[first:last] = pole
    kinds = np.full(len(poles) + len(things.kind), -1)
    kinds[: len(poles)] = 0
    for kind, group in enumerate(_KINDS.values()):
        kinds[len(poles) :][np.isin(things.kind, group)] = kind
    world = [(place.mesh, owners)]
    if len(things.kind):
        world.append((Mesh(*things.mesh(), place.device), things.owners() + len(poles)))

    def points(ids: torch.Tensor) -> np.ndarray:
        return torch.bincount(ids[ids >= 0], minlength=len(kinds)).cpu().numpy()

    def scanned(sensor: Sensor) -> tuple[torch.Tensor, torch.Tensor]:
        return _met(world, sensor, pose)

    ranges, ids = scanned(_FINE)
    seen = (points(ids) >= ENOUGH) & (kinds >= 0)
    away = np.array([ranges[ids == thing].median().item() for thing in np.nonzero(seen)[0]])
    ranges, ids = scanned(PAPER_INPUT)
    scan, found = Scan(ranges, PAPER_INPUT), {"16 beams": points(ids)}
    ranges, ids = scanned(TARGET)
    found["128 beams"] = points(ids)
    for name, predict in frames.items():
        found[name] = points(ids.where((predict.ranges(scan) - ranges).abs() <= NEAR, -1))
    return kinds[seen], away, {name: count[seen] for name, count in found.items()}


def _met(world: list[tuple[Mesh, np.ndarray]], sensor: Sensor, pose: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the ranges (H, W) [m] of a scan, and the number of the thing that each ray meets, -1 for none."""
    found = []
    for mesh, owners in world:
        hits = simulate.hits(mesh, pose, sensor.directions().view(-1, 3), sensor.max_range)
        known = torch.from_numpy(np.append(owners, -1)).to(mesh.device)  # the last stands for no triangle, -1
        found.append((hits.range, known[hits.triangle.long()]))
    ranges, ids = found[0]
    for other, others in found[1:]:
        front = nearer(other, ranges)
        ranges, ids = other.where(front, ranges), others.where(front, ids)
    seen = ranges >= sensor.min_range
    return ranges.where(seen, 0.0).view(sensor.shape), ids.where(seen, -1).view(sensor.shape)


def _rows(kinds: np.ndarray, ranges: np.ndarray, counts: Mapping[str, np.ndarray]) -> list[dict[str, Any]]:
    """Returns the shares by kind at all ranges, and by range of all kinds."""
    groups = {(name, "all"): kinds == kind for kind, name in enumerate(_KINDS)}
    for near, far in pairwise(BINS):
        groups["all", f"{near} to {far} m"] = (ranges >= near) & (ranges < far)
    groups["all", "all"] = np.ones(len(kinds), bool)
    return [
        {
            "things": name,
            "range": span,
            "in_sight": int(group.sum()),
            **{of: float((count[group] >= ENOUGH).mean()) for of, count in counts.items()},
        }
        for (name, span), group in groups.items()
        if group.any()
    ]


def _draw(study: Study, rows: list[dict[str, Any]]) -> None:
    figure = Figure(figsize=(10, 3.2), layout="constrained")
    axis = figure.subplots()
    names = [name for name in rows[0] if name in _COLOURS]
    width = 0.8 / len(names)
    for number, name in enumerate(names):
        at = np.arange(len(rows)) + width * (number - (len(names) - 1) / 2)
        axis.bar(at, [row[name] for row in rows], width, label=name, color=_COLOURS[name])
    cases = [row["things"] if row["range"] == "all" else row["range"] for row in rows]
    labels = [f"{case}\n({row['in_sight']})" for case, row in zip(cases, rows, strict=True)]
    axis.set_xticks(range(len(rows)), labels, fontsize=8)
    axis.set_ylabel("share with 10 points")
    axis.legend(fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5), frameon=False)
    figure.savefig(study.out / "thin.png", dpi=120)

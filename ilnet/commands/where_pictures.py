"""The pictures of the experiment `where`."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ilnet.commands.study import COLOURS, SERIES
from ilnet.scan import Scan

__all__ = ["errors", "heads", "jumps", "precision", "spreads", "weights"]

_COLOURS = {**COLOURS, "bilinear-inverse": "#999999", "planes": "#e69f00", "truth": "#000000"}
# From the least spread to the largest.
_SHADES = "#dce9f5", "#9cc3e0", "#4a90c2", "#0b3d70"
_MOST = 30.0  # centimetres; larger errors have the colour of this one
# The neighbours, as one sees an upright image: from the inside, with rising azimuths to the left.
_NEIGHBOURS = "lower right", "lower left", "upper right", "upper left"
_FARTHEST = 60.0  # metres


def _unique(rows: Sequence[Mapping[str, Any]], key: str) -> list[str]:
    return list(dict.fromkeys(row[key] for row in rows))


def spreads(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draws the share of right queries by spread, and what each spread adds to the IoU."""
    sizes, names, kinds = (_unique(rows, key) for key in ("size", "model", "spread"))
    figure = Figure(figsize=(11, 3.1 * len(sizes)), layout="constrained")
    grid = figure.subplots(len(sizes), 2, squeeze=False, width_ratios=(3, 2))
    for (left, right), size in zip(grid, sizes, strict=True):
        here = {(row["model"], row["spread"]): row for row in rows if row["size"] == size}
        for number, name in enumerate(names):
            at = np.arange(len(kinds)) + 0.16 * (number - (len(names) - 1) / 2)
            left.bar(at, [here[name, k]["within 5 cm"] for k in kinds], 0.15, color=_COLOURS[name], label=name)
        part = [f"{k}\n{100 * here[names[0], k]['queries']:.0f} % of the queries" for k in kinds]
        left.set_xticks(range(len(kinds)), part, fontsize=8)
        left.set_ylabel("share right to 5 cm")
        left.set_title(f"{size}, by spread of the four neighbours", fontsize=10)
        begin = np.zeros(len(names))
        for kind, shade in zip(kinds, _SHADES, strict=True):
            values = np.array([here[name, kind]["IoU from here"] for name in names])
            right.barh(names, values, left=begin, color=shade, label=kind)
            begin += values
        right.invert_yaxis()
        right.set_xlabel("IoU, by spread")
        left.set_ylim(0, 1)
        right.set_xlim(0, 1)
    grid[0, 0].legend(fontsize=8)
    grid[0, 1].legend(fontsize=8)
    figure.savefig(path, dpi=100)


def _shown(image: torch.Tensor, truth: Scan, columns: slice) -> tuple[np.ndarray, tuple[float, ...]]:
    """Returns some columns of an image as one sees them, highest beam first, azimuths falling; and the extent [°]."""
    elevations, azimuths = np.rad2deg(truth.sensor.elevations), np.rad2deg(truth.sensor.azimuths[columns])
    picture = image[:, columns].cpu().numpy()
    picture = picture if elevations[0] > elevations[-1] else picture[::-1]
    picture = picture if azimuths[0] > azimuths[-1] else picture[:, ::-1]
    return picture, (azimuths.max(), azimuths.min(), elevations.min(), elevations.max())


def _draw(axis: Axes, image: torch.Tensor, truth: Scan, columns: slice, title: str, **options: Any) -> Any:
    picture, extent = _shown(image, truth, columns)
    axis.set_title(title, fontsize=9)
    axis.tick_params(labelsize=7)
    axis.set_facecolor("#dddddd")  # no return
    return axis.imshow(picture, aspect="auto", interpolation="nearest", **{"extent": extent, **options})


def _draw_truth(axis: Axes, truth: Scan, columns: slice) -> Any:
    ranges = truth.ranges.where(truth.ranges > 0, torch.nan)
    return _draw(axis, ranges, truth, columns, "truth: range", cmap="viridis_r", vmin=0, vmax=_FARTHEST)


def errors(maps: Mapping[str, torch.Tensor], truth: Scan, columns: slice, path: Path) -> None:
    """Draws the truth and the signed error of each method.

    Args:
        maps: (H, W) errors [cm] by method; NaN where nothing returns.
        truth: The true scan.
        columns: Those that are shown.
        path: A picture file.
    """
    figure = Figure(figsize=(11, 1.9 * ((len(maps) + 2) // 2)), layout="constrained")
    axes = figure.subplots((len(maps) + 2) // 2, 2, sharex=True, sharey=True).flatten()
    depth = _draw_truth(axes[0], truth, columns)
    figure.colorbar(depth, ax=axes[0], label="range [m]", pad=0.01)
    for axis, (name, error) in zip(axes[1:], maps.items(), strict=False):
        limits = {"cmap": "RdBu_r", "vmin": -_MOST, "vmax": _MOST}
        picture = _draw(axis, error, truth, columns, name, **limits)
        figure.colorbar(picture, ax=axis, label="error [cm]", extend="both", pad=0.01)
    for axis in axes[len(maps) + 1 :]:
        axis.set_visible(False)
    figure.supxlabel("azimuth [°]; red is too far, blue too near, grey no return", fontsize=9)
    figure.supylabel("elevation [°]", fontsize=9)
    figure.savefig(path, dpi=100)


def jumps(
    rows: Sequence[Mapping[str, Any]], curves: Mapping[tuple[str, str], np.ndarray], fine: int, path: Path
) -> None:
    """Draws how each answer crosses a jump, and how many columns that takes.

    Args:
        rows: Those of the experiment.
        curves: The quartiles (3, K) of the answers around the true place, as shares of the jump, by model and rows.
        fine: Queries from one measured column to the next.
        path: A picture file.
    """
    names, kinds = _unique(rows, "model"), _unique(rows, "rows")
    figure = Figure(figsize=(11, 3.6), layout="constrained")
    *lefts, right = figure.subplots(1, len(kinds) + 1)
    for axis, kind in zip(lefts, kinds, strict=True):
        for name in names:
            low, middle, high = curves[name, kind]
            at = (np.arange(len(middle)) - len(middle) // 2) / fine
            style = {"color": _COLOURS[name], "linestyle": ":" if name == "truth" else "-"}
            axis.plot(at, middle, label=name, zorder=3 if name == "truth" else 2, **style)
            if name in ("liif", "iln"):
                axis.fill_between(at, low, high, color=_COLOURS[name], alpha=0.2, linewidth=0)
        axis.set_title(f"rows {kind}", fontsize=10)
        axis.set_xlabel("measured columns from the true jump")
        axis.set_ylim(-0.3, 1.3)
    lefts[0].set_ylabel("share of the jump: median")
    lefts[0].legend(fontsize=7, loc="upper left")
    for number, kind in enumerate(kinds):
        here = {row["model"]: row for row in rows if row["rows"] == kind}
        for place, name in enumerate(names):
            row, y = here[name], place + 0.3 * (number - 0.5)
            low, high = row["width, first quartile"], row["width, third quartile"]
            right.plot([low, min(high, 5.0)], [y, y], color=_COLOURS[name])
            label = kind if place == 0 else None
            face = _COLOURS[name] if number == 0 else "white"
            right.plot(row["width"], y, "o", color=_COLOURS[name], markerfacecolor=face, label=label)
    right.set_yticks(range(len(names)), names, fontsize=8)
    right.invert_yaxis()
    right.set_xlim(left=0)
    right.set_xlabel("columns from 10 to 90 %: quartiles")
    right.legend(fontsize=7)
    figure.savefig(path, dpi=100)


def weights(
    maps: Mapping[str, torch.Tensor],
    bits: Mapping[str, torch.Tensor],
    rows: Sequence[Mapping[str, Any]],
    truth: Scan,
    columns: slice,
    path: Path,
) -> None:
    """Draws the weights of the neighbours and their entropy over a range image, and the entropy by spread.

    Args:
        maps: (H, W, 4 or 36) weights, by model.
        bits: (H, W), their entropy.
        rows: Those of the experiment.
        truth: The true scan.
        columns: Those that are shown.
        path: A picture file.
    """
    figure = Figure(figsize=(13, 2.3 * (len(maps) + 1)), layout="constrained")
    *lines, bottom = figure.subfigures(len(maps) + 1, 1, squeeze=False)[:, 0]
    for line, (name, found) in zip(lines, maps.items(), strict=True):
        axes = line.subplots(1, 5, sharey=True)
        of_neighbours = found.unflatten(-1, (4, -1)).sum(-1)
        for axis, t in zip(axes, (3, 2, 1, 0), strict=False):
            title = f"{name}: weight, {_NEIGHBOURS[t]}"
            picture = _draw(axis, of_neighbours[..., t], truth, columns, title, cmap="magma", vmin=0, vmax=1)
        line.colorbar(picture, ax=axes[3], pad=0.02).ax.tick_params(labelsize=7)
        count = found.shape[-1]
        title = f"{name}: entropy of {count} [bits]"
        picture = _draw(axes[4], bits[name], truth, columns, title, cmap="cividis", vmin=0, vmax=math.log2(count))
        line.colorbar(picture, ax=axes[4], pad=0.02).ax.tick_params(labelsize=7)
        axes[0].set_ylabel("elevation [°]", fontsize=8)
    axis, bars, words = bottom.subplots(1, 3, width_ratios=(1.2, 3, 1))
    depth = _draw_truth(axis, truth, columns)
    bottom.colorbar(depth, ax=axis, pad=0.02).ax.tick_params(labelsize=7)
    axis.set_title("truth: range [m]", fontsize=9)
    axis.set_xlabel("azimuth [°]", fontsize=8)
    axis.set_ylabel("elevation [°]", fontsize=8)
    kinds, spread = _unique(rows, "of"), _unique(rows, "spread")
    for number, kind in enumerate(kinds):
        here = [row for row in rows if row["of"] == kind]
        at, colour = np.arange(len(spread)) + 0.27 * (number - (len(kinds) - 1) / 2), SERIES[number]
        for suffix, shift, alpha in (("right to 5 cm", -0.06, 0.45), ("wrong", 0.06, 1.0)):
            values = [row[f"entropy [bits], {suffix}"] for row in here]
            label = f"{here[0]['model']}: {kind}, {suffix}"
            bars.bar(at + shift, values, 0.12, color=colour, alpha=alpha, label=label)
    bars.set_xticks(range(len(spread)), spread, fontsize=8)
    bars.set_ylabel("entropy [bits]", fontsize=8)
    bars.set_title("by spread of the four neighbours", fontsize=9)
    words.axis("off")
    words.legend(*bars.get_legend_handles_labels(), fontsize=8, loc="center left")
    figure.savefig(path, dpi=80)


def heads(means: Mapping[str, np.ndarray], path: Path) -> None:
    """Draws attention maps (heads, 4, 4), means over the queries of each spread."""
    count = len(next(iter(means.values())))
    figure = Figure(figsize=(1.3 * count + 1.5, 1.5 * len(means)), layout="constrained")
    grid = figure.subplots(len(means), count, squeeze=False)
    for number, (line, (words, maps)) in enumerate(zip(grid, means.items(), strict=True)):
        for head, (axis, found) in enumerate(zip(line, maps, strict=True)):
            # As one reads: upper left, upper right, lower left, lower right.
            picture = axis.imshow(found[::-1, ::-1], cmap="magma", vmin=0, vmax=1)
            axis.set_xticks(range(4), ["ul", "ur", "ll", "lr"], fontsize=6)
            axis.set_yticks(range(4), ["ul", "ur", "ll", "lr"], fontsize=6)
            if number == 0:
                axis.set_title(f"head {head + 1}", fontsize=9)
        line[0].set_ylabel(words, fontsize=8)
    figure.colorbar(picture, ax=list(grid.flatten()), label="attention", pad=0.01)
    figure.suptitle("which neighbour (row) attends to which (column): upper or lower, left or right", fontsize=9)
    figure.savefig(path, dpi=90)


def precision(rows: Sequence[Mapping[str, Any]], moves: Mapping[tuple[str, str], np.ndarray], path: Path) -> None:
    """Draws how far bfloat16 moves the answers of each network, as a distribution, and the IoU either way.

    Args:
        rows: Those of the experiment.
        moves: Distances [cm] between the answers, by model and size.
        path: A picture file.
    """
    names, sizes = _unique(rows, "model"), _unique(rows, "size")
    figure = Figure(figsize=(10, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    shares = np.linspace(0, 1, 400)
    for name in names:
        found = np.quantile(moves[name, sizes[-1]], shares).clip(1e-3)
        left.plot(found, shares, color=_COLOURS[name], label=name)
    left.set_xscale("log")
    left.set_xlim(1e-3, 100)
    left.set_xlabel(f"moved by at most [cm], {sizes[-1]}")
    left.set_ylabel("share of the returns")
    left.grid(alpha=0.3)
    left.legend(fontsize=8)
    cases = [(row["model"], row["size"]) for row in rows]
    for shift, kind, hatch in ((-0.2, "float32", None), (0.2, "bfloat16", "////")):
        colours = [_COLOURS[name] for name, _ in cases]
        values = [row[f"IoU, {kind}"] for row in rows]
        at = np.arange(len(cases)) + shift
        right.bar(at, values, 0.38, color=colours, hatch=hatch, edgecolor="white", linewidth=0, label=kind)
    right.set_xticks(range(len(cases)), [f"{name}\n{size}" for name, size in cases], fontsize=7)
    right.set_ylabel("IoU")
    right.legend(fontsize=8)
    figure.savefig(path, dpi=100)

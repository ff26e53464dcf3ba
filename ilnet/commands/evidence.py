"""Experiments of `iln-surfaces`: what each of its parts is worth, what its confidence says, and other sensors."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ilnet import models
from ilnet.commands import variants
from ilnet.commands.study import FIGURES, SERIES, Study, by_case, grouped_bars, loaded
from ilnet.learning import calibration, evaluate, metrics, train
from ilnet.scan import Scan
from ilnet.sensor import PAPER_INPUT, Sensor, preset
from ilnet.world import simulate

__all__ = ["VARIANT_KEYS", "confidence", "means", "sensors", "surfaces"]

VARIANT_KEYS = "variant", "size"
"""The columns that tell the cases of `surfaces` apart."""
# Share of the returns that is left out, those with the least confidence.
_LEFT_OUT = 0.1
_EVEN_TURN = np.deg2rad(np.linspace(-180, 180, 1800, endpoint=False))
# Sensors whose scans are predicted from half of their beams.
_SENSORS = (
    preset("vlp-16"),
    Sensor(np.deg2rad(np.linspace(-30.67, 10.67, 32)), _EVEN_TURN, 1.0, 100.0, 120.0, name="hdl-32e"),
    preset("hdl-64e"),
    preset("os0-128"),
    # Beams are 0.6° apart at the horizon, 2.4° at the bottom and 1.5° at the top.
    Sensor(np.deg2rad(7 * np.sinh(np.linspace(-2, 1.5, 40))), _EVEN_TURN, 0.5, 120.0, 150.0, name="uneven-40"),
)


def surfaces(study: Study) -> None:
    """Ours: a small `iln-surfaces` for the paper's input sensor, one part replaced in each variant, and oracles.

    *ranges* weighs the 4 measured ranges, as the paper does, instead of 36 continued ones. *L1* trains by the error of
    the weighted mean and answers with it; *mean* answers so with the weights of *surfaces*. *one channel* sees nothing
    but the range. *any sensor* learns from sensors that are made up, in as many steps. An oracle knows the truth and
    chooses the nearest of what the network may choose from.
    """
    rows, sizes = [], study.sizes[:2]
    for seed in range(study.seeds):
        found: dict[str, models.Model] = {}
        for name, options in variants.VARIANTS.items():
            label = f"surfaces-{name.replace(' ', '-')}-{seed}"
            file = study.trained(label, "iln-surfaces", seed=seed, validations=4, **variants.SIZE, **options)
            found[name] = variants.blended(file) if name == "L1" else models.load(file)
            if name == "surfaces":
                found["mean"] = variants.blended(file)
        rows += [{"variant": row["model"], "seed": seed, **_brief(row)} for row in study.compare(found, sizes)]
    for size in sizes:
        pairs = study.pairs(PAPER_INPUT.resize(*size))
        for name, figures in variants.ceilings(pairs).items():
            scans = {"size": pairs[0][1].sensor.size, "scans": len(pairs)}
            rows.append({"variant": f"oracle: {name}", "seed": "", **_brief({**scans, **figures})})
    study.write("surfaces", rows)
    _draw_variants(study, rows)


def _brief(row: Mapping[str, Any]) -> dict[str, Any]:
    return {key: row[key] for key in ("size", "scans", *FIGURES)}


def _draw_variants(study: Study, rows: Sequence[Mapping[str, Any]]) -> None:
    """Draws the means of each figure over the seeds, and their spans."""
    figure = Figure(figsize=(10, 3.6), layout="constrained")
    found = by_case(rows, VARIANT_KEYS)
    names, sizes = (list(dict.fromkeys(case)) for case in zip(*found, strict=True))
    for axis, (key, words) in zip(figure.subplots(1, len(FIGURES), sharey=True), FIGURES.items(), strict=True):
        for (name, size), figures in found.items():
            values, number = figures[key], sizes.index(size)
            at, colour = names.index(name) + 0.3 * number, SERIES[number]
            axis.plot([min(values), max(values)], [at, at], color=colour)
            face = "white" if name.startswith("oracle") else colour
            label = size if name == names[0] else None
            axis.plot(np.mean(values), at, "o", color=colour, markerfacecolor=face, label=label)
        axis.set_xlabel(words)
        axis.grid(axis="x", alpha=0.3)
    axis.set_yticks(range(len(names)), names)
    axis.invert_yaxis()
    axis.legend(fontsize=8)
    figure.savefig(study.out / "surfaces.png", dpi=120)


def means(rows: Sequence[Mapping[str, Any]]) -> dict[tuple[str, ...], dict[str, float]]:
    """Returns the mean of each figure over the seeds, by variant and size, given the rows of `surfaces`."""
    found = by_case(rows, VARIANT_KEYS)
    return {case: {key: float(np.mean(values)) for key, values in of.items()} for case, of in found.items()}


def confidence(study: Study) -> None:
    """Ours: of the points that `iln-surfaces` is sure of to some degree, the share that is right to 10 cm.

    Scans are those held out of the training towns: the paper's input, and three sensors with a quarter of their beams.
    Directions that the input holds itself are left out of the reliability. Then the least confident tenth of the
    returns is dropped.
    """
    [model] = loaded({"iln-surfaces": study.networks()["iln-surfaces"]}).values()
    others = [preset(name) for name in train.HELD_OUT_SENSORS]
    kinds = {"paper": (PAPER_INPUT, train.VALIDATION)}
    kinds |= {sensor.name: (sensor.decimate(sensor.shape[0] // 4), sensor) for sensor in others}
    asked = [(source, wanted, train.HELD_OUT_SCANS) for source, wanted in kinds.values()]
    rows, curves = [], {}
    for name, pairs in zip(kinds, train.held_out_pairs(asked, simulate.best_device()), strict=True):
        frames = models.Upsampler(model, pairs[0][0].sensor, pairs[0][1].sensor, device=pairs[0][0].ranges.device)
        answers = [frames(scan) for scan, _ in pairs]
        told = calibration.told(answers, pairs)
        curves[name] = bins = calibration.reliability(*told)
        shares = {f"right at {b.least:.1f}": b.right for b in bins}
        rows.append(
            {
                "sensor": name,
                "size": pairs[0][1].sensor.size,
                "scans": len(pairs),
                "confidence": told[0].mean().item(),
                "right": told[1].float().mean().item(),
                "calibration error": calibration.calibration_error(bins),
                **_without_least(answers, [truth for _, truth in pairs]),
                **{f"right at {k / calibration.BINS:.1f}": "" for k in range(calibration.BINS)},
                **shares,
            }
        )
    study.write("confidence", rows)
    figure = Figure(figsize=(4.5, 4), layout="constrained")
    axis = figure.subplots()
    axis.plot([0, 1], [0, 1], color="#999999", linewidth=1)
    for (name, bins), colour in zip(curves.items(), SERIES, strict=False):
        axis.plot([b.confidence for b in bins], [b.right for b in bins], "o-", markersize=3, label=name, color=colour)
    axis.set_xlabel("confidence")
    axis.set_ylabel("share right to 10 cm")
    axis.legend(fontsize=8)
    figure.savefig(study.out / "confidence.png", dpi=120)


def _without_least(answers: Sequence[Scan], truths: Sequence[Scan]) -> dict[str, float]:
    """Returns the share of floating points that goes with the least confident returns, and what else changes."""
    figures = {}
    kept = [calibration.without_least(answer, _LEFT_OUT) for answer in answers]
    floating = [
        sum(int(metrics.floating(scan.ranges, truth).sum()) for scan, truth in zip(scans, truths, strict=True))
        for scans in (answers, kept)
    ]
    figures["floating points gone"] = 1 - floating[1] / max(floating[0], 1)
    for words, scans in (("", answers), (" of the rest", kept)):
        mean = metrics.ScanMetrics().to(truths[0].ranges.device)
        for scan, truth in zip(scans, truths, strict=True):
            mean.update(scan.ranges, truth)
        figures |= {key + words: mean.compute()[key].item() for key in ("floating", "recall", "iou")}
    return figures


def sensors(study: Study) -> None:
    """Ours: other sensors, in the test towns; half of their beams are kept, and all are predicted."""
    files = {"planes": "planes"} | {name: study.networks()[name] for name in ("iln", "iln-surfaces")}
    rows = []
    for sensor in _SENSORS:
        source = sensor.decimate(sensor.shape[0] // 2)
        measured = evaluate.measure(loaded(files), study.pairs(sensor, source))
        rows += [{"sensor": sensor.name, "beams": source.shape[0], **row} for row in measured]
    study.write("sensors", rows)
    grouped_bars(study, "sensors", rows, [f"{row['sensor']}\nfrom {row['beams']} beams" for row in rows])

"""The command `experiment`: experiments of the paper (Sec. III) and ours. Each writes numbers, a figure and a page.

Trained networks stay in the output folder, so that an interrupted experiment goes on where it stopped, and experiments
share their networks. Test scans come from towns 07 and 10, in which nothing is trained or chosen.
"""

import csv
import inspect
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ilnet import data, models, scan_files
from ilnet.commands import evidence, fair, odometry, plot, thin, where
from ilnet.commands.study import COLOURS, SERIES, Study, grouped_bars, loaded, made_with, spans
from ilnet.learning import evaluate
from ilnet.sensor import PAPER_INPUT, format_size
from ilnet.world import towns

__all__ = ["EXPERIMENTS", "results"]

# The paper's Table II: MAE [m], IoU, precision, recall, F1 in CARLA's towns 07 and 10.
PAPER = {
    "64x1024": {
        "lidar-sr": (1.560, 0.233, 0.370, 0.377, 0.373),
        "bilinear": (2.372, 0.202, 0.322, 0.328, 0.325),
        "liif": (1.558, 0.258, 0.403, 0.409, 0.406),
        "iln": (1.536, 0.329, 0.483, 0.486, 0.484),
    },
    "128x2048": {
        "lidar-sr": (1.746, 0.161, 0.262, 0.288, 0.274),
        "bilinear": (2.591, 0.165, 0.268, 0.287, 0.277),
        "liif": (1.714, 0.236, 0.372, 0.388, 0.379),
        "iln": (1.690, 0.331, 0.483, 0.498, 0.491),
    },
    "256x4096": {
        "lidar-sr": (1.735, 0.127, 0.207, 0.245, 0.224),
        "bilinear": (2.646, 0.163, 0.256, 0.303, 0.277),
        "liif": (1.923, 0.158, 0.221, 0.356, 0.272),
        "iln": (1.763, 0.232, 0.353, 0.396, 0.373),
    },
}

# The networks whose training is followed, and how their curves are drawn.
_CONVERGING = {"liif": "--", "iln": "-", "iln-surfaces": "-."}


def table(study: Study) -> None:
    """The paper's Table II: all methods at three sizes."""
    rules: dict[str, str | Path] = {name: name for name in ("nearest", "bilinear", "bilinear-inverse", "planes")}
    archive = data.open_archive(study.archive) if study.archive else None
    if isinstance(archive, data.RangeImageTree):
        _table_of_tree(study, archive.path, {name: name for name in study.named} or rules | study.networks())
        return
    if study.named:
        raise ValueError("models are named; that goes with a tree of .rimg files")
    networks = study.networks()
    stored = archive.sensors if archive else {}
    methods, rows = {}, []
    for size in study.sizes:
        lidar_sr = {}
        if format_size(size) in stored:
            file = study.trained(f"lidar-sr-{size[0]}", "lidar-sr", archive=study.archive, target=size)
            lidar_sr = {"lidar-sr": file}
        methods[size] = rules | lidar_sr | networks
        for row in study.compare(methods[size], [size]):
            card = models.card(methods[size][row["model"]])
            rows.append(row | {key: card.get(key, "") for key in ("steps", "minutes")})
    study.write("table", rows)
    _draw_table(study, rows)
    _draw_points(study, study.sizes[1], methods[study.sizes[1]])


def _table_of_tree(study: Study, tree: Path, files: Mapping[str, str | Path]) -> None:
    """The same on a tree of the paper's authors, at each of its sizes."""
    compared, rows = loaded(files), []
    for pairs in evaluate.stored_pairs(tree, count=study.stored_scans):
        for row in evaluate.measure(compared, pairs):
            # A checkpoint of the authors has no card.
            about = {} if str(row["model"]).endswith(".pth") else models.card(files[row["model"]])
            trained = {key: about.get(key, "") for key in ("steps", "minutes")}
            rows.append({**row, "input": pairs.sizes[0], **trained})
    study.write("table", rows)
    _draw_table(study, rows)


def _draw_table(study: Study, rows: Sequence[dict[str, Any]]) -> None:
    figure = Figure(figsize=(10, 3.2), layout="constrained")
    sizes = list(dict.fromkeys(row["size"] for row in rows))
    for axis, name in zip(figure.subplots(1, len(sizes), sharey=True, squeeze=False)[0], sizes, strict=True):
        found = {row["model"]: row["iou"] for row in rows if row["size"] == name}
        axis.bar(list(found), list(found.values()), color=[COLOURS.get(name, "#cccccc") for name in found])
        theirs = {model: figures[1] for model, figures in PAPER.get(name, {}).items() if model in found}
        axis.plot(list(theirs), list(theirs.values()), "k_", markersize=18, label="the paper, on CARLA")
        axis.set_title(name)
        axis.tick_params("x", rotation=60, labelsize=8)
    axis.legend(fontsize=8)
    figure.axes[0].set_ylabel("IoU")
    figure.savefig(study.out / "table.png", dpi=120)


def _draw_points(study: Study, size: tuple[int, int], files: Mapping[str, str | Path]) -> None:
    """Draws the same crop of a test scan by every method, as points."""
    for town in towns.TEST:
        [(sparse, dense)] = evaluate.town_pairs(town, 1, PAPER_INPUT.resize(*size))
        shown = {"input": sparse}
        for name, file in files.items():
            shown[name] = models.load(file).to(sparse.ranges.device).upsample(sparse, dense.sensor)
        plot.point_clouds({**shown, "truth": dense}, study.out / f"points-{town}.png", reach=20.0)


def convergence(study: Study) -> None:
    """The paper's figure of convergence: test figures during training, over several seeds."""
    rows: list[dict[str, Any]] = []
    for name in _CONVERGING:
        for seed in range(study.seeds):
            folder = study.followed(name, seed).parent
            rows += [{"model": name, "seed": seed, **row} for row in _probed(folder / name)]
    study.write("convergence", rows)
    _draw_convergence(study, rows)


def _draw_convergence(study: Study, rows: Sequence[Mapping[str, Any]]) -> None:
    """Draws IoU by step and by minute, and MAE by step: means over the seeds, and their spans."""
    figure = Figure(figsize=(10, 3.2), layout="constrained")
    for axis, (x, y) in zip(figure.subplots(1, 3), (("step", "iou"), ("seconds", "iou"), ("step", "mae")), strict=True):
        for name, style in _CONVERGING.items():
            runs = [{r["step"]: r for r in rows if r["model"] == name and r["seed"] == s} for s in range(study.seeds)]
            steps = sorted(set.intersection(*(set(run) for run in runs)))
            values = np.array([[run[step][y] for step in steps] for run in runs])
            at = np.mean([[run[step][x] for step in steps] for run in runs], axis=0)
            at = at / 60 if x == "seconds" else at
            axis.plot(at, values.mean(0), style, color=COLOURS[name], label=name)
            axis.fill_between(at, values.min(0), values.max(0), color=COLOURS[name], alpha=0.25, linewidth=0)
        axis.set_xlabel({"step": "step", "seconds": "minutes"}[x])
        axis.set_ylabel({"iou": "IoU", "mae": "MAE [m]"}[y])
    axis.set_yscale("log")
    axis.yaxis.set_major_formatter("{x:g}")
    axis.yaxis.set_minor_formatter("{x:g}")
    axis.legend()
    figure.savefig(study.out / "convergence.png", dpi=120)


def _probed(folder: Path) -> list[dict[str, Any]]:
    """Returns the test figures that a training logged, each step once even if it was interrupted.

    The `seconds` follow from its median pace, validations included, so that halts and other work on the machine do not
    count.
    """
    found: dict[int, dict[str, Any]] = {}
    for log in folder.glob("from-step-*/metrics.csv"):
        with open(log, newline="") as file:
            for row in csv.DictReader(file):
                if row.get("test/iou"):
                    step = int(row["step"]) + 1
                    figures = {key: float(row[f"test/{key}"]) for key in ("mae", "iou", "floating")}
                    found.setdefault(step, {"step": step, "seconds": float(row["seconds"]), **figures})
    steps = sorted(found)
    passed = np.diff([0.0] + [found[step]["seconds"] for step in steps])
    pace = float(np.median(passed / np.diff([0, *steps])))
    return [found[step] | {"seconds": step * pace} for step in steps]


def steps_to_reach(rows: Sequence[dict[str, Any]], share: float = 0.1) -> dict[str, float]:
    """Compares how many steps LIIF and ILN take to the IoU that ILN has after a share of its budget.

    Args:
        rows: Rows of `convergence`; figures are means over their seeds.
        share: Share of ILN's steps, 0 to 1.

    Returns:
        `iou` of ILN then, its steps `iln_steps`, `liif_steps` (infinite if LIIF never gets there), and their `ratio`.
    """
    curves: dict[str, dict[int, float]] = {}
    for name in ("liif", "iln"):
        at: dict[int, list[float]] = {}
        for row in rows:
            if row["model"] == name:
                at.setdefault(int(row["step"]), []).append(float(row["iou"]))
        curves[name] = {step: float(np.mean(at[step])) for step in sorted(at)}
    iln_steps = min(step for step in curves["iln"] if step >= share * max(curves["iln"]))
    iou = curves["iln"][iln_steps]
    liif_steps = min((step for step, value in curves["liif"].items() if value >= iou), default=math.inf)
    return {"iou": iou, "iln_steps": iln_steps, "liif_steps": liif_steps, "ratio": liif_steps / iln_steps}


def attention(study: Study) -> None:
    """The paper's ablation of the number D of attention blocks."""
    rows = []
    for depth in (0, 1, 2, 4):
        file = study.followed("iln") if depth == 1 else study.trained(f"iln-d{depth}", "iln", depth=depth)
        model = models.load(file)
        seconds = _frame_time(model)
        parameters = sum(weight.numel() for weight in model.parameters())
        for row in study.compare({"iln": file}):
            rows.append({"depth": depth, "parameters": parameters, "seconds_128x2048": seconds, **row})
    study.write("attention", rows)
    _bars(study, "attention", rows, "depth", "attention blocks D")


def _frame_time(model: models.Model) -> float:
    [(scan, truth)] = evaluate.town_pairs(towns.TEST[0], 1, PAPER_INPUT.resize(*Study.sizes[1]))
    device = scan.ranges.device
    frames = models.Upsampler(model.to(device), scan.sensor, truth.sensor, device=device)
    seconds = []
    for _ in range(4):
        start = time.perf_counter()
        frames.ranges(scan).cpu()
        seconds.append(time.perf_counter() - start)
    return min(seconds)


def rays(study: Study) -> None:
    """Ours: the same budget on stored images, as in the paper, and on rays at continuous directions."""
    if study.archive is None:
        raise ValueError(
            f"stored images are missing: make some with `python -m ilnet simulate --towns {','.join(towns.TRAIN)} "
            "--scans 2000 --sizes 16x1024,64x1024,128x2048 --out DIR`, and name them with --data DIR"
        )
    files = {
        "continuous": study.followed("iln"),
        "stored": study.trained("iln-stored", "iln", archive=study.archive),
    }
    rows = [{"rays": kind, **row} for kind, file in files.items() for row in study.compare({"iln": file})]
    study.write("rays", rows)
    _bars(study, "rays", rows, "rays", "learned from")


def _bars(study: Study, name: str, rows: Sequence[dict[str, Any]], by: str, title: str) -> None:
    """Draws IoU and MAE by size, for each kind that stands in column `by`."""
    figure = Figure(figsize=(9, 3), layout="constrained")
    for axis, (key, words) in zip(figure.subplots(1, 2), (("iou", "IoU"), ("mae", "MAE [m]")), strict=True):
        kinds = list(dict.fromkeys(str(row[by]) for row in rows))
        for number, kind in enumerate(kinds):
            chosen = [row for row in rows if str(row[by]) == kind]
            at = np.arange(len(chosen)) + (number - (len(kinds) - 1) / 2) * 0.8 / len(kinds)
            axis.bar(at, [row[key] for row in chosen], 0.8 / len(kinds), label=kind, color=SERIES[number])
        axis.set_xticks(range(len(chosen)), [row["size"] for row in chosen])
        axis.set_ylabel(words)
    axis.legend(title=title, fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5), frameon=False)
    figure.savefig(study.out / f"{name}.png", dpi=120)


def real(study: Study) -> None:
    """Ours: measured scans that no network saw; some beams are kept, and all are predicted."""
    if not study.measured:
        raise ValueError("no measured scans are named: give some with --measured FILE, such as frames of your sensor")
    files: dict[str, str | Path] = {name: name for name in ("bilinear", "bilinear-inverse", "planes")}
    files |= study.networks()
    compared = loaded(files)
    rows = []
    for path in study.measured:
        beams = scan_files.read(path).sensor.shape[0]
        for kept in [count for count in (8, 16, 32) if beams // 16 <= count < beams][-2:]:
            pair = evaluate.scan_pair(path, kept)
            rows += [{"scan": path.stem, "beams": kept, **row} for row in evaluate.measure(compared, [pair])]
    study.write("real", rows)
    grouped_bars(study, "real", rows, [f"{row['scan']}\n{row['beams']} beams" for row in rows])


EXPERIMENTS: dict[str, Callable[[Study], None]] = {
    "table": table,
    "convergence": convergence,
    "attention": attention,
    "rays": rays,
    "real": real,
    "surfaces": evidence.surfaces,
    "confidence": evidence.confidence,
    "sensors": evidence.sensors,
    "fair": fair.fair,
    "alignment": fair.alignment,
    "where": where.where,
    "odometry": odometry.odometry,
    "thin": thin.thin,
}


def results(study: Study) -> Path:
    """Writes RESULTS.md, with tables and figures of all experiments in the folder so far; returns its path."""
    made = made_with(study.out)
    done = {name: _read(study.out / f"{name}.csv") for name in EXPERIMENTS if name in made}
    lines = ["# Results", "", "Ratios of figures on the test towns, and of IoU on measured scans:", ""]
    lines += _markdown(ratios(done))
    for name, rows in done.items():
        lines += ["", f"## {name}", "", inspect.getdoc(EXPERIMENTS[name]) or "", ""]
        lines += [f"Made with {made[name]['networks']}{_by(made[name])}.", "", f"![{name}]({name}.png)", ""]
        lines += _markdown(_shown(name, rows))
        for part in (part for part in made if part.startswith(f"{name}-")):
            lines += ["", f"### {part}", "", f"![{part}]({part}.png)", ""]
            lines += _markdown(_read(study.out / f"{part}.csv"))
        if name == "table" and "input" not in rows[0]:  # a tree has no test towns
            lines += ["", *(f"![The same crop by every method, {town}](points-{town}.png)" for town in towns.TEST)]
    page = study.out / "RESULTS.md"
    page.write_text("\n".join(lines).rstrip() + "\n")
    return page


def _by(about: Mapping[str, Any]) -> str:
    """Returns by which command, at which commit and in how many minutes an experiment was made."""
    if "command" not in about:
        return ""
    trained = f", after trainings of {about['training_minutes']}" if "training_minutes" in about else ""
    return f", by `{about['command']}` at commit {about['commit']}, in {about['minutes']} minutes{trained}"


def ratios(done: Mapping[str, Sequence[dict[str, Any]]]) -> list[dict[str, str]]:
    """Returns one row for each ratio that the experiments are about, with the paper's beside ours.

    Args:
        done: Rows of the experiments `table`, `convergence`, `real`, `sensors` and `surfaces`, by name; those that were
            run.
    """
    found: list[dict[str, str]] = []

    def add(figure: str, one: dict[str, Any], other: dict[str, Any], key: str, paper: float | None = None) -> None:
        ours = f"{float(one[key]) / float(other[key]):.2f}" if float(other[key]) else "over 0"
        found.append({"figure": figure, "the paper": f"{paper:.2f}" if paper else "", "ours": ours})

    table = {(row["model"], row["size"]): row for row in done.get("table", ())}
    for key, words in (("iou", "IoU"), ("mae", "MAE")):
        column = {"mae": 0, "iou": 1}[key]
        for one, other in (("iln", "liif"), ("iln", "bilinear"), ("iln-surfaces", "iln"), ("iln-surfaces", "planes")):
            for size, paper in PAPER.items():
                if {(one, size), (other, size)} <= table.keys():
                    theirs = paper[one][column] / paper[other][column] if {one, other} <= paper.keys() else None
                    add(f"{words} of {one} over {other}, {size}", table[one, size], table[other, size], key, theirs)
    if "convergence" in done:
        reached = steps_to_reach(done["convergence"])
        figure = f"steps of liif to the IoU {reached['iou']:.3f} that iln has after {reached['iln_steps']}, over those"
        ours = "never in its budget" if math.isinf(reached["ratio"]) else f"{reached['ratio']:.1f}"
        found.append({"figure": figure, "the paper": "much more", "ours": ours})
    for experiment, by in (("real", "scan"), ("sensors", "sensor")):
        cases = {(row["model"], row[by], row["beams"], row["size"]): row for row in done.get(experiment, ())}
        for key, words in (("iou", "IoU"), ("mae", "MAE")):
            for model, *case in cases:
                if model == "iln-surfaces":
                    figure = f"{words} of iln-surfaces over planes, {case[0]}, {case[1]} beams -> {case[2]}"
                    add(figure, cases[model, *case], cases["planes", *case], key)
    variants = evidence.means(done.get("surfaces", ()))
    for variant, size in variants:
        if variant in ("ranges", "L1", "mean", "one channel", "any sensor"):
            figure = f"IoU of surfaces over that of its variant {variant}, {size}"
            add(figure, variants["surfaces", size], variants[variant, size], "iou")
    return found


def _read(file: Path) -> list[dict[str, Any]]:
    with open(file, newline="") as text:
        return list(csv.DictReader(text))


def _shown(name: str, rows: Sequence[dict[str, Any]]) -> Sequence[dict[str, Any]]:
    """Returns what the page shows of an experiment: of a convergence, its end; of several seeds, means and spans."""
    if name == "convergence":
        last = max(int(row["step"]) for row in rows)
        return [row for row in rows if int(row["step"]) == last]
    if name in (keys := {"surfaces": evidence.VARIANT_KEYS, "fair": fair.FAIR_KEYS}):
        return spans(rows, keys[name])
    return _beside_the_paper(rows) if name == "table" else rows


def _beside_the_paper(rows: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Returns the rows with the paper's MAE and IoU, where it reports them."""
    found = []
    for row in rows:
        theirs = PAPER.get(row["size"], {}).get(row["model"])
        found.append({**row, "mae, paper": theirs[0] if theirs else "", "iou, paper": theirs[1] if theirs else ""})
    return found


def _markdown(rows: Sequence[dict[str, Any]]) -> list[str]:
    if not rows:
        return []
    head = list(rows[0])
    return [
        "| " + " | ".join(map(str, line)) + " |" for line in (head, ["---"] * len(head), *(r.values() for r in rows))
    ]

"""The experiment `where`: in which queries the IoU is won, how sharp jumps are, and what the weights look like.

Each part writes a table and a picture of its own: `where` for shares by the spread of the neighbours, and
`where-errors`, `where-jumps`, `where-weights`, `where-attention` and `where-precision`. The spread of a query is the
farthest of its four neighbours' ranges less the nearest, where no return counts as `norm_range`, as networks see it.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from tqdm import tqdm  # type: ignore[import-untyped]

from ilnet import models
from ilnet.commands import where_pictures
from ilnet.commands.study import Study, loaded
from ilnet.commands.variants import surface_weights
from ilnet.learning import metrics
from ilnet.models import ILN, Surfaces
from ilnet.models.base import OFFSET_SCALE
from ilnet.scan import Scan
from ilnet.sensor import PAPER_INPUT
from kernels import gather_neighbours, reference

__all__ = ["JUMP", "attention_maps", "entropy", "jumps", "rises", "shares", "signed", "spread", "weights", "where"]

SPREADS = {"below 0.2 m": 0.2, "0.2 to 2 m": 2.0, "2 to 10 m": 10.0, "above 10 m": math.inf}
"""The bins of the spread, and where each ends [m]."""
_WITHIN = (0.02, 0.05, 0.1)  # metres
_RIGHT = 0.05  # metres
JUMP = 2.0
"""Two true ranges that are measured side by side and differ by more jump [m]."""
# Queries from one measured column to the next, and measured columns before and behind a jump that are looked at.
_FINE = 16
_AROUND = 2
# A jump goes from one surface to another if all behind and before it lies within this share of it.
_FLAT = 0.1
# Queries that are decoded at a time where activations are kept.
_TILE = 16384


@dataclass(frozen=True)
class _Asked:
    """What is predicted at one size, and by whom."""

    size: str
    pairs: list[tuple[Scan, Scan]]
    bins: list[torch.Tensor]
    """For each pair (H, W), the number of the bin of `SPREADS` that each query is in."""
    answers: dict[str, list[torch.Tensor]]
    """For each model and pair (H, W) metres."""


def where(study: Study) -> None:
    """Ours: where the IoU comes from.

    *where* has, by the spread of a query's four neighbours, the share of queries whose answer is right to 2, 5 and
    10 cm, and what they add to the IoU: a voxel belongs to the least spread in it. *where-errors* has the share of
    answers that are more than 5 cm too near and too far. *where-jumps* has the columns in which an answer goes from
    10 to 90 % of a jump of more than 2 m between two measured columns, and how far it is from its true place.
    *where-weights* has the entropy of the predicted weights, and *where-attention* what the heads of `iln` attend to:
    a neighbour itself, or the others of the four. *where-precision* has how far bfloat16 moves the answers.
    """
    networks = loaded(study.networks())
    methods = loaded({"bilinear-inverse": "bilinear-inverse", "planes": "planes"}) | networks
    asked = []
    for size in study.sizes[:2]:
        pairs = study.pairs(PAPER_INPUT.resize(*size))
        bins = [_bins(spread(*pair)) for pair in pairs]
        asked.append(_Asked(pairs[0][1].sensor.size, pairs, bins, _answers(methods, pairs)))
    _spreads(study, asked)
    _errors(study, asked)
    _jumps(study, methods)
    _weights(study, asked[-1], networks)
    _precision(study, asked, networks)


def _answers(
    methods: Mapping[str, models.Model], pairs: Sequence[tuple[Scan, Scan]], precision: str = "float32"
) -> dict[str, list[torch.Tensor]]:
    (source, target), device = (scan.sensor for scan in pairs[0]), pairs[0][0].ranges.device
    found: dict[str, list[torch.Tensor]] = {}
    with tqdm(total=len(methods) * len(pairs), unit="scan", desc=f"where {target.size}") as progress:
        for name, model in methods.items():
            frames = models.Upsampler(model, source, target, precision, device)
            found[name] = []
            for scan, _ in pairs:
                found[name].append(frames.ranges(scan))
                progress.update()
    return found


def spread(scan: Scan, truth: Scan) -> torch.Tensor:
    """Returns the farthest of the four neighbours' ranges less the nearest, (H, W) [m], for the rays of the truth."""
    queries = scan.sensor.grid_queries(truth.sensor).view(1, -1, 2).to(scan.ranges.device)
    ranges, _ = gather_neighbours(scan.filled()[None, None], queries, scan.sensor.wrap)
    return (ranges.amax((2, 3)) - ranges.amin((2, 3))).view(truth.sensor.shape)


def _bins(spreads: torch.Tensor) -> torch.Tensor:
    return torch.bucketize(spreads, torch.tensor(list(SPREADS.values())[:-1], device=spreads.device), right=True)


def shares(answer: torch.Tensor, truth: Scan, bins: torch.Tensor) -> list[dict[str, int]]:
    """Measures the queries of each bin.

    Args:
        answer: (H, W) predicted ranges [m].
        truth: The true scan.
        bins: (H, W), the number of the bin that each query is in.

    Returns:
        For each bin the number of true `returns` in it, the numbers of answers within 2, 5 and 10 cm of them, and the
        numbers of voxels: `true` ones, those `hit` by a predicted point, and `false` ones that only the prediction has.
        A voxel is in the first bin that has a point in it.
    """
    sensor, right = truth.sensor, truth.filled()
    returned, error = sensor.sees(right), (answer - right).abs()
    predicted, true = (metrics.voxels(metrics.cloud(ranges, sensor)) for ranges in (answer, right))
    found, known = [], [predicted[:0], true[:0]]
    for number in range(len(SPREADS)):
        mask = bins == number
        counts = {"returns": int((mask & returned).sum())}
        counts |= {f"within {100 * b:g} cm": int((mask & returned & (error <= b)).sum()) for b in _WITHIN}
        new = []
        for at, ranges in enumerate((answer, right)):
            voxels = metrics.voxels(metrics.cloud(ranges.where(mask, 0.0), sensor))
            new.append(voxels[~torch.isin(voxels, known[at])])
            known[at] = torch.cat((known[at], new[-1]))
        counts |= {"true": len(new[1]), "hit": int(torch.isin(new[1], predicted).sum())}
        counts["false"] = int((~torch.isin(new[0], true)).sum())
        found.append(counts)
    return found


def _spreads(study: Study, asked: Sequence[_Asked]) -> None:
    rows = []
    for of in asked:
        for name, answers in of.answers.items():
            scans = [shares(a, truth, b) for a, (_, truth), b in zip(answers, of.pairs, of.bins, strict=True)]
            unions = [sum(counts["true"] + counts["false"] for counts in scan) for scan in scans]
            returns = sum(counts["returns"] for scan in scans for counts in scan)
            for number, words in enumerate(SPREADS):
                here = [scan[number] for scan in scans]
                count, true = (max(sum(counts[key] for counts in here), 1) for key in ("returns", "true"))
                row = {"size": of.size, "model": name, "spread": words, "scans": len(scans), "queries": count / returns}
                for key in (key for key in here[0] if key.startswith("within")):
                    row[key] = sum(counts[key] for counts in here) / count
                row["voxels hit"] = sum(counts["hit"] for counts in here) / true
                # The mean over the scans, as that of the IoU itself, so that the bins add up to it.
                for key, label in (("hit", "IoU from here"), ("true", "true voxels"), ("false", "false voxels")):
                    row[label] = float(np.mean([c[key] / max(u, 1) for c, u in zip(here, unions, strict=True)]))
                rows.append(row)
    study.write("where", rows)
    where_pictures.spreads(rows, study.out / "where.png")


def signed(answer: torch.Tensor, truth: Scan) -> torch.Tensor:
    """Returns the error (H, W) [m], above 0 where the answer is too far; NaN where nothing returns in truth."""
    right = truth.filled()
    return (answer - right).where(truth.sensor.sees(right), math.nan)


def _errors(study: Study, asked: Sequence[_Asked]) -> None:
    rows = []
    for of in asked:
        at_edge = torch.cat([metrics.edges(truth).flatten() for _, truth in of.pairs])
        for name, answers in of.answers.items():
            errors = torch.cat([signed(a, truth).flatten() for a, (_, truth) in zip(answers, of.pairs, strict=True)])
            for words, mask in (("at edges", at_edge), ("elsewhere", ~at_edge)):
                here = errors[mask & ~errors.isnan()].cpu().numpy()
                near, far = float((here < -_RIGHT).mean()), float((here > _RIGHT).mean())
                row = {"size": of.size, "model": name, "pixels": words, "too near": near, "right": 1 - near - far}
                row |= {"too far": far, "median [cm]": 100 * float(np.median(here))}
                rows.append(row | {"median of the absolute [cm]": 100 * float(np.median(abs(here)))})
    study.write("where-errors", rows)
    of = asked[-1]
    truth = of.pairs[0][1]
    maps = {name: 100 * signed(answers[0], truth) for name, answers in of.answers.items()}
    where_pictures.errors(maps, truth, sector(truth), study.out / "where-errors.png")


def sector(truth: Scan) -> slice:
    """Returns the eighth of the columns with the most pixels at edges, which pictures show."""
    count = truth.sensor.shape[1]
    parts = metrics.edges(truth).sum(0)[: count // 8 * 8].view(8, -1).sum(1)
    first = int(parts.argmax()) * (count // 8)
    return slice(first, first + count // 8)


def jumps(truth: torch.Tensor, far: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Finds where two measured columns lie on two surfaces, nothing else on them, and the truth jumps in between.

    Args:
        truth: (H, W) true ranges [m] on a full circle, of `_FINE` columns for each measured one.
        far: Ranges from here on [m] are no returns.

    Returns:
        The rows (N,) and the columns (N, K) of the windows: from two measured columns before the jump to two behind it.
    """
    count = truth.shape[1]
    near, behind = truth[:, ::_FINE], truth.roll(-_FINE, 1)[:, ::_FINE]
    jump = ((behind - near).abs() > JUMP) & (near < far) & (behind < far)
    row, column = jump.nonzero().unbind(1)
    steps = torch.arange(-_AROUND * _FINE, (_AROUND + 1) * _FINE + 1, device=truth.device)
    columns = (column.unsqueeze(1) * _FINE + steps).remainder(count)
    profile = _profile(truth, truth, row, columns)
    edge = _AROUND * _FINE + 1
    before, after = profile[:, :edge].abs().amax(1), (profile[:, -edge:] - 1).abs().amax(1)
    flat = (before < _FLAT) & (after < _FLAT)
    return row[flat], columns[flat]


def _profile(answer: torch.Tensor, truth: torch.Tensor, row: torch.Tensor, columns: torch.Tensor) -> torch.Tensor:
    """Returns answers in windows (N, K), as shares of the jump: 0 is the measured range before it, 1 that behind it."""
    ends = truth[row.unsqueeze(1), columns[:, [_AROUND * _FINE, (_AROUND + 1) * _FINE]]]
    return (answer[row.unsqueeze(1), columns] - ends[:, :1]) / (ends[:, 1:] - ends[:, :1])


def rises(profile: torch.Tensor, near: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor]:
    """Measures where profiles rise through a half, and how long they take from 0.1 to 0.9 there.

    Args:
        profile: (N, K), shares of a jump.
        near: (N,) positions; of several rises that nearest to it is taken. By default the middle.

    Returns:
        The positions (N,) and the widths (N,), in steps of the profile and linear between them: NaN where a profile
        does not rise through a half, and an infinite width where 0.1 or 0.9 is not reached.
    """
    count = profile.shape[1]
    at = torch.arange(count, device=profile.device, dtype=profile.dtype)
    low, high = profile[:, :-1], profile[:, 1:]

    def crossing(level: float) -> torch.Tensor:
        """Returns where the profile passes a level between each two samples; meaningless where it does not."""
        gap = high - low
        return at[:-1] + (level - low) / gap.where(gap != 0, 1.0)

    middle = torch.full_like(profile[:, 0], (count - 1) / 2) if near is None else near
    rising = (low < 0.5) & (high >= 0.5)
    distance = (crossing(0.5) - middle.unsqueeze(1)).abs().where(rising, math.inf)
    chosen = distance.argmin(1, keepdim=True)
    position = crossing(0.5).gather(1, chosen).squeeze(1).where(rising.any(1), math.nan)
    # The last sample at or below 0.1 up to there, and the first at or above 0.9 from there on.
    leaves = crossing(0.1).where((low <= 0.1) & (high > 0.1) & (at[:-1] <= chosen), -math.inf).amax(1)
    arrives = crossing(0.9).where((low < 0.9) & (high >= 0.9) & (at[:-1] >= chosen), math.inf).amin(1)
    return position, (arrives - leaves).where(rising.any(1), math.nan)


def _jumps(study: Study, methods: Mapping[str, models.Model]) -> None:
    """Every other row of the queries is that of a beam; the others lie midway."""
    beams, columns = PAPER_INPUT.shape
    pairs = study.pairs(PAPER_INPUT.resize(2 * beams - 1, _FINE * columns))
    answers = _answers(methods, pairs) | {"truth": [truth.filled() for _, truth in pairs]}
    found: dict[tuple[str, str], list[tuple[torch.Tensor, ...]]] = {}
    for number, (_, truth) in enumerate(pairs):
        ranges = truth.filled()
        row, window = jumps(ranges, truth.sensor.norm_range)
        place, _ = rises(_profile(ranges, ranges, row, window))
        for name in answers:
            profile = _profile(answers[name][number], ranges, row, window)
            position, width = rises(profile, place)
            around = _centred(profile, place)
            for words, chosen in (("on a beam", row % 2 == 0), ("midway", row % 2 == 1)):
                shift = (position - place).abs()
                found.setdefault((name, words), []).append((width[chosen], shift[chosen], around[chosen]))
    rows, curves = [], {}
    for (name, words), parts in found.items():
        widths, shifts, profiles = (torch.cat(part).cpu().numpy() for part in zip(*parts, strict=True))
        risen = ~np.isnan(widths)
        low, middle, high = _quartiles(widths[risen] / _FINE)
        line = {"rows": words, "model": name, "jumps": len(risen), "found": float(risen.mean()) if len(risen) else 0.0}
        line |= {"width, first quartile": low, "width": middle, "width, third quartile": high}
        rows.append(line | {"distance": _quartiles(shifts[risen] / _FINE)[1]})
        curves[name, words] = np.stack([_quartiles(column) for column in profiles.T], 1)
    study.write("where-jumps", rows)
    where_pictures.jumps(rows, curves, _FINE, study.out / "where-jumps.png")


def _quartiles(values: np.ndarray) -> list[float]:
    """Returns the three quartiles, each one of the values, which may be infinite; NaN if there is none."""
    if not len(values):
        return [math.nan] * 3
    return [float(value) for value in np.percentile(values, (25, 50, 75), method="nearest")]


def _centred(profile: torch.Tensor, place: torch.Tensor) -> torch.Tensor:
    """Returns profiles (N, K) cut to `_AROUND` columns on either side of a place (N,)."""
    reach = _AROUND * _FINE
    steps = torch.arange(-reach, reach + 1, device=profile.device)
    return profile.gather(1, (place.round().long().unsqueeze(1) + steps).clamp(0, profile.shape[1] - 1))


def _tiles(model: models.Model, scan: Scan, truth: Scan) -> Iterator[tuple[Any, torch.Tensor, torch.Tensor]]:
    """Yields what is encoded of a scan, the image (1, H, W) as the network sees it, and queries (1, Q, 2) in it."""
    upright = scan.sensor.upright(model.falling)
    image = scan.filled(model.norm_range).flip(scan.sensor.flips(model.falling)).unsqueeze(0)
    encoded = model.encode(image, upright.wrap, upright)
    for queries in upright.grid_queries(truth.sensor).view(1, -1, 2).to(image.device).split(_TILE, 1):
        yield encoded, image, queries


@torch.no_grad()
def weights(model: ILN | Surfaces, scan: Scan, truth: Scan) -> torch.Tensor:
    """Returns the weight of each neighbour, or of its 9 hypotheses, for the rays of the truth: (H, W, 4) or (H, W, 36).

    Neighbours are those of an upright image, see `Sensor.upright`.
    """
    found = []
    for encoded, image, queries in _tiles(model, scan, truth):
        if isinstance(model, Surfaces):
            scores, _ = model.scores(encoded, queries, scan.sensor.wrap)
            found.append(surface_weights(scores, queries).squeeze(0))
        else:
            h = model.scores(encoded, queries, scan.sensor.wrap)
            _, w = reference.gather_blend(image, queries, h, model.prior, scan.sensor.wrap, model.area_floor)
            found.append(w.squeeze(0))
    return torch.cat(found).view(*truth.sensor.shape, -1)


@torch.no_grad()
def attention_maps(model: ILN, scan: Scan, truth: Scan) -> torch.Tensor:
    """Returns how much each neighbour attends to each in the first block, (Q, heads, 4, 4); rows sum to 1.

    Q are the rays of the truth, row by row.
    """
    block: Any = model.blocks[0]
    attention, width = block.attention, model.position.out_features // block.attention.heads
    found = []
    for encoded, _, queries in _tiles(model, scan, truth):
        z, offsets = gather_neighbours(encoded.features, queries, scan.sensor.wrap)
        tokens = attention.norm(z + model.position(offsets * OFFSET_SCALE))
        qkv = attention.qkv(tokens).squeeze(0).view(-1, 4, 3, attention.heads, width)
        q, k, _ = qkv.unbind(2)
        found.append((torch.einsum("nihd,njhd->nhij", q, k) / math.sqrt(width)).softmax(-1))
    return torch.cat(found)


def entropy(weights: torch.Tensor) -> torch.Tensor:
    """Returns the entropy (...) in bits of weights (..., N) that sum to 1."""
    return torch.special.entr(weights).sum(-1) / math.log(2)


def _weights(study: Study, of: _Asked, networks: Mapping[str, models.Model]) -> None:
    """Measures the weights of `iln` and `iln-surfaces` and the attention maps of `iln`, and draws them."""
    iln, surfaces = networks["iln"], networks["iln-surfaces"]
    assert isinstance(iln, ILN)
    assert isinstance(surfaces, Surfaces)
    kinds = {"4 ranges": "iln", "attention": "iln", "36 surfaces": "iln-surfaces"}
    measured: dict[str, list[torch.Tensor]] = {kind: [] for kind in kinds}
    maps, heads = {}, []
    for number, pair in enumerate(of.pairs):
        blended, weighed, attended = weights(iln, *pair), weights(surfaces, *pair), attention_maps(iln, *pair)
        if number == 0:
            maps = {"iln": blended, "iln-surfaces": weighed}
        bins = of.bins[number].flatten()
        heads.append(torch.stack([attended[bins == b].sum(0) for b in range(len(SPREADS))]))
        # Of attention, the means over heads and over the neighbours that attend.
        rows_of = {"4 ranges": blended, "attention": attended.flatten(1, 2), "36 surfaces": weighed}
        for kind, found in rows_of.items():
            bits, largest = entropy(found), found.amax(-1)
            if kind == "attention":
                bits, largest = bits.mean(1), largest.mean(1)
            error = signed(of.answers[kinds[kind]][number], pair[1]).abs()
            measured[kind].append(torch.stack([bits.flatten(), largest.flatten(), error.flatten()]))
    bins = torch.cat([found.flatten() for found in of.bins])
    rows = []
    for kind, name in kinds.items():
        bits, largest, error = torch.cat(measured[kind], 1)
        for number, words in enumerate(SPREADS):
            here = (bins == number) & ~error.isnan()
            row = {"size": of.size, "model": name, "of": kind, "spread": words, "entropy [bits]": _mean(bits[here])}
            for label, mask in (("right to 5 cm", error <= _RIGHT), ("wrong", error > _RIGHT)):
                row[f"entropy [bits], {label}"] = _mean(bits[here & mask])
            rows.append(row | {"largest": _mean(largest[here])})
    study.write("where-weights", rows)
    truth = of.pairs[0][1]
    shown = sector(truth)
    shown = slice(shown.start, (3 * shown.start + shown.stop) // 4)  # few enough columns to see single queries
    bits_of = {name: entropy(found) for name, found in maps.items()}
    where_pictures.weights(maps, bits_of, rows, truth, shown, study.out / "where-weights.png")
    total = torch.stack(heads).sum(0)
    means = dict(zip(SPREADS, total / total.sum(-1, keepdim=True), strict=True))  # rows of a map sum to 1
    study.write(
        "where-attention", [{"spread": s, "head": h, **_paid(a)} for s, m in means.items() for h, a in enumerate(m, 1)]
    )
    where_pictures.heads({s: found.cpu().numpy() for s, found in means.items()}, study.out / "where-attention.png")


def _paid(attention: torch.Tensor) -> dict[str, float]:
    """Returns how much of its attention a neighbour pays to which, means of a map (4, 4)."""
    others = {"itself": 0, "the one beside it": 1, "the one above or below": 2, "the one across": 3}
    at = torch.arange(4)
    # The numbers of neighbours that are beside each other differ in bit 0, of those above each other in bit 1.
    return {words: float(attention[at, at ^ bits].mean()) for words, bits in others.items()}


def _mean(values: torch.Tensor) -> float:
    return float(values.double().mean()) if values.numel() else math.nan


def _precision(study: Study, asked: Sequence[_Asked], networks: Mapping[str, models.Model]) -> None:
    rows, moves = [], {}
    for of in asked:
        halves = _answers(networks, of.pairs, "bfloat16")
        for name, answers in halves.items():
            moved, iou = [], []
            for number, ((_, truth), answer) in enumerate(zip(of.pairs, answers, strict=True)):
                full = of.answers[name][number]
                moved.append((answer - full).abs()[truth.ranges > 0])
                iou.append([metrics.compare(x, truth)["iou"] for x in (full, answer)])
            moves[name, of.size] = centimetres = 100 * torch.cat(moved).cpu().numpy()
            middle, most = np.percentile(centimetres, (50, 99))
            row = {"size": of.size, "model": name, "moved [cm], median": float(middle), "99 %": float(most)}
            row["moved by more than 1 cm"] = float((centimetres > 1).mean())
            row |= dict(zip(("IoU, float32", "IoU, bfloat16"), np.mean(iou, 0).tolist(), strict=True))
            rows.append(row)
    study.write("where-precision", rows)
    where_pictures.precision(rows, moves, study.out / "where-precision.png")

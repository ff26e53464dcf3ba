"""The command `bench`: our ops, frames, training steps and rays beside the usual ways to write them, in one run.

Each pair is warmed up and then timed in turns, so that both meet the same machine; a row gives medians. "The authors'
formulation" is the network as their code computes it (paper, Figs. 2 and 3), rewritten in plain PyTorch: every
neighbour of every query is gathered, embedded and projected, and each operation passes over all of them.
"""

import contextlib
import ctypes
import gc
import math
import shutil
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import nn
from tqdm import tqdm  # type: ignore[import-untyped]

from ilnet import data, models
from ilnet.commands import demo
from ilnet.learning import train as training
from ilnet.models.base import OFFSET_SCALE, normalised
from ilnet.scan import Scan
from ilnet.sensor import PAPER_INPUT, PAPER_TARGET, Sensor, preset
from ilnet.world import places, simulate
from ilnet.world.simulate import best_device
from kernels import (
    area_blend,
    fused_surfaces,
    fused_surfaces_serves,
    gather_blend,
    neighbour_attention,
    project_pixels,
    reference,
    surface_median,
)

__all__ = ["SECTIONS", "Row", "peak_memory", "run", "table"]

LARGE = (256, 4096)
TOWN = "town01"
# Queries of an op: those of a frame, or a quarter of them where each has 4 tokens or 36 hypotheses.
BLENDS, TOKENS = 262_144, 65_536
TRAIN_SCANS, TRAIN_QUERIES = 4, 16_384
# Scans cast in one call: a GPU has room for several.
SCANS = {"cpu": 1, "cuda": 16}
CHUNK = 2048

ROUNDS = 3


@dataclass
class Row:
    """One comparison."""

    name: str
    size: str
    ours_s: float
    """Seconds, median."""
    other: str
    """Name of the other way to do it."""
    other_s: float
    ratio: float
    """other_s / ours_s."""
    max_abs_diff: float
    """Largest difference between the two results, in their unit."""
    peak_mb: float | None = None
    """Peak memory of ours, without its inputs and results; None where it was not measured."""
    mean_abs_diff: float = field(default=0.0, kw_only=True)

    def json(self) -> dict[str, Any]:
        """Returns the row as JSON values."""
        values = asdict(self)
        del values["mean_abs_diff"]
        return values


Work = Callable[[], list[torch.Tensor]]


def _compare(name: str, size: str, ours: Work, others: dict[str, Work], repeat: int = 1) -> Iterator[Row]:
    """Times `ours` and each of the others in turns, `repeat` calls per round; yields one row for each other."""
    for words, other in others.items():
        # Other libraries answer on the CPU, whatever our device is.
        results = [torch.cat([part.detach().float().cpu().flatten() for part in work()]) for work in (ours, other)]
        times: tuple[list[float], list[float]] = ([], [])
        for _ in range(ROUNDS):
            for work, seconds in zip((ours, other), times, strict=True):
                time.sleep(0.1)  # torch's threads stay awake for a while, on cores that the next one needs
                for _ in range(repeat // 5):  # warm up again; long runs are less sensitive
                    work()
                for _ in range(repeat):
                    _wait()
                    start = time.perf_counter()
                    work()
                    _wait()
                    seconds.append(time.perf_counter() - start)
        a, b = (statistics.median(seconds) for seconds in times)
        difference = (results[0] - results[1]).abs()
        yield Row(name, size, a, words, b, b / a, float(difference.max()), mean_abs_diff=float(difference.mean()))


def _wait() -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def _compiled(work: Callable[..., torch.Tensor], device: torch.device) -> Callable[..., torch.Tensor] | None:
    """Returns `torch.compile` of a function; None if its default backend finds no compiler."""
    compilers = ("g++", "clang++") if device.type == "cpu" else ("cc", "gcc", "clang")
    if not any(map(shutil.which, compilers)):
        return None
    return torch.compile(work, fullgraph=True)


def _with_backward(work: Callable[..., torch.Tensor], leaves: list[torch.Tensor]) -> Work:
    def run() -> list[torch.Tensor]:
        result = work()
        return [result, *torch.autograd.grad(result.mean(), leaves)]

    return run


def _no_gradients(work: Callable[..., torch.Tensor]) -> Work:
    def run() -> list[torch.Tensor]:
        with torch.no_grad():
            return [work()]

    return run


def ops() -> Iterator[Row]:
    """Times the fused ops beside plain PyTorch."""
    device = best_device()
    torch.manual_seed(0)
    source, target = PAPER_INPUT, PAPER_TARGET
    queries = source.grid_queries(target).view(1, -1, 2).to(device)
    image = (torch.rand(1, *source.shape, device=device) * 70 + 3).requires_grad_()
    scores = torch.randn(1, BLENDS, 4, device=device, requires_grad=True)
    yield from _both(
        "gather_blend",
        f"{BLENDS} queries",
        partial(gather_blend, image, queries, scores),
        partial(gather_blend, image, queries, scores, backend="torch"),
        [image, scores],
        device,
    )
    no_scores = torch.zeros_like(scores)
    yield from _both(
        "gather_blend",
        f"{BLENDS} queries, bilinear prior",
        partial(gather_blend, image, queries, no_scores, "bilinear"),
        partial(_grid_sample, image, queries),
        [image],
        device,
        "F.grid_sample, a column added at the seam",
    )
    yield from _both(
        "area_blend",
        f"{BLENDS} queries",
        partial(area_blend, scores, queries),
        partial(area_blend, scores, queries, backend="torch"),
        [scores],
        device,
    )
    model = models.ILN(blocks=1).to(device)
    attention: Any = model.blocks[0].get_submodule("attention")
    features = torch.randn(1, 64, *source.shape, device=device).contiguous(memory_format=torch.channels_last)
    features.requires_grad_()
    some = queries[:, : 4 * TOKENS : 4].contiguous()
    leaves = [features, *attention.parameters(), *model.position.parameters()]
    yield from _both(
        "neighbour_attention",
        f"{TOKENS} queries, 64 channels, 8 heads",
        partial(_our_attention, model, features, some),
        lambda: _attention(attention, _embed(model, features, some)[0]).view(1, -1, 4, 64),
        leaves,
        device,
    )
    yield from _surfaces(some, device)


def _surfaces(queries: torch.Tensor, device: torch.device) -> Iterator[Row]:
    """Times what answers queries (1, Q, 2) over surfaces."""
    source = PAPER_INPUT
    model: Any = models.create("iln-surfaces").eval().to(device)
    nn.init.normal_(model.head[1].weight, std=0.3)  # untrained scores are all 0
    image = torch.rand(1, *source.shape, device=device) * 70 + 3
    with torch.no_grad():
        encoded = model.encode(image, source.wrap, source)
        scores, scales = model.scores(encoded, queries, source.wrap)
    rays = encoded.measured, queries, *source.angles(device)

    def median(backend: str = "warp") -> torch.Tensor:
        return surface_median(*rays, scores, scales, source.wrap, backend)[0]

    def decoder(backend: str = "warp") -> torch.Tensor:
        return fused_surfaces(encoded.projected, *rays, model.decoder_weights(), source.wrap, backend=backend)[0]

    works = {"surface_median": median}
    if fused_surfaces_serves(encoded.projected):
        works["fused_surfaces"] = decoder
    for name, work in works.items():
        others = {"eager torch": _no_gradients(partial(work, "torch"))}
        compiled = _compiled(partial(work, "torch"), device)
        if compiled is not None:
            others["torch.compile"] = _no_gradients(compiled)
        yield from _compare(name, f"{TOKENS} queries", _no_gradients(work), others, repeat=5)


def _both(
    name: str,
    size: str,
    ours: Callable[..., torch.Tensor],
    plain: Callable[..., torch.Tensor],
    leaves: list[torch.Tensor],
    device: torch.device,
    words: str = "eager torch",
) -> Iterator[Row]:
    for suffix, wrap in (("-forward", _no_gradients), ("-forward-backward", partial(_with_backward, leaves=leaves))):
        others = {words: wrap(plain)}
        compiled = _compiled(plain, device)
        if compiled is not None and words == "eager torch":
            others["torch.compile"] = wrap(compiled)
        yield from _compare(name + suffix, size, wrap(ours), others, repeat=15)


def _grid_sample(image: torch.Tensor, queries: torch.Tensor) -> torch.Tensor:
    """Returns torch's bilinear interpolation: corners are pixel centres, and the first column follows the last."""
    closed = torch.cat((image, image[..., :1]), -1).unsqueeze(1)
    size = queries.new_tensor([image.shape[1] - 1, image.shape[2]])
    grid = (queries % size.new_tensor([math.inf, image.shape[2]])) * (2 / size) - 1
    return F.grid_sample(closed, grid.flip(-1).unsqueeze(1), padding_mode="border", align_corners=True).view(1, -1)


def _our_attention(model: models.ILN, features: torch.Tensor, queries: torch.Tensor) -> torch.Tensor:
    attention: Any = model.blocks[0].attention
    position = model.position.weight * OFFSET_SCALE, model.position.bias
    norm = attention.norm.weight, attention.norm.bias
    projected = project_pixels(features, position, norm, attention.qkv.weight, attention.heads)
    return neighbour_attention(projected, queries, (attention.out.weight, attention.out.bias))


def _embed(model: models.ILN, features: torch.Tensor, queries: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns the tokens (N, 4, C) of all queries, and the pixels that they came from."""
    batch, _, height, width = features.shape
    rows, columns, offsets = reference.neighbours(queries, height, width, True)
    images = torch.arange(batch, device=features.device).view(-1, 1, 1)
    pixels = (images * height + rows) * width + columns
    z = features.movedim(1, 3).reshape(-1, features.shape[1])[pixels]
    return (z + model.position(offsets * OFFSET_SCALE)).flatten(0, 1), pixels


def _attention(attention: Any, x: torch.Tensor) -> torch.Tensor:
    """Returns tokens (N, 4, C) after a pre-norm attention step."""
    q, k, v = attention.qkv(attention.norm(x)).view(len(x), 4, 3, attention.heads, -1).permute(2, 0, 3, 1, 4)
    weights = (q @ k.transpose(-1, -2) / math.sqrt(q.shape[-1])).softmax(-1)
    return x + attention.out((weights @ v).transpose(1, 2).reshape(x.shape))


def _plain_encode(model: models.ILN, image: torch.Tensor) -> torch.Tensor:
    def conv(layer: nn.Conv2d, x: torch.Tensor) -> torch.Tensor:
        x = F.pad(F.pad(x, (1, 1, 0, 0), "circular"), (0, 0, 1, 1), "replicate")
        return F.conv2d(x, layer.weight.contiguous(), layer.bias)

    encoder: Any = model.encoder
    head = x = conv(encoder.head, normalised(image, model.norm_range))
    for block in encoder.blocks:
        x = x + conv(block.second, conv(block.first, x).relu())
    return head + conv(encoder.tail, x)


def _plain_decode(
    model: models.ILN, features: torch.Tensor, image: torch.Tensor, queries: torch.Tensor
) -> torch.Tensor:
    x, pixels = _embed(model, features, queries)
    block: Any
    for block in model.blocks:
        x = _attention(block.attention, x)
        x = x + block.feed_forward(x)
    weights = model.head(x).squeeze(-1).softmax(-1)
    return (weights * image.flatten()[pixels].flatten(0, 1)).sum(-1).view(queries.shape[:2])


def _plain_frame(model: models.ILN, image: torch.Tensor, queries: torch.Tensor, chunk: int) -> torch.Tensor:
    features = _plain_encode(model, image)
    chunks = queries.split(chunk, 1)
    return torch.cat([_plain_decode(model, features, image, part) for part in chunks], 1)


def frame() -> Iterator[Row]:
    """Times a frame of ILN at D = 1, from the scan to the ranges."""
    device = best_device()
    torch.manual_seed(0)
    model = models.ILN().eval().to(device)
    scan, _ = demo.from_town()
    source, target = scan.sensor, PAPER_TARGET
    for precision in models.PRECISIONS:
        for wanted in (target, target.resize(*LARGE)):
            whole = wanted is target  # all queries of the large frame at once would take 6 GB
            chunks = {f"the authors' formulation, {CHUNK} queries at a time": CHUNK}
            if whole:
                chunks = {"the authors' formulation": math.prod(wanted.shape), **chunks}
            image = scan.filled(model.norm_range).unsqueeze(0)
            queries = source.grid_queries(wanted).view(1, -1, 2).to(device)
            upsampler = models.Upsampler(model, source, wanted, precision, device)
            ours = partial(_frame, upsampler, scan)
            peak = peak_memory(ours, device)
            size = f"{source.size} -> {wanted.size}"
            plain = {
                words: _no_gradients(partial(_plain_frame, model, image, queries, chunk))
                for words, chunk in chunks.items()
            }
            for row in _compare(f"frame-{precision}", size, ours, plain):
                row.peak_mb = peak
                yield row


def surfaces_frame() -> Iterator[Row]:
    """Times a frame of `iln-surfaces`, from the scan to the ranges, beside the same network on the plain twins."""
    device = best_device()
    torch.manual_seed(0)
    scan, _ = demo.from_town()
    ours, plain = (models.create("iln-surfaces").eval().to(device) for _ in range(2))
    plain.load_state_dict(ours.state_dict())
    plain.backend = "torch"
    for precision in models.PRECISIONS:
        for wanted in (PAPER_TARGET, PAPER_TARGET.resize(*LARGE)):
            work, other = (
                partial(_frame, models.Upsampler(model, scan.sensor, wanted, precision, device), scan)
                for model in (ours, plain)
            )
            peak = peak_memory(work, device)
            size = f"{scan.sensor.size} -> {wanted.size}"
            for row in _compare(f"surfaces-frame-{precision}", size, work, {"the same in plain PyTorch": other}):
                row.peak_mb = peak
                yield row


def _frame(upsampler: models.Upsampler, scan: Scan) -> list[torch.Tensor]:
    return [upsampler.ranges(scan)]


def train() -> Iterator[Row]:
    """Times a training step: encoder, decoder, L1, gradients and Adam, in bfloat16 where `ilnet train` uses it."""
    device = best_device()
    torch.manual_seed(0)
    model = models.ILN().train().to(device)
    source = PAPER_INPUT
    image = torch.rand(TRAIN_SCANS, *source.shape, device=device) * 70 + 3
    size = torch.tensor([source.shape[0] - 1, source.shape[1]], device=device)
    queries = torch.rand(TRAIN_SCANS, TRAIN_QUERIES, 2, device=device) * size
    truth = torch.rand(TRAIN_SCANS, TRAIN_QUERIES, device=device) * 70 + 3
    optimizer = torch.optim.Adam(model.parameters(), lr=0.0)

    def step(predict: Callable[[], torch.Tensor]) -> list[torch.Tensor]:
        optimizer.zero_grad()
        predicted = predict()
        (predicted - truth).abs().mean().backward()
        optimizer.step()
        return [predicted]

    def ours() -> torch.Tensor:
        with torch.autocast(device.type, torch.bfloat16):
            return model(image, queries)

    def plain() -> torch.Tensor:
        return _plain_decode(model, _plain_encode(model, image), image, queries)

    yield from _compare(
        "train-step",
        f"{TRAIN_SCANS} scans x {TRAIN_QUERIES} queries",
        partial(step, ours),
        {"the authors' formulation, eager, float32": partial(step, plain)},
    )
    yield from _draw_batches(model, optimizer, device)


def _draw_batches(model: models.ILN, optimizer: torch.optim.Optimizer, device: torch.device) -> Iterator[Row]:
    """Times drawing a batch of continuous rays beside the training step that uses it."""
    size = training.PRESETS["tiny"]
    place = places.town(TOWN, 0, device)
    rays = data.ContinuousRays([place], PAPER_INPUT, size.crops, size.columns, size.queries, seed=0)
    batches = iter(rays)
    batch = next(batches)
    image, queries, truth, *_ = batch.to(device)

    nothing = [torch.zeros(1)]  # there is no common result to compare

    def draw() -> list[torch.Tensor]:
        next(batches)
        return nothing

    def step() -> list[torch.Tensor]:
        optimizer.zero_grad()
        with torch.autocast(device.type, torch.bfloat16):
            predicted = model(image, queries, wrap=False)
        (predicted - truth).abs().mean().backward()
        optimizer.step()
        return nothing

    yield from _compare(
        "continuous-rays",
        f"{size.crops} crops x {size.queries} rays, one batch",
        draw,
        {"the training step of iln that takes it": step},
        repeat=3,
    )


def rays() -> Iterator[Row]:
    """Times scans cast in a town, beside Open3D and embreex where these are installed."""
    device = best_device()
    place = places.town(TOWN, 0, device)
    poses = torch.stack([place.pose(number) for number in range(0, 100 * SCANS[device.type], 100)])
    for sensor in (preset("paper-64x1024"), PAPER_TARGET, PAPER_TARGET.resize(*LARGE)):
        size = f"{len(poses)} x {sensor.size}, {len(place.triangles) / 1000:.0f}k triangles"
        cast = partial(_cast, place, sensor, poses)
        alone: dict[str, Work] = {"the same BVH on one core, as Warp launches it": partial(_on_one_core, cast)}
        if device.type == "cuda":
            yield from _compare("rays-bvh", size, cast, _embree(place, sensor, poses), repeat=3)
            continue
        yield from _compare("rays-bvh", size, cast, alone)
        project = partial(_project, place, sensor, poses)
        yield from _compare("rays-projection", size, project, {"our BVH on all cores": cast, **alone})
        yield from _compare("rays-projection", size, project, _embree(place, sensor, poses), repeat=5)


def _cast(place: places.Place, sensor: Sensor, poses: torch.Tensor) -> list[torch.Tensor]:
    return [simulate.cast(place.mesh, poses, sensor.directions().view(-1, 3), sensor.max_range)]


def _project(place: places.Place, sensor: Sensor, poses: torch.Tensor) -> list[torch.Tensor]:
    tables = torch.tensor(sensor.elevations), torch.tensor(sensor.azimuths)
    return [place.mesh.project(pose, *tables, sensor.max_range) for pose in poses]


def _embree(place: places.Place, sensor: Sensor, poses: torch.Tensor) -> dict[str, Work]:
    """Returns casts of the same rays by the other libraries that are installed; making the rays is not timed."""
    directions = (sensor.directions().view(-1, 3).double() @ poses[:, :3, :3].mT).float()
    origins = poses[:, None, :3, 3].float().expand_as(directions)
    rays = torch.cat((origins, directions), 2).view(-1, 6).numpy()
    vertices, triangles = place.vertices, place.triangles
    found: dict[str, Work] = {}
    with contextlib.suppress(ImportError):
        import open3d

        scene = open3d.t.geometry.RaycastingScene(nthreads=torch.get_num_threads())
        scene.add_triangles(open3d.core.Tensor(vertices), open3d.core.Tensor(triangles.astype("uint32")))
        found["Open3D"] = lambda: [_limited(scene.cast_rays(open3d.core.Tensor(rays))["t_hit"].numpy(), sensor)]
    with contextlib.suppress(ImportError):
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        world = EmbreeScene()
        TriangleMesh(world, vertices, triangles)
        start, way = (rays[:, half].copy() for half in (slice(0, 3), slice(3, 6)))
        found["embreex, one core"] = lambda: [_limited(world.run(start, way, query="DISTANCE"), sensor)]
    return found


def _limited(distances: np.ndarray, sensor: Sensor) -> torch.Tensor:
    ranges = torch.from_numpy(distances)
    return ranges.where(ranges <= sensor.max_range, 0.0)


def _on_one_core(work: Work) -> list[torch.Tensor]:
    cores = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return work()
    finally:
        torch.set_num_threads(cores)


def peak_memory(work: Work, device: torch.device) -> float | None:
    """Returns the peak memory of `work` [MB], without what was there before and what it returns; None if unknown."""
    work()
    gc.collect()
    if device.type == "cuda":
        _wait()
        before = torch.cuda.memory_allocated()
        torch.cuda.reset_peak_memory_stats()
        result = work()
        _wait()
        return (torch.cuda.max_memory_allocated() - before - sum(part.nbytes for part in result)) / 1e6
    try:
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None).malloc_trim(0)  # freed memory that is kept for later would hide new allocations
        Path("/proc/self/clear_refs").write_text("5")  # resets the peak
        before = _status("VmRSS")
        result = work()
        return (_status("VmHWM") - before - sum(part.nbytes for part in result)) / 1e6
    except OSError:
        return None


def _status(entry: str) -> int:
    """Returns an entry of Linux's status of this process, in bytes."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(entry + ":"):
            return int(line.split()[1]) * 1024
    raise OSError(f"/proc/self/status has no {entry}")


def frames() -> Iterator[Row]:
    """Times frames of `iln` and of `iln-surfaces`."""
    yield from frame()
    yield from surfaces_frame()


SECTIONS: dict[str, Callable[[], Iterator[Row]]] = {"ops": ops, "frame": frames, "train": train, "rays": rays}


def run(sections: tuple[str, ...]) -> list[Row]:
    """Runs benchmarks, with a progress bar on stderr.

    Args:
        sections: Some of `SECTIONS`, or none for all of them.

    Returns:
        The rows in the order in which they were measured.
    """
    rows = []
    with tqdm(unit=" rows", desc="bench") as progress:
        for name in sections or SECTIONS:
            for row in SECTIONS[name]():
                rows.append(row)
                progress.set_postfix_str(row.name)
                progress.update()
    return rows


def table(rows: list[Row]) -> str:
    """Returns the rows as a text table."""
    lines = [("benchmark", "size", "ours", "other", "", "ratio", "largest (mean) difference", "peak")]
    for r in rows:
        difference = f"{r.max_abs_diff:.1e} ({r.mean_abs_diff:.0e})"
        peak = "" if r.peak_mb is None else f"{r.peak_mb:.0f} MB"
        times = (f"{1e3 * s:.1f} ms" for s in (r.ours_s, r.other_s))
        lines.append((r.name, r.size, next(times), r.other, next(times), f"{r.ratio:.1f}x", difference, peak))
    widths = [max(len(line[i]) for line in lines) for i in range(len(lines[0]))]
    right = (2, 4, 5)
    return "\n".join(
        "  ".join(
            c.rjust(w) if i in right else c.ljust(w) for i, (c, w) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )

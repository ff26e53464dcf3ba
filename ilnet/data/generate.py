"""Scans simulated in bulk, by several processes or hosts, into an archive on disk.

What scan k of an archive is depends on the archive's seed, its towns, its number of scans and k, and on nothing else:
so the work may be shared out and interrupted in any way.
"""

import bisect
import contextlib
import hashlib
import itertools
import math
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, fields
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from tqdm import tqdm  # type: ignore[import-untyped]

from ilnet.data.archive import UNIT, Archive
from ilnet.sensor import PRESETS, Sensor, preset
from ilnet.world import meshes, simulate, towns
from ilnet.world.effects import Effects
from ilnet.world.places import SENSOR_HEIGHT, Street
from kernels import Mesh

__all__ = ["Place", "effects_of", "generate", "mesh_place", "sensors_of_sizes", "town_places"]

T = TypeVar("T")

# Metres and radians that poses vary by, besides their yaw, which is free.
_HEIGHT_JITTER = 0.1
_TILT_JITTER = math.radians(1.0)
# Those that show in ranges.
_EFFECTS = tuple(field.name for field in fields(Effects) if field.name != "intensity")
# Metres below the sensor that the ground must lie within.
_GROUND_WITHIN = 20.0


class Place(NamedTuple):
    """Where scans can be taken."""

    vertices: np.ndarray
    """(V, 3) floating-point, metres."""
    triangles: np.ndarray
    """(F, 3) integer."""
    waypoints: np.ndarray
    """(N, 3) metres, on the ground."""
    town: towns.Town | None = None
    """Whose traffic is drawn; None where there is none."""


# For each how many waypoints it has, about, and how to build it.
Places = dict[str, tuple[int, Callable[[], Place]]]


def town_places(names: Iterable[str]) -> Places:
    """Returns how to build towns: each name is one of `towns.NAMES`, with `:SEED` behind it unless that is 0."""
    places: Places = {}
    for label in names:
        name, _, seed = label.partition(":")
        if name not in towns.NAMES or not (seed or "0").isdecimal():
            raise ValueError(
                f"--towns names {label!r}; it should be one of {', '.join(towns.NAMES)}, or such as "
                f"{towns.NAMES[0]}:7, the same town with another seed"
            )
        if label in places:
            raise ValueError(f"--towns names {label} twice")
        places[label] = towns.WAYPOINTS[name], partial(_build_town, name, int(seed or 0))
    return places


def _build_town(name: str, seed: int) -> Place:
    town = towns.build(name, seed)
    return Place(town.vertices, town.triangles, town.waypoints, town)


def mesh_place(file: Path, positions: Path) -> Places:
    """Reads a mesh to scan.

    Args:
        file: What PyVista reads, metres, z up.
        positions: JSON, whose `positions` are a list of [x, y, z], metres in the mesh, of the sensor.

    Raises:
        OSError: If a file cannot be read.
        ValueError: If one is damaged, or there is no ground under a position.
    """
    at = torch.from_numpy(meshes.read_positions(positions))
    vertices, triangles = meshes.read(file)
    down = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    ground = Mesh(vertices, triangles).cast(at, down, _GROUND_WITHIN).range
    for number in (ground == 0).nonzero()[:1, 0].tolist():
        x, y, z = at[number].tolist()
        raise ValueError(
            f"{file}: no triangle under position {number} ({x:g}, {y:g}, {z:g}) within {_GROUND_WITHIN:g} m; "
            "move it or leave it out"
        )
    place = Place(vertices, triangles, at.numpy() - [0, 0, SENSOR_HEIGHT])
    # Another mesh or other positions under the same name are another archive.
    digest = hashlib.sha256(file.read_bytes() + positions.read_bytes()).hexdigest()
    return {f"{file.name}@{digest[:16]}": (len(at), lambda: place)}


def sensors_of_sizes(sizes: Iterable[str]) -> list[Sensor]:
    """Returns the paper's sensor for each size, such as "64x1024": even beams over ±15°, 2 to 80 m."""
    sensors = []
    for size in sizes:
        rows, _, columns = size.partition("x")
        if not (rows.isdecimal() and columns.isdecimal()):
            raise ValueError(f"--sizes has {size!r}; it should be rows x columns, such as 64x1024")
        name = f"paper-{size}"
        known = name in PRESETS
        sensors.append(preset(name) if known else preset("paper-16x1024").resize(int(rows), int(columns)))
    return sensors


def effects_of(settings: Iterable[str]) -> Effects | None:
    """Returns the effects that settings such as "range_noise=0.02" or "velocity=10,0,0" name; None where there is none.

    Raises:
        ValueError: If a setting is of another kind.
    """
    values: dict[str, Any] = {}
    for setting in settings:
        name, _, value = setting.partition("=")
        default = getattr(Effects(), name, None)
        if name not in _EFFECTS:
            raise ValueError(f"--effect is {setting!r}; it should be NAME=VALUE, with a name of: {', '.join(_EFFECTS)}")
        values[name] = value.split(",") if isinstance(default, tuple) else value
    return Effects(**values) if values else None


def generate(
    out: Path,
    places: Places,
    scans: int,
    sensors: Iterable[Sensor],
    seed: int = 0,
    shard: tuple[int, int] = (1, 1),
    workers: int | None = None,
    effects: Effects | None = None,
) -> Archive:
    """Simulates scans into an archive; goes on where an interrupted run stopped.

    Args:
        out: The archive's folder.
        places: Where scans are taken, each waypoint equally often; see `town_places` and `mesh_place`.
        scans: Their number, of all parts.
        sensors: Each takes every scan, of the same world and from the same pose.
        seed: Of waypoints, poses and traffic.
        shard: (i, n): this run does part i of n, counted from 1.
        workers: Processes on a CPU; as many as torch has threads unless told. On CUDA this one does all.
        effects: What real sensors do to their measurements.

    Returns:
        The archive, complete but for what belongs to other parts.

    Raises:
        OSError: If the folder cannot be written, or a worker died.
        ValueError: If an argument does not fit, or `out` holds another archive.
    """
    sizes: dict[str, Sensor] = {}
    for sensor in sensors:
        size = "{}x{}".format(*sensor.shape)
        if size in sizes:
            raise ValueError(f"two sensors have {size} rays; give each an archive of its own")
        sizes[size] = sensor
    workers = workers or torch.get_num_threads()
    device = simulate.best_device()
    attributes = {"towns": list(places), "seed": seed, "device": device.type, "version": version("ilnet")}
    if effects:
        attributes["effects"] = asdict(effects)
    archive = Archive.create(out, scans, sizes, attributes)
    part, parts = shard
    units = {unit for unit in range(-(-scans // UNIT)) if unit % parts == part - 1}
    missing = [unit for unit in archive.missing() if unit in units]
    plan = _Plan(archive, seed, [count for count, _ in places.values()], effects)
    rays = sum(math.prod(sensor.shape) for sensor in sizes.values())
    total = sum(len(plan.scans(unit)) for unit in units)
    todo = sum(len(plan.scans(unit)) for unit in missing)
    needed = sorted({plan.town(k) for unit in missing for k in plan.scans(unit)})
    builders = [build for _, build in places.values()]
    with (
        tqdm(total=len(needed), desc="towns", unit=" towns", leave=False, disable=not needed) as progress,
        contextlib.closing(_parallel(lambda number: (number, builders[number]()), needed, workers)) as built,
    ):
        for number, place in built:
            plan.add(number, place, Mesh(place.vertices, place.triangles, device))
            progress.update()
    with tqdm(total=total, initial=total - todo, desc=str(out), unit=" scans") as progress:
        start, done = time.perf_counter(), 0
        with contextlib.closing(_parallel(plan.do, missing, 1 if device.type == "cuda" else workers)) as counts:
            for count in counts:
                done += count
                rate = done * rays / (time.perf_counter() - start) / 1e6
                progress.set_postfix_str(f"{rate:.2f} Mray/s", refresh=False)
                progress.update(count)
    archive.remove_unfinished(units)
    return archive


class _Plan:
    """What each scan of an archive is, once its town was added."""

    def __init__(self, archive: Archive, seed: int, waypoints: list[int], effects: Effects | None):
        self.archive, self.seed, self.effects = archive, seed, effects
        before = itertools.accumulate(waypoints, initial=0)
        self._first = [len(archive) * number // sum(waypoints) for number in before][:-1]
        self._places: dict[int, Place] = {}
        self._meshes: dict[int, Mesh] = {}

    def add(self, number: int, place: Place, mesh: Mesh) -> None:
        """Takes in the town of that number."""
        self._places[number], self._meshes[number] = place, mesh
        # Compiles the kernels and sorts the triangles, once for all workers.
        self.images(self._first[number])

    def scans(self, unit: int) -> range:
        """Which scans a unit holds."""
        return range(unit * UNIT, min((unit + 1) * UNIT, len(self.archive)))

    def town(self, scan: int) -> int:
        """The number of a scan's town: those of one town follow each other, so that a unit needs few."""
        return bisect.bisect_right(self._first, scan) - 1

    def waypoint(self, scan: int) -> int:
        """The number of a scan's waypoint: drawn without repetition until there are no more, then again."""
        town = self.town(scan)
        turn, index = divmod(scan - self._first[town], count := len(self._places[town].waypoints))
        return int(np.random.default_rng([self.seed, town, turn, 2]).permutation(count)[index])

    def pose(self, scan: int) -> torch.Tensor:
        """The sensor's pose (4, 4)."""
        rng = np.random.default_rng([self.seed, scan, 1])
        at = torch.tensor(self._places[self.town(scan)].waypoints[self.waypoint(scan)], dtype=torch.float64)
        at[2] += SENSOR_HEIGHT + rng.uniform(-_HEIGHT_JITTER, _HEIGHT_JITTER)
        return simulate.pose(at, rng.uniform(-math.pi, math.pi), *rng.uniform(-_TILT_JITTER, _TILT_JITTER, 2))

    def images(self, scan: int) -> dict[str, np.ndarray]:
        """What each sensor measures, (H, W) uint16, as the archive stores it."""
        sensors = self.archive.sensors
        mesh, town, pose = self._meshes[self.town(scan)], self._places[self.town(scan)].town, self.pose(scan)
        world = Street(town, mesh).world(pose[:3, 3], [self.seed, scan]) if town else [mesh]
        chance = int(np.random.default_rng([self.seed, scan, 3]).integers(2**63))
        found = {size: simulate.simulate(world, sensor, pose, self.effects, chance) for size, sensor in sensors.items()}
        return {size: self.archive.quantise(size, measured.ranges) for size, measured in found.items()}

    def do(self, unit: int) -> int:
        """Simulates and writes a unit, and returns its number of scans."""
        scans = self.scans(unit)
        images = [self.images(scan) for scan in scans]
        self.archive.write(
            unit,
            {size: np.stack([each[size] for each in images]) for size in self.archive.sizes},
            np.array([self.town(scan) for scan in scans]),
            np.array([self.waypoint(scan) for scan in scans]),
            np.stack([self.pose(scan).numpy() for scan in scans]),
        )
        return len(scans)


def _parallel(function: Callable[[int], T], numbers: list[int], workers: int) -> Generator[T]:
    """Yields what a function returns for each number, as soon as it does, from processes that share all memory."""
    if workers == 1 or len(numbers) < 2:
        yield from map(function, numbers)
        return
    pipe = os.pipe()
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("fork"), _begin, (function, *pipe))
    try:
        for future in as_completed([pool.submit(_call, number) for number in numbers]):
            yield future.result()
    except BrokenProcessPool:
        raise ChildProcessError(
            "a worker died, perhaps for lack of memory; what is complete is kept: run the same again, with fewer "
            "--workers"
        ) from None
    finally:
        # Workers that are still at something end at once: a file that is not whole is no file.
        os.close(pipe[1])
        pool.shutdown(cancel_futures=True)
        os.close(pipe[0])


# What a worker inherited; it cannot be sent.
_function: Callable[[int], Any]


def _begin(function: Callable[[int], Any], reading: int, writing: int) -> None:
    global _function
    _function = function
    torch.set_num_threads(1)
    # Ctrl-C reaches all: workers end without a word, and the parent says it.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    os.close(writing)
    threading.Thread(target=_end_with, args=(reading,), daemon=True).start()


def _end_with(reading: int) -> None:
    # Comes back when no process holds the other end of the pipe: the parent closed it, or was killed.
    os.read(reading, 1)
    os._exit(1)


def _call(number: int) -> Any:
    return _function(number)

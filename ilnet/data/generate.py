"""Scans simulated in bulk, by several processes or hosts, into an archive on disk.

Scan k of an archive depends on the archive's seed, its places, its number of scans and k, and on nothing else. So the
work can be shared out and interrupted in any way.
"""

import bisect
import contextlib
import hashlib
import itertools
import math
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterable, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from tqdm import tqdm  # type: ignore[import-untyped]

from ilnet import memory
from ilnet.data.archive import UNIT, Archive
from ilnet.sensor import Sensor
from ilnet.world import meshes, places, simulate, towns
from ilnet.world.effects import Effects
from ilnet.world.places import ARCHIVE_JITTER, Place
from kernels import Mesh

__all__ = ["Recipe", "generate", "mesh_place", "town_places"]

T = TypeVar("T")

# The ground must lie at most this many metres below the sensor.
_GROUND_WITHIN = 20.0


# About how much memory the place and the pose of a scan take [bytes].
_PER_SCAN = 300


class Recipe(NamedTuple):
    """A place that is built once a run needs it."""

    waypoints: int
    """How many waypoints it has; scans are shared out by this number."""
    build: Callable[[], Place]
    """Builds it; several recipes run in processes of their own."""


def town_places(wanted: Iterable[tuple[str, int]]) -> dict[str, Recipe]:
    """Returns recipes of towns.

    Args:
        wanted: For each its name, one of `towns.NAMES`, and its seed.

    Returns:
        The recipes, by the name, or as "town01:7" where the seed is not 0.

    Raises:
        ValueError: If a name is unknown, or a town is wanted twice.
    """
    device = simulate.best_device()
    found: dict[str, Recipe] = {}
    for name, seed in wanted:
        if name not in towns.NAMES:
            raise ValueError(f"name is {name!r}; it should be one of {', '.join(towns.NAMES)}")
        label = f"{name}:{seed}" if seed else name
        if label in found:
            raise ValueError(f"wanted has {label} twice; each town should be there once")
        found[label] = Recipe(towns.WAYPOINTS[name], partial(places.town, name, seed, device))
    return found


def mesh_place(file: Path, positions: Path) -> dict[str, Recipe]:
    """Reads a mesh to scan.

    Args:
        file: A file that `meshes.read` reads, metres, z up.
        positions: JSON file of the sensor's positions in the mesh, see `meshes.read_positions`.

    Returns:
        Its recipe, by the name of the file and a digest of both files.

    Raises:
        OSError: If a file cannot be read.
        ValueError: If a file is damaged, or there is no ground under a position.
    """
    at = meshes.read_positions(positions)
    place = places.mesh(file, at, simulate.best_device())
    down = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    ground = Mesh(place.vertices, place.triangles).cast(torch.from_numpy(at), down, _GROUND_WITHIN).range
    for number in (ground == 0).nonzero()[:1, 0].tolist():
        x, y, z = at[number].tolist()
        raise ValueError(
            f"{file}: no triangle under position {number} ({x:g}, {y:g}, {z:g}) within {_GROUND_WITHIN:g} m; "
            "move it or leave it out"
        )
    # Another mesh or other positions under the same name make another archive.
    digest = hashlib.sha256(file.read_bytes() + positions.read_bytes()).hexdigest()
    return {f"{file.name}@{digest[:16]}": Recipe(len(at), lambda: place)}


def generate(
    out: Path,
    recipes: Mapping[str, Recipe],
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
        recipes: The places where scans are taken, each waypoint equally often; see `town_places` and `mesh_place`.
        scans: Number of scans, of all parts together.
        sensors: The sensors that take every scan, in the same world and from the same pose.
        seed: Seed of waypoints, poses and traffic.
        shard: (i, n): this run does part i of n, counted from 1.
        workers: Number of processes on a CPU; by default as many as torch has threads. On CUDA this process simulates
            all scans. Where the system cannot fork, as on Windows, this process does all the work.
        effects: What real sensors do to their measurements; None for perfect ranges.

    Returns:
        The archive, complete except for what belongs to other parts.

    Raises:
        OSError: If the folder cannot be written, or a worker died.
        ValueError: If an argument does not fit, or `out` holds another archive.
    """
    memory.check(f"the list of {scans} scans", scans * _PER_SCAN)
    sizes: dict[str, Sensor] = {}
    for sensor in sensors:
        if sensor.size in sizes:
            raise ValueError(f"two sensors have {sensor.size} rays; give each an archive of its own")
        sizes[sensor.size] = sensor
    workers = workers or torch.get_num_threads()
    if workers > 1 and "fork" not in multiprocessing.get_all_start_methods():
        tqdm.write(f"this system cannot fork: one process does the work of {workers} workers", file=sys.stderr)
        workers = 1
    device = simulate.best_device()
    attributes = {"towns": list(recipes), "seed": seed, "device": device.type, "version": version("ilnet")}
    if effects:
        attributes["effects"] = asdict(effects)
    archive = Archive.create(out, scans, sizes, attributes)
    part, parts = shard
    units = {unit for unit in range(-(-scans // UNIT)) if unit % parts == part - 1}
    missing = [unit for unit in archive.missing() if unit in units]
    plan = _Plan(archive, seed, [recipe.waypoints for recipe in recipes.values()], effects)
    rays = sum(math.prod(sensor.shape) for sensor in sizes.values())
    total = sum(len(plan.scans(unit)) for unit in units)
    todo = sum(len(plan.scans(unit)) for unit in missing)
    needed = sorted({plan.number(k) for unit in missing for k in plan.scans(unit)})
    builders = [recipe.build for recipe in recipes.values()]
    with (
        tqdm(total=len(needed), desc="towns", unit=" towns", leave=False, disable=not needed) as progress,
        contextlib.closing(_parallel(lambda number: (number, builders[number]()), needed, workers)) as built,
    ):
        for number, place in built:
            plan.add(number, place)
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
    """What each scan of an archive is, once its place was added."""

    def __init__(self, archive: Archive, seed: int, waypoints: list[int], effects: Effects | None):
        self.archive, self.seed, self.effects = archive, seed, effects
        before = itertools.accumulate(waypoints, initial=0)
        self._first = [len(archive) * number // sum(waypoints) for number in before][:-1]
        self._places: dict[int, Place] = {}

    def add(self, number: int, place: Place) -> None:
        """Takes in the place of that number."""
        self._places[number] = place
        # Compiles the kernels and sorts the triangles, once for all workers.
        self.images(self._first[number])

    def scans(self, unit: int) -> range:
        """Returns the numbers of the scans in a unit."""
        return range(unit * UNIT, min((unit + 1) * UNIT, len(self.archive)))

    def number(self, scan: int) -> int:
        """Returns the number of a scan's place; the scans of one place are neighbours, so a unit needs few places."""
        return bisect.bisect_right(self._first, scan) - 1

    def waypoint(self, scan: int) -> int:
        """Returns the number of a scan's waypoint: drawn without repetition until there are no more, then again."""
        number = self.number(scan)
        turn, index = divmod(scan - self._first[number], count := len(self._places[number].waypoints))
        return int(np.random.default_rng([self.seed, number, turn, 2]).permutation(count)[index])

    def pose(self, scan: int) -> torch.Tensor:
        """Returns the sensor's pose (4, 4)."""
        rng, (height, tilt) = np.random.default_rng([self.seed, scan, 1]), ARCHIVE_JITTER
        at = self._places[self.number(scan)].position(self.waypoint(scan), rng.uniform(-height, height))
        return simulate.pose(at, rng.uniform(-math.pi, math.pi), *rng.uniform(-tilt, tilt, 2))

    def images(self, scan: int) -> dict[str, np.ndarray]:
        """Returns what each sensor measures, (H, W) uint16, as the archive stores it."""
        sensors, pose = self.archive.sensors, self.pose(scan)
        world = self._places[self.number(scan)].world(pose[:3, 3], [self.seed, scan])
        chance = int(np.random.default_rng([self.seed, scan, 3]).integers(2**63))
        found = {size: simulate.scan(world, sensor, pose, self.effects, chance) for size, sensor in sensors.items()}
        return {size: self.archive.quantise(size, measured.ranges) for size, measured in found.items()}

    def do(self, unit: int) -> int:
        """Simulates and writes a unit, and returns its number of scans."""
        scans = self.scans(unit)
        images = [self.images(scan) for scan in scans]
        self.archive.write(
            unit,
            {size: np.stack([each[size] for each in images]) for size in self.archive.sizes},
            np.array([self.number(scan) for scan in scans]),
            np.array([self.waypoint(scan) for scan in scans]),
            np.stack([self.pose(scan).numpy() for scan in scans]),
        )
        return len(scans)


def _parallel(function: Callable[[int], T], numbers: list[int], workers: int) -> Generator[T]:
    """Yields what a function returns for each number, as soon as it does, from forked processes."""
    if workers == 1 or len(numbers) < 2:
        yield from map(function, numbers)
        return
    pipe = os.pipe()
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("fork"), _begin, (function, *pipe))
    processes: list[multiprocessing.process.BaseProcess] = []
    broken = False
    try:
        futures = [pool.submit(_call, number) for number in numbers]
        processes = multiprocessing.active_children()
        for future in as_completed(futures):
            yield future.result()
    except BrokenProcessPool:
        broken = True
    finally:
        # Busy workers end at once; a file that they have not finished does not count.
        os.close(pipe[1])
        pool.shutdown(cancel_futures=True)
        os.close(pipe[0])
    if broken:
        # Ctrl-C ends the workers, and it may reach this process where Python can raise nothing. How they ended is known
        # once the pool has been shut down.
        if any(process.exitcode == -signal.SIGINT for process in processes):
            raise KeyboardInterrupt
        raise ChildProcessError(
            "a worker died, perhaps for lack of memory; what is complete is kept: run the same again, with fewer "
            "workers"
        )


# Inherited by a worker, since it cannot be sent.
_function: Callable[[int], Any]


def _begin(function: Callable[[int], Any], reading: int, writing: int) -> None:
    global _function
    _function = function
    torch.set_num_threads(1)
    # Ctrl-C reaches every process: workers end in silence, and the parent says what happened.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    os.close(writing)
    threading.Thread(target=_end_with, args=(reading,), daemon=True).start()


def _end_with(reading: int) -> None:
    # Returns when no process holds the other end of the pipe: the parent closed it, or was killed.
    os.read(reading, 1)
    os._exit(1)


def _call(number: int) -> Any:
    return _function(number)

"""Training data: images stored on disk, and rays at continuous directions, cast while the network trains.

The paper trains on the former and calls the latter intractable (Sec. III-A).
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch.utils.data import IterableDataset, get_worker_info

from ilnet.data.archive import Archive
from ilnet.data.random_sensors import COLUMNS, draw_effects, draw_sensor
from ilnet.data.rimg import RangeImageTree
from ilnet.scan import Scan
from ilnet.sensor import Sensor, angles_to_directions
from ilnet.world import simulate
from ilnet.world.effects import nearer, spoil
from ilnet.world.places import ANY_JITTER, RAYS_JITTER, Place
from kernels import Mesh

__all__ = ["Batch", "ContinuousRays", "StoredImages"]

# No query falls into so many columns at a crop's sides, where the network sees a border that a full circle lacks.
_MARGIN = 8


class Batch(NamedTuple):
    """Crops of scans, and what a laser would have measured between their pixels."""

    image: torch.Tensor
    """(B, H, W) ranges [m], no return filled with `norm_range`."""
    queries: torch.Tensor
    """(B, Q, 2) pixel coordinates."""
    ranges: torch.Tensor
    """(B, Q) ranges along the queries [m], no return filled with `norm_range`."""
    wrap: bool
    """Whether the images go full circle."""
    sensor: Sensor
    """The sensor of the images."""

    def to(self, device: torch.device | str) -> "Batch":
        """Returns the same batch with its tensors on a device."""
        moved = {name: getattr(self, name).to(device) for name in ("image", "queries", "ranges")}
        return self._replace(**moved)


class ContinuousRays(IterableDataset):
    """Endless batches of crops and of rays at random directions between their pixels.

    Each crop has a place, a waypoint, a height, a yaw, a tilt and traffic of its own. A query's direction is uniform
    between the beams of the sensor and in azimuth: no stored image contains it. Rays are cast when a batch is asked
    for, on the device of the places. On the CPU the workers of a `DataLoader` take turns, and any number of them gives
    the same batches. The tensors of a batch are on the CPU.

    Args:
        places: Where scans are taken, all on one device; each is drawn equally often.
        sensors: The input sensor, or several, of which each batch has one; they are turned upright. If there is none,
            `draw_sensor` makes one up for each batch, and `draw_effects` says what it does to the images. The ranges to
            be predicted stay clean.
        crops: Number B of crops in a batch.
        columns: Number W of columns in a crop.
        queries: Number Q of rays per crop.
        seed: Seed of the random numbers; a batch depends on the seed and on its number.
        start: Number of the first batch, for a training that goes on.
        part: (i, n): cast part i, counted from 0, of n equal parts of each batch, for training in several processes.

    Raises:
        ValueError: If a sensor has fewer columns than a crop, a crop is too narrow for queries, or the crops cannot be
            shared out equally.
    """

    def __init__(
        self,
        places: Sequence[Place],
        sensors: Sensor | Sequence[Sensor],
        crops: int,
        columns: int,
        queries: int,
        seed: int,
        start: int = 0,
        part: tuple[int, int] = (0, 1),
    ):
        given = (sensors,) if isinstance(sensors, Sensor) else sensors
        self.sensors = tuple(sensor.upright() for sensor in given)
        most = min((sensor.shape[1] for sensor in self.sensors), default=min(COLUMNS))
        if not 2 * _MARGIN + 2 <= columns <= most:
            raise ValueError(f"columns is {columns}; it should be {2 * _MARGIN + 2} to {most}, the columns of a sensor")
        self.places, self.crops, self.columns = places, crops, columns
        self.queries, self.seed, self.start = queries, seed, start
        meshes = [place.mesh for place in places]  # made here, once, and not by every worker
        self.device = meshes[0].device
        self.part = _part(crops, part)

    def __iter__(self) -> Iterator[Batch]:
        return map(self._draw, _numbers(self.start))

    def _draw(self, number: int) -> Batch:
        generator, rng = _generator(self.seed, number), np.random.default_rng([self.seed, number])

        def uniform(low: float, high: float, *shape: int) -> torch.Tensor:
            return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)

        whole = self.sensors[int(rng.integers(len(self.sensors)))] if self.sensors else draw_sensor(rng)
        sensor = replace(whole, azimuths=whole.azimuths[: self.columns], name=f"{whole.name} crop")
        crops, jitter = self.crops, RAYS_JITTER if self.sensors else ANY_JITTER
        row = uniform(0, sensor.shape[0] - 1, crops, self.queries)[self.part]
        elevation = torch.from_numpy(np.interp(row, np.arange(sensor.shape[0]), sensor.elevations))
        azimuth = uniform(*sensor.azimuths[[_MARGIN, -1 - _MARGIN]], crops, self.queries)[self.part]
        grid = sensor.directions().double().view(1, -1, 3).expand(len(azimuth), -1, -1)
        rays = torch.cat((grid, angles_to_directions(elevation, azimuth)), 1)
        where = torch.randint(len(self.places), (crops,), generator=generator)
        along, lift = uniform(0, 1, crops), uniform(-jitter.height, jitter.height, crops)
        turn, tilt = uniform(-math.pi, math.pi, crops), uniform(-jitter.tilt, jitter.tilt, 2, crops)
        stands = zip(where.tolist(), along.tolist(), lift.tolist(), strict=True)
        at = torch.stack([self._position(*stand) for stand in stands])
        where, pose = where[self.part], simulate.pose(at, turn, *tilt)[self.part]
        ranges, cosines = self._cast(where, pose, rays, number, sensor, jitter.tilt)
        ranges = ranges.where(ranges >= max(sensor.min_range, 1e-9), 0.0)
        image, ranges = ranges.split([grid.shape[1], self.queries], 1)
        if not self.sensors:
            shape = crops, grid.shape[1]
            noise, luck = torch.randn(shape, generator=generator), torch.rand(shape, generator=generator)
            noise, luck = noise[self.part].to(image), luck[self.part].to(image)
            image = spoil(draw_effects(rng), image, cosines[:, : grid.shape[1]], sensor, noise, luck)
        image, ranges = (found.where(found > 0, sensor.norm_range).cpu() for found in (image, ranges))
        located = sensor.locate(elevation, azimuth)
        return Batch(image.unflatten(1, sensor.shape), located, ranges.contiguous(), False, sensor)

    def _cast(
        self, where: torch.Tensor, pose: torch.Tensor, rays: torch.Tensor, number: int, sensor: Sensor, tilt: float
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns the ranges (B, N) of the rays of each crop, 0 where nothing is met, and the cosines of incidence."""
        ranges, cosines = self._cast_traffic(where, pose, rays, number, sensor, tilt)
        for which in where.unique().tolist():
            chosen = where == which
            hits = simulate.hits(self.places[which].mesh, pose[chosen], rays[chosen], sensor.max_range)
            front = nearer(hits.range, ranges[chosen])
            ranges[chosen] = hits.range.where(front, ranges[chosen])
            cosines[chosen] = hits.cosine.where(front, cosines[chosen])
        return ranges, cosines

    def _position(self, where: int, along: float, lift: float) -> torch.Tensor:
        place = self.places[where]
        return place.position(int(along * len(place.waypoints)), lift)

    def _cast_traffic(
        self, where: torch.Tensor, pose: torch.Tensor, rays: torch.Tensor, number: int, sensor: Sensor, tilt: float
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns ranges and cosines (B, N) of the vehicles and people of each crop; 0 where none is met.

        They are one mesh, in which the crops stand so far apart that none sees another's.
        """
        apart = torch.zeros(len(where), 3, dtype=torch.float64)
        apart[:, 0] = torch.arange(len(where)) * 4 * sensor.max_range
        first, last = sensor.azimuths[[0, -1]]
        middle = angles_to_directions(torch.tensor(0.0), torch.tensor((first + last) / 2)).double()
        half = abs(last - first) / 2 + tilt
        corners = [torch.empty(0, 3)]
        for crop, which in enumerate(where.tolist()):
            position, ahead = pose[crop, :3, 3], pose[crop, :3, :3] @ middle
            sector = math.atan2(ahead[1], ahead[0]), half
            seed = self.seed, number, self.part.start + crop
            vertices, triangles = self.places[which].traffic(position, seed, sector)
            moved = (vertices - position.numpy() + apart[crop].numpy()).astype(np.float32)
            corners.append(torch.from_numpy(moved[triangles.ravel()]))
        joined = torch.cat(corners)
        if len(joined) == 0:
            return torch.zeros(rays.shape[:2], device=self.device), torch.zeros(rays.shape[:2], device=self.device)
        mesh = Mesh(joined, torch.arange(len(joined)).view(-1, 3), self.device)
        pose = pose.clone()
        pose[:, :3, 3] = apart
        hits = simulate.hits(mesh, pose, rays, sensor.max_range)
        return hits.range, hits.cosine


class StoredImages(IterableDataset):
    """Endless batches of stored scans and of pixels of denser images from the same places (paper, Sec. III-A).

    Images are turned upright, as `Upsampler` shows them to a network: lowest beam first, azimuths rising.

    Args:
        archive: See `open_archive`.
        source: Size of the input, such as "16x1024".
        target: Size of the images that the pixels are taken from, such as "128x2048".
        scans: Number B of scans in a batch; in an epoch each scan of the archive is drawn once.
        queries: Number Q of pixels per scan, all different.
        seed: Seed of the random numbers; a batch depends on the seed and on its number.
        start: Number of the first batch, for a training that goes on.
        part: (i, n): read part i, counted from 0, of n equal parts of each batch, for training in several processes.
        sector: Number of columns of the input, from a random one on; None for all. For models whose columns do not meet
            at the seam. `Batch.wrap` remains the sensor's, since pixels are spaced as on the full circle.

    Raises:
        ValueError: If the archive lacks a size, its images hold fewer pixels than `queries`, or a sector is wanted and
            the target's number of columns is no multiple of the source's.
    """

    def __init__(
        self,
        archive: Archive | RangeImageTree,
        source: str,
        target: str,
        scans: int,
        queries: int,
        seed: int,
        start: int = 0,
        part: tuple[int, int] = (0, 1),
        sector: int | None = None,
    ):
        for size in (source, target):
            if size not in archive.sensors:
                raise ValueError(f"{archive.path}: holds no scans of size {size}; it has {', '.join(archive.sizes)}")
        sensor, dense = (archive.sensors[size].upright() for size in (source, target))
        self.times, rest = divmod(dense.shape[1], sensor.shape[1])
        if sector is not None and rest:
            raise ValueError(f"target is {target}; for a sector its columns should be a multiple of those of {source}")
        located = sensor.grid_queries(dense)[:, : None if sector is None else sector * self.times]
        if queries > (pixels := located[..., 0].numel()):
            raise ValueError(f"queries is {queries}; it should be at most {pixels}, the pixels of {target}")
        self.archive, self.source, self.target, self.scans, self.queries = archive, source, target, scans, queries
        self.seed, self.start, self.part, self.wrap = seed, start, _part(scans, part), sensor.wrap
        self.sensor = replace(sensor, azimuths=sensor.azimuths[:sector])
        self.sector, self.located = sector, located.reshape(-1, 2)

    def __iter__(self) -> Iterator[Batch]:
        return map(self._read, _numbers(self.start))

    def _read(self, number: int) -> Batch:
        images, queries, ranges = [], [], []
        for place in range(number * self.scans, (number + 1) * self.scans)[self.part]:
            epoch, place_in_epoch = divmod(place, len(self.archive))
            order = torch.randperm(len(self.archive), generator=_generator(self.seed, 0, epoch))
            scan = int(order[place_in_epoch])
            pixels = torch.randperm(len(self.located), generator=_generator(self.seed, 1, place))[: self.queries]
            sparse, dense = (self._upright(self.archive.scan(scan, size)) for size in (self.source, self.target))
            if self.sector is not None:
                first = int(torch.randint(sparse.shape[1], (), generator=_generator(self.seed, 2, place)))
                sparse = sparse.roll(-first, 1)[:, : self.sector]
                dense = dense.roll(-first * self.times, 1)[:, : self.sector * self.times]
            images.append(sparse)
            queries.append(self.located[pixels])
            ranges.append(dense.reshape(-1)[pixels])
        return Batch(torch.stack(images), torch.stack(queries), torch.stack(ranges), self.wrap, self.sensor)

    def _upright(self, scan: Scan) -> torch.Tensor:
        return scan.filled().flip(scan.sensor.flips())


def _part(batch: int, part: tuple[int, int]) -> slice:
    number, parts = part
    if batch % parts:
        raise ValueError(
            f"a batch has {batch} scans; their number should be a multiple of {parts}, the number of processes"
        )
    return slice(number * batch // parts, (number + 1) * batch // parts)


def _numbers(start: int) -> Iterator[int]:
    """Returns the numbers of the batches to make; the workers of a `DataLoader` take turns."""
    worker = get_worker_info()
    first, step = (worker.id, worker.num_workers) if worker else (0, 1)
    return itertools.count(start + first, step)


def _generator(*seed: int) -> torch.Generator:
    state = np.random.SeedSequence(seed).generate_state(1, np.uint64)
    return torch.Generator().manual_seed(int(state[0] >> 1))

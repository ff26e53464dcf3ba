"""Training data: rays at continuous directions, cast while the network trains (paper, Sec. III-A: intractable)."""

import itertools
import math
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch.utils.data import IterableDataset

from ilnet import simulate, towns
from ilnet.scan import Scan
from ilnet.sensor import Sensor, angles_to_directions
from ilnet.store import open_archive
from kernels import Mesh

__all__ = ["Batch", "ContinuousRays", "Street", "held_out_scans", "open_archive", "street"]

# Metres above the lane, and how it varies from car to car.
SENSOR_HEIGHT = 1.8
_HEIGHT_JITTER = 0.3
# Radians: a car pitches and rolls.
_TILT_JITTER = math.radians(2.0)
# Columns at a crop's sides that no query falls into: there the network sees a border no full circle has.
_MARGIN = 8


class Batch(NamedTuple):
    """Crops of scans, and what a laser would have measured between their pixels."""

    image: torch.Tensor
    """(B, H, W) metres, no return filled with `norm_range`."""
    queries: torch.Tensor
    """(B, Q, 2) pixel coordinates."""
    ranges: torch.Tensor
    """(B, Q) metres along the queries, no return filled with `norm_range`."""


class Street(NamedTuple):
    """A town ready for rays."""

    mesh: Mesh
    waypoints: torch.Tensor
    """(N, 3) metres, on the lanes."""
    headings: torch.Tensor
    """(N,) rad."""

    def pose(self, number: int) -> torch.Tensor:
        """The pose (4, 4) of a sensor that looks ahead above waypoint `number`."""
        return simulate.pose(self.waypoints[number] + torch.tensor([0, 0, SENSOR_HEIGHT]), self.headings[number])


def street(name: str, seed: int, device: torch.device | str = "cpu") -> Street:
    """Builds a town and its ray casting mesh."""
    town = towns.build(name, seed)
    return Street(
        Mesh(town.vertices, town.triangles, device), torch.tensor(town.waypoints), torch.tensor(town.headings)
    )


def held_out_scans(street: Street, count: int, sensors: list[Sensor]) -> list[list[Scan]]:
    """Simulates the same evenly spread waypoints of a town with each of several sensors.

    Returns:
        For each waypoint one scan per sensor.
    """
    chosen = torch.linspace(0, len(street.waypoints) - 1, count + 2)[1:-1].long().tolist()
    return [[simulate.simulate(street.mesh, sensor, street.pose(i)) for sensor in sensors] for i in chosen]


class ContinuousRays(IterableDataset):
    """Endless batches of crops and of rays at random directions between their pixels.

    Each crop has a street, a waypoint, a height, a yaw and a tilt of its own. A query's direction is uniform
    in elevation and azimuth: no stored image contains it.

    Args:
        streets: Where scans are taken; each is drawn equally often.
        sensor: The input sensor.
        crops: Crops B in a batch.
        columns: Columns W of a crop.
        queries: Rays Q per crop.
        seed: Of the random numbers; seed and number of a batch decide what it holds.
        start: Number of the first batch, for a training that goes on.
    """

    def __init__(
        self, streets: list[Street], sensor: Sensor, crops: int, columns: int, queries: int, seed: int, start: int = 0
    ):
        self.streets, self.crops, self.queries, self.seed, self.start = streets, crops, queries, seed, start
        self.sensor = replace(sensor, azimuths=sensor.azimuths[:columns], name=f"{sensor.name} crop")

    def __iter__(self) -> Iterator[Batch]:
        for number in itertools.count(self.start):
            state = np.random.SeedSequence((self.seed, number)).generate_state(1, np.uint64)
            yield self._draw(torch.Generator().manual_seed(int(state[0] >> 1)))

    def _draw(self, generator: torch.Generator) -> Batch:
        def uniform(low: float, high: float, *shape: int) -> torch.Tensor:
            return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)

        crops, sensor = self.crops, self.sensor
        elevation = uniform(*sensor.elevations[[0, -1]], crops, self.queries)
        azimuth = uniform(*sensor.azimuths[[_MARGIN, -1 - _MARGIN]], crops, self.queries)
        grid = sensor.directions().double().view(1, -1, 3).expand(crops, -1, -1)
        rays = torch.cat((grid, angles_to_directions(elevation, azimuth)), 1)
        town = torch.randint(len(self.streets), (crops,), generator=generator)
        ranges = rays.new_empty(rays.shape[:2], dtype=torch.float32)
        for number, street in enumerate(self.streets):
            chosen = (town == number).nonzero().squeeze(1)
            if len(chosen) == 0:
                continue
            at = street.waypoints[torch.randint(len(street.waypoints), (len(chosen),), generator=generator)].double()
            at[:, 2] += SENSOR_HEIGHT + uniform(-_HEIGHT_JITTER, _HEIGHT_JITTER, len(chosen))
            turn = uniform(-math.pi, math.pi, len(chosen))
            tilt = uniform(-_TILT_JITTER, _TILT_JITTER, 2, len(chosen))
            pose = simulate.pose(at, turn, *tilt)
            ranges[chosen] = simulate.measure(street.mesh, sensor, pose, rays[chosen]).cpu()
        ranges = ranges.where(ranges > 0, sensor.norm_range)
        image, ranges = ranges.split([grid.shape[1], self.queries], 1)
        return Batch(image.unflatten(1, sensor.shape), sensor.locate(elevation, azimuth), ranges.contiguous())

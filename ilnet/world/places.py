"""Where scans are taken: a mesh, waypoints in it, and the traffic around them.

A sensor stands `towns.SENSOR_HEIGHT` above a waypoint, which `Place.position` adds.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from ilnet.scan import Scan
from ilnet.sensor import Sensor
from ilnet.world import meshes, simulate, towns
from kernels import Mesh

__all__ = ["ANY_JITTER", "ARCHIVE_JITTER", "RAYS_JITTER", "Jitter", "Place", "held_out_scans", "mesh", "town"]


class Jitter(NamedTuple):
    """How much the pose of a sensor varies from car to car; its yaw is free."""

    height: float
    """Most metres up or down."""
    tilt: float
    """Most radians of pitch, and of roll, either way."""


# Archives on disk and the shipped weights were made with these values; another value would change what they mean.
RAYS_JITTER = Jitter(0.3, math.radians(2.0))
"""Jitter of the crops that networks learn from, see `ilnet.data.ContinuousRays`."""
ANY_JITTER = Jitter(0.7, math.radians(5.0))
"""Jitter of the same crops for a network that serves any sensor: on cars, robots and poles, and not quite upright."""
ARCHIVE_JITTER = Jitter(0.1, math.radians(1.0))
"""Jitter of the scans in an archive, see `ilnet.data.generate`."""


@dataclass(frozen=True, eq=False)
class Place:
    """A mesh to cast rays at, and waypoints for a sensor to stand over; in a town, its traffic too.

    The mesh of the rays is made when it is first needed, and again in a process that a place is sent to.

    Args:
        vertices: (V, 3) floating-point [m], z up.
        triangles: (F, 3) integer, numbers of the vertices.
        waypoints: (N, 3) points on the ground [m].
        headings: (N,) directions in which a sensor looks [rad], counter-clockwise from +x.
        town: The town whose traffic is drawn; None where there is no traffic.
        device: Device that the mesh is kept and its rays are cast on.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    waypoints: np.ndarray
    headings: np.ndarray
    town: towns.Town | None = None
    device: torch.device | str = "cpu"

    def __reduce__(self) -> tuple[Any, ...]:
        return Place, tuple(getattr(self, field.name) for field in fields(self))

    @cached_property
    def mesh(self) -> Mesh:
        """What stands here, without the traffic."""
        return Mesh(self.vertices, self.triangles, self.device)

    def spread(self, count: int) -> list[int]:
        """Returns the numbers of `count` waypoints, evenly spread from the first to the last."""
        return torch.linspace(0, len(self.waypoints) - 1, count + 2)[1:-1].long().tolist()

    def position(self, number: int, lift: float = 0.0) -> torch.Tensor:
        """Returns where a sensor above waypoint `number` is, (3,) float64 [m], `lift` metres higher than usual."""
        position = torch.tensor(self.waypoints[number], dtype=torch.float64)
        position[2] += towns.SENSOR_HEIGHT + lift
        return position

    def pose(self, number: int, lift: float = 0.0) -> torch.Tensor:
        """Returns the pose (4, 4) of a level sensor there, which looks along the waypoint's heading."""
        return simulate.pose(self.position(number, lift), float(self.headings[number]))

    def traffic(
        self, position: torch.Tensor, seed: int | Sequence[int], sector: tuple[float, float] | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Draws the vehicles and people around a sensor.

        Args:
            position: (3,) of the sensor [m].
            seed: Seed of the draw; the same place, position and seed give the same traffic.
            sector: See `towns.traffic`.

        Returns:
            Vertices (V, 3) float32 [m] and triangles (F, 3) int32; empty where nothing is about.
        """
        if self.town is None:
            return np.empty((0, 3), np.float32), np.empty((0, 3), np.int32)
        return towns.traffic(self.town, position.cpu().numpy(), seed, sector=sector)

    def world(self, position: torch.Tensor, seed: int | Sequence[int]) -> list[Mesh]:
        """Returns what surrounds a sensor at a position (3,) [m]: what stands, and the traffic of that seed."""
        vertices, triangles = self.traffic(position, seed)
        return [self.mesh, Mesh(vertices, triangles, self.device)] if len(triangles) else [self.mesh]


def town(name: str, seed: int = 0, device: torch.device | str = "cpu") -> Place:
    """Builds a town.

    Args:
        name: One of `towns.NAMES`.
        seed: Another seed gives another town of the same character.
        device: Device that its rays are cast on.

    Raises:
        ValueError: If there is no such town.
    """
    built = towns.build(name, seed)
    return Place(built.vertices, built.triangles, built.waypoints, built.headings, built, device)


def mesh(
    path: str | Path, positions: np.ndarray | Sequence[Sequence[float]], device: torch.device | str = "cpu"
) -> Place:
    """Reads a mesh file; nothing moves in it.

    Args:
        path: A file that `meshes.read` reads, metres, z up.
        positions: (N, 3) where the sensor stands in the mesh [m]. It looks along x.
        device: Device that its rays are cast on.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is not a mesh, or a position is not three finite numbers.
    """
    at = np.asarray(positions, dtype=np.float64)
    if at.ndim != 2 or at.shape[1] != 3 or not np.isfinite(at).all():
        raise ValueError(f"positions is {positions}; it should be rows of three finite numbers, metres in the mesh")
    vertices, triangles = meshes.read(path)
    return Place(vertices, triangles, at - [0.0, 0.0, towns.SENSOR_HEIGHT], np.zeros(len(at)), device=device)


def held_out_scans(place: Place, count: int, sensors: Sequence[Sensor]) -> list[list[Scan]]:
    """Scans evenly spread waypoints of a place, each in its own traffic, with each of several sensors.

    Args:
        place: Where the scans are taken.
        count: Number of waypoints.
        sensors: The sensors; all stand at the same pose.

    Returns:
        For each waypoint one scan per sensor, on the device of the place.
    """
    scans = []
    for number in place.spread(count):
        pose = place.pose(number)
        world = place.world(pose[:3, 3], number)
        scans.append([simulate.scan(world, sensor, pose) for sensor in sensors])
    return scans

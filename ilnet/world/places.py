"""Where scans are taken."""

from collections.abc import Sequence
from typing import NamedTuple

import torch

from ilnet.scan import Scan
from ilnet.sensor import Sensor
from ilnet.world import simulate, towns
from kernels import Mesh

__all__ = ["SENSOR_HEIGHT", "Street", "held_out_scans", "street"]

# Metres above the lane.
SENSOR_HEIGHT = 1.8


class Street(NamedTuple):
    """A town ready for rays."""

    town: towns.Town
    mesh: Mesh
    """What stands in it."""

    def pose(self, number: int) -> torch.Tensor:
        """The pose (4, 4) of a sensor that looks ahead above waypoint `number`."""
        x, y, z = self.town.waypoints[number].tolist()
        return simulate.pose((x, y, z + SENSOR_HEIGHT), float(self.town.headings[number]))

    def world(self, position: torch.Tensor, seed: int | Sequence[int]) -> list[Mesh]:
        """What a sensor at a position (3,) [m] is surrounded by: the town, and traffic that the seed decides."""
        vertices, triangles = towns.traffic(self.town, position.numpy(), seed)
        return [self.mesh, Mesh(vertices, triangles, self.mesh.device)] if len(triangles) else [self.mesh]


def street(name: str, seed: int = 0, device: torch.device | str = "cpu") -> Street:
    """Builds a town and its ray casting mesh."""
    town = towns.build(name, seed)
    return Street(town, Mesh(town.vertices, town.triangles, device))


def held_out_scans(street: Street, count: int, sensors: list[Sensor]) -> list[list[Scan]]:
    """Simulates the same evenly spread waypoints of a town, each with its own traffic, with each of several sensors.

    Returns:
        For each waypoint one scan per sensor.
    """
    scans = []
    for number in torch.linspace(0, len(street.town.waypoints) - 1, count + 2)[1:-1].long().tolist():
        pose = street.pose(number)
        world = street.world(pose[:3, 3], number)
        scans.append([simulate.simulate(world, sensor, pose) for sensor in sensors])
    return scans

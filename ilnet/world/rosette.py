"""The rays of a LiDAR without rows: a rosette that two turning prisms draw, and that does not repeat.

Each prism bends the beam by the same angle, and they turn against each other. To first order the bends add up, so after
t seconds the beam is off the axis by

    (y, z) = half / 2 (cos(w1 t) + cos(w2 t), sin(w1 t) + sin(w2 t))

The rates are those of a Livox Mid-40 (Brazeal et al., "A Rigorous Observation Model for the Risley Prism-Based Livox
Mid-40 Lidar Sensor", 2021): 7294 and -4664 turns a minute, 100,000 points a second, a field of view of 38.4°.
"""

import math

import torch

__all__ = ["directions"]

_TURNS = 7294 / 60, -4664 / 60
_POINTS_PER_SECOND = 100_000
_HALF_VIEW = math.radians(38.4) / 2


def directions(count: int, start: int = 0) -> torch.Tensor:
    """Returns the unit vectors of rays in the order in which they are sent, around +x in the sensor frame.

    `ilnet.world.simulate.cast` and `Mesh.cast` take them. 10,000 are a tenth of a second.

    Args:
        count: How many rays.
        start: Number of the first ray; the pattern goes on where that of earlier rays ended.

    Returns:
        (count, 3) float64.

    Raises:
        ValueError: If `count` or `start` is negative.
    """
    if count < 0 or start < 0:
        raise ValueError(f"count and start are {count} and {start}; they should be 0 or more")
    time = torch.arange(start, start + count, dtype=torch.float64) / _POINTS_PER_SECOND
    first, second = (math.tau * turns * time for turns in _TURNS)
    y, z = (_HALF_VIEW / 2 * (wave(first) + wave(second)) for wave in (torch.cos, torch.sin))
    angle = torch.hypot(y, z)
    # sin(angle) / angle, which is 1 on the axis.
    bend = torch.sinc(angle / math.pi)
    return torch.stack((angle.cos(), bend * y, bend * z), dim=-1)

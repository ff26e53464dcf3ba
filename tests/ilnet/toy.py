"""A small scan for tests of scans and of their files."""

from dataclasses import replace

import numpy as np
import torch

from ilnet.scan import Scan
from ilnet.sensor import Sensor

# A range that became a float32 point and a norm again: three roundings of 2^-24 each way, and the square root's.
ROUND_TRIP = {"rtol": 5e-7, "atol": 0}

SENSOR = Sensor(np.deg2rad([20, 5, 0, -10]), np.deg2rad([170, 80, -10, -100]), 1, 50, 60, "toy")


def toy() -> Scan:
    """4x4 returns of 3.0, 3.5, ... m with two holes."""
    ranges = 3 + torch.arange(16).view(4, 4) / 2
    ranges[0, 1] = ranges[3, 3] = 0
    return Scan(ranges, SENSOR)


def bright() -> Scan:
    """The toy with intensities 0, 1/15, ... 1, two of them where nothing returned."""
    return Scan(toy().ranges, SENSOR, torch.arange(16).view(4, 4) / 15)


def predicted() -> Scan:
    """The bright toy with confidences 1, 0.95, ... 0.25, two of them where nothing returned."""
    return replace(bright(), confidence=1 - torch.arange(16).view(4, 4) / 20)


def complete() -> Scan:
    """The predicted toy with times 0, 0.01, ... 0.15 s; the sensor did not look at one pixel without a return."""
    seen = torch.ones(4, 4, dtype=torch.bool)
    seen[3, 3] = False
    return replace(predicted(), time=torch.arange(16).view(4, 4) / 100, seen=seen)

"""What is known of a sensor, as data sheets say it: degrees and metres."""

from typing import NamedTuple

import numpy as np

__all__ = ["FALLING", "RISING", "Table", "degrees"]

FALLING, RISING = 180.0, -180.0
"""Azimuth of the first column [deg], where azimuths fall or rise from column to column."""


class Table(NamedTuple):
    """A sensor that turns a full circle in even steps.

    Args:
        elevations: Elevation of each row [deg], from the first row to the last.
        columns: Columns of a turn, by default at 10 Hz.
        limits: Nearest and farthest range that the data sheet promises, and the range that stands for no return [m].
        source: Where the numbers stand.
        first: `FALLING` or `RISING`.
    """

    elevations: np.ndarray
    columns: int
    limits: tuple[float, float, float]
    source: str
    first: float = FALLING


def degrees(text: str) -> np.ndarray:
    """Returns the numbers in a text, apart by white space."""
    return np.array(text.split(), dtype=np.float64)

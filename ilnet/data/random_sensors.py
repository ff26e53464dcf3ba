"""Sensors drawn at random, for a network that has to serve any."""

import math

import numpy as np

from ilnet.sensor import PAPER_INPUT, Sensor
from ilnet.world.effects import Effects

__all__ = ["COLUMNS", "draw_effects", "draw_sensor"]

COLUMNS = (512, 720, 900, 1024, 1024, 1800, 2048)
"""Numbers of columns that are drawn."""
# Share of the draws that are the paper's input sensor.
_PAPER = 0.3
_ROWS = (8, 12, 16, 16, 16, 24, 32, 32, 40)
# Degrees: least field of view, most field of view, and the steepest beam up or down.
_LEAST_VIEW, _MOST_VIEW, _STEEPEST = 10.0, 95.0, 55.0
# Degrees: least and most mean spacing of the beams.
_DENSEST, _SPARSEST = 0.3, 6.0


def draw_sensor(rng: np.random.Generator) -> Sensor:
    """Draws a full-circle sensor: its rows, field of view, spacing, columns and range limits.

    Three sensors in ten are `PAPER_INPUT`. Half of the others have evenly spaced beams. In the rest the beams form two
    blocks of different density, are densest at some elevation, or lie at random.

    Args:
        rng: Source of the random numbers.

    Returns:
        The sensor, its lowest beam first and its azimuths rising.
    """
    if rng.random() < _PAPER:
        return PAPER_INPUT
    gaps = int(rng.choice(_ROWS)) - 1
    low, high = max(_DENSEST, _LEAST_VIEW / gaps), min(_SPARSEST, _MOST_VIEW / gaps)
    spacing = math.exp(rng.uniform(math.log(low), math.log(high)))
    steps = _unevenness(rng, gaps)
    steps *= spacing / steps.mean()
    view = float(steps.sum())
    top = rng.uniform(0.2, 0.8) * view + rng.normal(-3.0, 4.0)
    top = min(_STEEPEST, max(top, view - _STEEPEST))
    elevations = top - view + np.concatenate(([0.0], np.cumsum(steps)))
    azimuths = np.linspace(-math.pi, math.pi, int(rng.choice(COLUMNS)), endpoint=False)
    nearest = float(rng.choice([0.3, 0.5, 1.0, 2.0]))
    farthest = math.exp(rng.uniform(math.log(50), math.log(130)))
    return Sensor(np.deg2rad(elevations), azimuths, nearest, farthest, 1.25 * farthest, name="any")


def _unevenness(rng: np.random.Generator, gaps: int) -> np.ndarray:
    """Returns the spacing of beams relative to each other, (gaps,)."""
    steps = np.ones(gaps)
    match rng.choice(["even", "even", "even", "blocks", "gradient", "jitter"]):
        case "blocks":
            steps[: rng.integers(1, gaps)] *= rng.uniform(1.2, 3.0)
        case "gradient":
            away = np.abs(np.linspace(0, 1, gaps) - rng.uniform())
            steps += rng.uniform(1, 6) * away ** rng.uniform(1, 3)
        case "jitter":
            steps = rng.uniform(0.5, 1.5, gaps)
    return steps[::-1].copy() if rng.random() < 0.5 else steps


def draw_effects(rng: np.random.Generator) -> Effects:
    """Draws what a sensor does to its ranges: noise, and returns lost at random, far away and at grazing angles.

    Args:
        rng: Source of the random numbers.

    Returns:
        Effects for `spoil`. Noise is off in a fifth of the draws, and losses are off in three tenths.
    """
    noisy, lossy = rng.random(2) < (0.8, 0.7)
    return Effects(
        range_noise=noisy * rng.uniform(0, 0.03),
        range_noise_growth=noisy * rng.uniform(0, 0.0005),
        dropout=lossy * 0.25 * rng.random() ** 2,
        dropout_range=lossy * rng.uniform(0, 0.4),
        dropout_incidence=lossy * rng.uniform(0, 0.6),
    )

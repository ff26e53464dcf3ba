"""Which sensor measured these points: its rows and columns, found in the points; and whether a given sensor fits them.

Points are in the sensor frame, see `ilnet.sensor`. A row is a cluster of elevations. Two rows of a VLS-128 lie 0.11°
apart, and 2 cm of noise move a point at 5 m by 0.23°. So the density of elevations is smoothed in several ways: by an
angle, or by a length over the range of each point. The peaks of each are candidate rows, and those win that describe
the points in the fewest bits (Schwarz's criterion). Rows whose numbers come with the points need no search.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import fft
from scipy.ndimage import gaussian_filter1d, uniform_filter1d
from scipy.signal import find_peaks

from ilnet.sensor import PRESETS, Sensor
from ilnet.sensors import TABLES

__all__ = ["Fit", "doubt", "fit", "off_rows", "same_rows"]

# Elevations are in degrees here: the numbers below are those that people know.
_BIN = 0.002
_SMOOTHING_ANGLES = (0.004, 0.008, 0.016, 0.03, 0.06, 0.12, 0.25)
_SMOOTHING_LENGTHS = (0.0005, 0.001, 0.002, 0.005, 0.007, 0.01, 0.02, 0.04)  # [m]
_WIDEST = 1.0  # points whose kernel is wider tell nothing
# The scatter of float32 coordinates and of binary digits; less is not told apart.
_LEAST_SCATTER = 2e-4
_LEAST_RETURNS = 3  # of a row
# Share of points that belong to no row: blends at edges, dust.
_STRAY = 0.02

# The least by which rows must shorten the description of a point, against a smooth density of elevations [nats].
_LEAST_GAIN = 0.08
# Points whose median distance from their rows is a smaller part of the spacing are seen from where the beams start.
_SHARP = 0.01
# A smooth density, and how finely beams are focused on a common origin [deg].
_SMOOTH, _FOCUS = 0.5, 0.02
# Beams may start so far from the origin of the points [m]; another origin counts if it makes rows so much sharper.
_FARTHEST_ORIGIN, _LEAST_SHARPENING = 0.3, 1.5
_MOST_FOCUSED = 60_000

# A point lies off its row beyond this part of the spacing there. Of points that know nothing of the rows, 60 % do.
_OFF = 0.2
# A point whose place is unsure by this length [m] tells nothing about rows that are closer than it.
_UNSURE = 0.05
# Elevations are exact if, counted in bins of a width [deg], they repeat so often compared with their surroundings.
_EXACT_BIN, _EXACT = 0.005, 20.0
_FEWEST_JUDGED = 100
# Shares of points off the rows, and of points lost to nearer ones of their pixel, that the right sensor does not reach.
_MOST_OFF, _MOST_LOST = 0.35, 0.45

_FEWEST_COLUMNS, _ANGLE_BINS = 32, 1 << 16
# An empty sector beyond it is no gap in a full circle [rad].
_WIDEST_GAP = math.radians(10)


@dataclass(frozen=True, eq=False)
class Fit:
    """A sensor that was found in points.

    Args:
        sensor: Its rows from the highest down, its columns from the left, even. Its limits are those of the preset that
            has the same rows; without one, 0 m and 100 m, or as far as the points reach.
        returns: (H,) number of points of each row.
        scatter: (H,) median distance of the points of a row from its elevation [rad].
        origin: How far the beams start from the z axis, and how far above the origin of the points [m]; the elevations
            are those seen from there. Both are 0 for most sensors.
        off: Share of the points that lie off the rows; see `off_rows`.
    """

    sensor: Sensor
    returns: np.ndarray
    scatter: np.ndarray
    origin: tuple[float, float]
    off: float

    @property
    def unsure(self) -> np.ndarray:
        """Whether the points of a row scatter so much that it may be another, or two: (H,) bool."""
        gaps = np.abs(np.diff(self.sensor.elevations))
        nearest = np.minimum(np.append(gaps, np.inf), np.append(np.inf, gaps))
        return self.scatter > 0.25 * nearest


def fit(clouds: Sequence[np.ndarray], rings: Sequence[np.ndarray | None] | None = None) -> Fit:
    """Returns the sensor that measured clouds of points.

    A row without a return in any cloud cannot be found.

    Args:
        clouds: Each (N, 3) [m], in the sensor frame. Points that are not finite or at the origin are left out.
        rings: For each cloud, the number of the row of each point, (N,), or None where the cloud does not tell; they
            count where every cloud has them.

    Raises:
        ValueError: If there are too few points, or no rows stand out.
    """
    points = np.concatenate([np.asarray(cloud, np.float64)[:, :3] for cloud in clouds])
    ring = None
    if rings is not None and all(of is not None for of in rings):
        ring = np.concatenate([np.asarray(of) for of in rings])
    distance = np.linalg.norm(points, axis=1)
    usable = np.isfinite(distance) & (distance > 0)
    if np.count_nonzero(usable) < 2 * _LEAST_RETURNS:
        raise ValueError(f"points holds {np.count_nonzero(usable)} finite points off the origin; it should hold a scan")
    points = points[usable]
    aside, height = np.hypot(points[:, 0], points[:, 1]), points[:, 2]
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    number = None if ring is None else np.unique(ring[usable], return_inverse=True)[1]
    origin = (0.0, 0.0)
    elevation, distance = _seen(aside, height, origin)
    rows, row = _rows(elevation, distance) if number is None else _told_rows(elevation, number)
    if len(rows) > 1 and np.median(np.abs(elevation - rows[row])) > _SHARP * np.median(np.diff(rows)):
        origin = _origin(aside, height)
        if any(origin):
            elevation, distance = _seen(aside, height, origin)
            rows, row = _rows(elevation, distance) if number is None else _told_rows(elevation, number)
    if len(rows) < 2 or not (np.diff(rows) > 0).all():
        raise ValueError(f"{len(rows)} row(s) stand out in {len(points)} points; a sensor has at least 2, apart")
    if ring is None and _gain(elevation, distance, rows) < _LEAST_GAIN:
        raise ValueError(
            f"no rows stand out in {len(points)} points; they should be of one sensor with rows, in its frame, "
            "upright, and neither moved nor merged from several places"
        )
    away = np.abs(elevation - rows[row])
    returns, scatter = np.bincount(row, minlength=len(rows)), _medians(away, row, 1)
    name = same_rows(np.deg2rad(rows))
    farthest = max(100.0, 10 * math.ceil(distance.max() / 10))
    limits = (0.0, farthest, 1.25 * farthest)
    if name and distance.max() <= PRESETS[name].max_range:
        limits = (PRESETS[name].min_range, PRESETS[name].max_range, PRESETS[name].norm_range)
    sensor = Sensor(np.deg2rad(rows[::-1]), _columns(azimuth, row), *limits, name=name)
    off = off_rows(sensor, np.deg2rad(elevation), distance)
    return Fit(sensor, returns[::-1], np.deg2rad(scatter[::-1]), origin, off)


def off_rows(sensor: Sensor, elevation: np.ndarray, distance: np.ndarray) -> float:
    """Returns the share of points that lie off the rows of a sensor, or NaN where fewer than 100 points can tell.

    A point can tell if it is so far away that 5 cm move it by less than it may lie off. So neither noise nor an origin
    a few centimetres from that of the beams counts. Where no point is so far away, but elevations repeat exactly, all
    can tell.

    Args:
        sensor: The sensor.
        elevation: (N,) of the points [rad].
        distance: (N,) of the points [m].
    """
    rows = np.sort(sensor.elevations)
    gaps = np.diff(rows)
    above = np.searchsorted(rows, elevation)
    spacing = gaps[np.clip(above - 1, 0, len(gaps) - 1)]
    below, above = np.clip(above - 1, 0, None), np.clip(above, None, len(rows) - 1)
    away = np.minimum(np.abs(elevation - rows[below]), np.abs(elevation - rows[above]))
    tells = _UNSURE / distance < _OFF * spacing
    if np.count_nonzero(tells) < _FEWEST_JUDGED and _are_exact(elevation):
        tells = distance > 0
    if np.count_nonzero(tells) < _FEWEST_JUDGED:
        return math.nan
    return float((away > _OFF * spacing)[tells].mean())


def _are_exact(elevation: np.ndarray) -> bool:
    """Returns whether elevations [rad] repeat to a few thousandths of a degree."""
    counts = np.bincount(((np.rad2deg(elevation) + 90) / _EXACT_BIN).astype(np.int64)).astype(np.float64)
    around = uniform_filter1d(counts, round(_SMOOTH / _EXACT_BIN), mode="constant")
    return bool((counts**2).sum() > _EXACT * (counts * around).sum())


def doubt(sensor: Sensor, elevation: np.ndarray, distance: np.ndarray, lost: float) -> str:
    """Returns why a sensor is likely not the one that measured some points, as a sentence; "" where it may well be.

    Args:
        sensor: The sensor.
        elevation: (N,) of the points [rad].
        distance: (N,) of the points [m].
        lost: Share of the points that share a pixel with a nearer one.
    """
    off, name = off_rows(sensor, elevation, distance), sensor.name or "the sensor"
    if off > _MOST_OFF:
        return f"{off:.0%} of the points lie off the rows of {name}; is it the right sensor?"
    if lost > _MOST_LOST:
        return f"{lost:.0%} of the points share a pixel of {name} with a nearer one; is it the right sensor?"
    return ""


def same_rows(elevations: np.ndarray) -> str:
    """Returns the vendor's preset that has these rows to 0.02°, all but a tenth of them; "" if none has."""
    for name in TABLES:
        sensor = PRESETS[name]
        nearest = np.abs(elevations[:, None] - sensor.elevations).argmin(1)
        away = np.abs(elevations - sensor.elevations[nearest]).max()
        missing = len(sensor.elevations) - len(elevations)
        if away < math.radians(0.02) and len(np.unique(nearest)) == len(nearest) and missing <= 0.1 * len(nearest):
            return name
    return ""


def _seen(aside: np.ndarray, height: np.ndarray, origin: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Returns elevation [deg] and distance of points, seen from where the beams start."""
    aside, height = aside - origin[0], height - origin[1]
    return np.rad2deg(np.arctan2(height, aside)), np.hypot(height, aside)


def _origin(aside: np.ndarray, height: np.ndarray) -> tuple[float, float]:
    """Returns from where rows are sharpest: how far from the z axis, and how high [m]; zeros where it hardly counts.

    The points of an Ouster, for example, are seen from its base, some centimetres below its beams. At 5 m that blurs a
    row by more than the spacing.
    """
    if len(aside) > _MOST_FOCUSED:
        some = np.random.default_rng(0).choice(len(aside), _MOST_FOCUSED, replace=False)
        aside, height = aside[some], height[some]

    def sharpness(origin: tuple[float, float], width: float) -> float:
        cell = ((_seen(aside, height, origin)[0] + 180) / width).astype(np.int64)
        return float((np.bincount(cell).astype(np.float64) ** 2).sum())

    start, best = sharpness((0.0, 0.0), _FOCUS), (0.0, 0.0)
    for axis, reach, step, width in (
        (1, _FARTHEST_ORIGIN, 0.01, 5 * _FOCUS),
        (1, 0.02, 0.002, _FOCUS),
        (0, 0.05, 0.002, _FOCUS),
        (1, 0.004, 0.0005, _FOCUS),
        (0, 0.006, 0.0005, _FOCUS / 2),
        (1, 0.004, 0.0005, _FOCUS / 2),
        (0, 0.004, 0.0005, _FOCUS / 2),
    ):
        offsets = np.arange(-round(reach / step), round(reach / step) + 1) * step
        tried = [(best[0] + d, best[1]) if axis == 0 else (best[0], best[1] + d) for d in offsets.tolist()]
        best = max(tried, key=lambda origin: sharpness(origin, width))
        if best == (0.0, 0.0):
            return best
    return best if sharpness(best, _FOCUS) > _LEAST_SHARPENING * start else (0.0, 0.0)


def _medians(values: np.ndarray, number: np.ndarray, least: int) -> np.ndarray:
    """Returns the median of the values of each number, without those that have fewer than `least`."""
    order = np.lexsort((values, number))
    ends = np.flatnonzero(np.diff(number[order])) + 1
    starts = np.append(0, ends)
    counts = np.diff(np.append(starts, len(values)))
    starts, counts = starts[counts >= least], counts[counts >= least]
    sorted_values = values[order]
    return (sorted_values[starts + (counts - 1) // 2] + sorted_values[starts + counts // 2]) / 2


def _told_rows(elevation: np.ndarray, number: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the median elevation of each row, rising [deg], and the row of each point, from its number."""
    rows = _medians(elevation, number, 1)
    order = np.argsort(rows, kind="stable")
    return rows[order], np.argsort(order)[number]


def _rows(elevation: np.ndarray, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the elevations of the rows that stand out, rising [deg], and the row of each point."""
    best, fewest = np.empty(0), math.inf
    for angle, length in [(a, 0.0) for a in _SMOOTHING_ANGLES] + [(0.0, s) for s in _SMOOTHING_LENGTHS]:
        rows = _peaks(elevation, distance, angle, length)
        for _ in range(2):
            if len(rows) > 1:
                rows = np.unique(_medians(elevation, _nearest(rows, elevation), _LEAST_RETURNS))
        if len(rows) > 1:
            nats = _description(elevation, distance, rows, length)
            best, fewest = (rows, nats) if nats < fewest else (best, fewest)
            if np.median(np.abs(elevation - rows[_nearest(rows, elevation)])) < _LEAST_SCATTER:
                break  # sharper than that, nothing is gained by smoothing
    return best, _nearest(best, elevation)


def _nearest(rows: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    """Returns the number of the row that is nearest to each point."""
    return np.searchsorted((rows[1:] + rows[:-1]) / 2, elevation)


def _peaks(elevation: np.ndarray, distance: np.ndarray, angle: float, length: float) -> np.ndarray:
    """Returns where the density of elevations has peaks, smoothed by an angle [deg] or a length [m] over the range."""
    lowest = elevation.min() - 4 * _WIDEST
    bins = fft.next_fast_len(int((elevation.max() - lowest + 4 * _WIDEST) / _BIN) + 1, real=True)
    cell = ((elevation - lowest) / _BIN).astype(np.int64)
    parts = [(cell, angle)]
    if length:  # half octaves of range share a kernel
        half_octave = np.floor(2 * np.log2(distance)).astype(np.int64)
        widths = {int(n): max(math.degrees(length * 2 ** -((n + 0.5) / 2)), 2 * _BIN) for n in np.unique(half_octave)}
        parts = [(cell[half_octave == n], width) for n, width in widths.items() if width < _WIDEST]
    if not parts:
        return np.empty(0)
    frequency = fft.rfftfreq(bins, _BIN)
    spectrum = np.zeros(len(frequency), np.complex128)
    for cells, width in parts:
        kernel = np.exp(-2 * (math.pi * width * frequency) ** 2)
        spectrum += fft.rfft(np.bincount(cells, minlength=bins).astype(np.float64)) * kernel
    density = fft.irfft(spectrum, bins)
    # Nearly the height of `_LEAST_RETURNS` equal elevations.
    least = 0.8 * _LEAST_RETURNS * _BIN / (math.sqrt(math.tau) * min(width for _, width in parts))
    found, _ = find_peaks(density, prominence=least)
    return lowest + (found + 0.5) * _BIN


def _scale(away: np.ndarray, distance: np.ndarray, length: float) -> np.ndarray:
    """Returns the scale of Laplace's law for each point: one for all or, where `length` is not 0, over the range."""
    scale = np.median(away * distance) / distance if length else np.full_like(away, np.median(away))
    return np.maximum(scale / math.log(2), _LEAST_SCATTER)


def _description(elevation: np.ndarray, distance: np.ndarray, rows: np.ndarray, length: float) -> float:
    """Returns how long a description of the elevations by rows is [nats]: which row, how far from it, and the rows."""
    row = _nearest(rows, elevation)
    away = np.abs(elevation - rows[row])
    scale = _scale(away, distance, length)
    chance = (1 - _STRAY) * np.exp(-away / scale) / (2 * scale) + _STRAY / (np.ptp(rows) + 1)
    share = np.bincount(row, minlength=len(rows))[row] / len(row)
    return float(-np.log(share * chance).sum() + len(rows) * math.log(len(row)))


def _gain(elevation: np.ndarray, distance: np.ndarray, rows: np.ndarray) -> float:
    """Returns by how much rows shorten the description of a point, against a smooth density of elevations [nats]."""
    counts, edges = np.histogram(elevation, np.arange(elevation.min() - 2, elevation.max() + 2, _BIN))
    density = gaussian_filter1d(counts / len(elevation) / _BIN, _SMOOTH / _BIN, mode="constant")
    smooth = density[np.searchsorted(edges, elevation, "right") - 1]
    row = _nearest(rows, elevation)
    scale = _scale(np.abs(elevation - rows[row]), distance, 1.0)
    share = np.bincount(row, minlength=len(rows)) / len(row)
    above = np.searchsorted(rows, elevation)
    chance = _STRAY * smooth
    for near, there in ((above - 1, above > 0), (above, above < len(rows))):
        near = np.clip(near, 0, len(rows) - 1)
        law = np.exp(-np.abs(elevation - rows[near]) / scale) / (2 * scale)
        chance = chance + np.where(there, (1 - _STRAY) * share[near] * law, 0.0)
    return float(np.log(chance / smooth).mean() - len(rows) * math.log(len(row)) / len(row))


def _columns(azimuth: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Returns the azimuths of even columns, falling [rad]: those of a full turn from 180° or below, or of a sector."""
    # A grid of W columns a turn is a line in the spectrum at W, in each row, wherever the row starts.
    cell = np.floor((azimuth + math.pi) / math.tau * _ANGLE_BINS).astype(np.int64) % _ANGLE_BINS
    power, total = np.zeros(_ANGLE_BINS // 8), np.zeros(_ANGLE_BINS // 8, dtype=np.complex128)
    for number in np.unique(row):
        cells = cell[row == number]
        spectrum = np.fft.rfft(np.bincount(cells, minlength=_ANGLE_BINS))[: len(power)]
        power += np.abs(spectrum) ** 2 / len(cells)
        total += spectrum
    power[:_FEWEST_COLUMNS] = 0
    if power.max() > 10 * np.median(power[_FEWEST_COLUMNS:]):
        first = int(np.flatnonzero(power > 0.5 * power.max())[0])  # multiples are lines too
        columns = first + int(power[first : first + first // 2].argmax())  # in a sector lines are wide
    else:  # no grid: as many as the usual step of a row allows
        order = np.lexsort((azimuth, row))
        steps = np.diff(azimuth[order])[np.diff(row[order]) == 0]
        steps = steps[steps > math.tau / _ANGLE_BINS * 8]
        columns = int(np.clip(math.tau / np.median(steps), _FEWEST_COLUMNS, _ANGLE_BINS // 8)) if len(steps) else 1024
    step = math.tau / columns
    # Half a bin: cells are known by their lower edge.
    phase = (-np.angle(total[columns]) / columns + math.pi / _ANGLE_BINS - math.pi) % step
    occupied = np.unique(cell) * (math.tau / _ANGLE_BINS) - math.pi
    gaps = np.diff(np.append(occupied, occupied[0] + math.tau))
    widest = int(gaps.argmax())
    if gaps[widest] < max(_WIDEST_GAP, 3 * step):
        last = math.ceil((-math.pi - phase) / step - 1e-6)
        return phase + step * np.arange(last, last + columns)[::-1]
    right, left = occupied[(widest + 1) % len(occupied)], occupied[widest]
    left += math.tau if left < right else 0.0
    first, last = round((right - phase) / step), round((left - phase) / step)
    return phase + step * np.arange(first, max(last, first + 1) + 1)[::-1]

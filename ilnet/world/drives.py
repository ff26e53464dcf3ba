"""Drives through a town: a car that follows lanes and turns at junctions, and the traffic that moves around it."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from ilnet.world import simulate, towns
from ilnet.world.places import Place
from kernels import Mesh

__all__ = ["PERIOD", "SPEED", "Drive", "drive"]

PERIOD = 0.1
"""Time from one scan to the next [s]."""
SPEED = 10.0
"""Speed of the car on a straight road [m/s]."""
# In a turn it is slower, by this acceleration to the side [m/s²].
_SIDEWAYS = 2.5
# Speeds of other vehicles [m/s].
_OTHERS = (5.0, 12.0)
# Waypoints that follow each other on a lane are no farther apart [m], nor are their headings [rad].
_GAP, _KINK = 2.5, 0.5
# A turn begins and ends so far from where the two lanes would cross [m], changes the heading so much [rad], and stays
# so near to lanes [m], which is on the carriageway.
_REACH = (4.0, 11.0)
_BEND = (0.35, 2.1)
_ON_ROAD = 2.0
# Nothing comes nearer to the car than this, from middle to middle [m].
_ROOM = 7.0
# Beyond this distance a vehicle is not drawn [m]: a LiDAR of 80 m does not see it.
_SEEN = 90.0


class _Turn(NamedTuple):
    """From one lane into another."""

    leave: int
    """Number of the last waypoint on the one."""
    lane: int
    enter: int
    """Number of the first waypoint on the other."""
    path: np.ndarray
    """(K, 3) points between the two [m]."""


@dataclass(frozen=True, eq=False)
class Drive:
    """A drive of N scans, `PERIOD` seconds apart.

    Attributes:
        place: What stands still along the way, parked cars and people included.
        poses: (N, 4, 4) float64 poses of a level sensor above the lanes, which looks ahead.
        moving: The vehicles that move, as they stand when the drive begins.
        lanes: The lane that each of them follows, (K, 3) points [m].
        speeds: Their speeds [m/s].
    """

    place: Place
    poses: torch.Tensor
    moving: towns.Things
    lanes: Sequence[np.ndarray]
    speeds: np.ndarray

    def world(self, number: int) -> list[Mesh]:
        """Returns what surrounds the sensor at scan `number`."""
        spots = self._spots[number]
        things = self.moving._replace(spot=spots)
        away = np.hypot(*(spots[:, :2] - self.poses[number, :2, 3].numpy()).T)
        vertices, triangles = things.some(away < _SEEN).mesh()
        still = self.place.mesh
        return [still, Mesh(vertices, triangles, self.place.device)] if len(triangles) else [still]

    @cached_property
    def _spots(self) -> np.ndarray:
        """Where the moving vehicles are at each scan, (N, K, 4) as `towns.Things.spot`."""
        return _moved(self.moving, self.lanes, self.speeds, np.arange(len(self.poses)) * PERIOD)


def drive(place: Place, scans: int, seed: int = 0) -> Drive:
    """Finds a way through a town, and drives it.

    The car begins a lane and follows it, and turns into lanes where it has not been. It drives at `SPEED`, and slower
    in turns. Parked cars and people stand still. Other vehicles follow their lanes, each at its own speed, and begin
    them again at their ends; those that would come too near to the car are left out.

    Args:
        place: A town.
        scans: Number of scans.
        seed: Seed of the traffic.

    Raises:
        ValueError: If there is no town, or no way that is long enough.
    """
    if place.town is None:
        raise ValueError("place has no lanes; it should be a town")
    poses = _timed(_route(place, scans * SPEED * PERIOD), scans)
    things = towns.draw(place.town, poses[0, :3, 3].numpy(), seed, radius=math.inf)
    track = poses[:, :2, 3].numpy()
    still, moving = things.some(~things.drives), things.some(things.drives)
    still = still.some(cKDTree(track).query(still.spot[:, :2])[0] > 2.0)
    vertices, triangles = still.mesh()
    stands = Place(
        np.concatenate([place.vertices, vertices]),
        np.concatenate([place.triangles, triangles + len(place.vertices)]),
        place.waypoints,
        place.headings,
        device=place.device,
    )
    lanes = _lanes(place)
    nearest = cKDTree(place.waypoints[:, :2]).query(moving.spot[:, :2])[1]
    of = [next(k for k, lane in enumerate(lanes) if lane[-1] >= number) for number in nearest]
    speeds = np.random.default_rng(seed).uniform(*_OTHERS, len(of))
    ways = [place.waypoints[lanes[lane]].astype(np.float64) for lane in of]
    spots = _moved(moving, ways, speeds, np.arange(scans) * PERIOD)
    clear = (np.hypot(*(spots[..., :2] - track[:, None]).transpose(2, 0, 1)) > _ROOM).all(0)
    return Drive(stands, poses, moving.some(clear), [w for w, c in zip(ways, clear, strict=True) if c], speeds[clear])


def _lanes(place: Place) -> list[np.ndarray]:
    """Returns the numbers of the waypoints of each lane."""
    step = np.linalg.norm(np.diff(place.waypoints, axis=0), axis=1)
    kink = np.abs((np.diff(place.headings) + np.pi) % (2 * np.pi) - np.pi)
    ends = np.nonzero((step > _GAP) | (kink > _KINK))[0] + 1
    return [lane for lane in np.split(np.arange(len(place.waypoints)), ends) if len(lane) > 1]


def _route(place: Place, length: float) -> np.ndarray:
    """Returns points (K, 3) [m] along the first way found that is at least `length` metres long."""
    lanes = _lanes(place)
    numbers = range(len(lanes))
    turns = [[t for other in numbers if (t := _turn(place, lanes, lane, other))] for lane in numbers]
    step = float(np.linalg.norm(np.diff(place.waypoints[lanes[0]], axis=0), axis=1).mean())
    longest = 0.0

    def ways(lane: int, enter: int, seen: frozenset[int], driven: float) -> Iterator[list[np.ndarray]]:
        nonlocal longest
        end = lanes[lane][-1]
        longest = max(longest, driven + (end - enter) * step)
        if driven + (end - enter) * step >= length:
            yield [place.waypoints[enter : end + 1]]
        for turn in sorted(turns[lane], key=lambda turn: -turn.leave):
            if turn.leave > enter + 3 and turn.lane not in seen:
                so_far = driven + (turn.leave - enter) * step + 10
                for rest in ways(turn.lane, turn.enter, seen | {turn.lane}, so_far):
                    yield [place.waypoints[enter : turn.leave + 1], turn.path, *rest]

    for lane in sorted(numbers, key=lambda lane: -len(lanes[lane])):
        for found in ways(lane, int(lanes[lane][0]), frozenset({lane}), 0.0):
            return np.concatenate(found).astype(np.float64)
    raise ValueError(
        f"scans asks for a way of {length:.0f} m; the longest that was found has {longest:.0f} m: ask for fewer scans"
    )


def _turn(place: Place, lanes: Sequence[np.ndarray], one: int, other: int) -> _Turn | None:
    """Returns the smoothest turn from one lane into another, a parabola between the two; None if there is none."""
    if one == other:
        return None
    points, heading = place.waypoints.astype(np.float64), place.headings.astype(np.float64)
    best: tuple[float, _Turn] | None = None
    i, j = (k.ravel() for k in np.meshgrid(lanes[one], lanes[other], indexing="ij"))
    gap = points[j, :2] - points[i, :2]
    ahead = np.stack([np.cos(heading), np.sin(heading)], 1)
    bend = np.abs((heading[j] - heading[i] + np.pi) % (2 * np.pi) - np.pi)
    cross = ahead[i, 0] * ahead[j, 1] - ahead[i, 1] * ahead[j, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        before = (gap[:, 0] * ahead[j, 1] - gap[:, 1] * ahead[j, 0]) / cross
        after = (ahead[i, 0] * gap[:, 1] - ahead[i, 1] * gap[:, 0]) / cross
    fits = (bend > _BEND[0]) & (bend < _BEND[1])
    for way in (before, after):
        fits &= (way > _REACH[0]) & (way < _REACH[1])
    road = cKDTree(points[:, :2])
    for k in np.nonzero(fits)[0]:
        start, end = points[i[k]], points[j[k]]
        corner = np.append(start[:2] + before[k] * ahead[i[k]], (start[2] + end[2]) / 2)
        t = np.linspace(0, 1, 9)[1:-1, None]
        path = (1 - t) ** 2 * start + 2 * t * (1 - t) * corner + t**2 * end
        if road.query(path[:, :2])[0].max() < _ON_ROAD:
            worth = min(before[k], after[k]) - abs(before[k] - after[k])
            if best is None or worth > best[0]:
                best = worth, _Turn(int(i[k]), other, int(j[k]), path)
    return best[1] if best else None


def _timed(points: np.ndarray, scans: int) -> torch.Tensor:
    """Returns the poses (N, 4, 4) of a car that drives along points (K, 3) [m]."""
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    curve = CubicSpline(along, points)
    s = np.arange(0, along[-1], 0.05)
    first, second = curve(s, 1)[:, :2].T, curve(s, 2)[:, :2].T
    bend = np.abs(first[0] * second[1] - first[1] * second[0])
    speed = np.minimum(SPEED, np.sqrt(_SIDEWAYS / np.maximum(bend, 1e-9)))
    window = np.ones(201) / 201  # It brakes and gains speed over 10 m.
    speed = np.convolve(np.pad(speed, 100, mode="edge"), window, mode="valid")
    times = np.append(0.0, np.cumsum(0.05 / speed[:-1]))
    at = np.interp(np.arange(scans) * PERIOD, times, s)
    position, ahead = curve(at), curve(at, 1)
    position[:, 2] += towns.SENSOR_HEIGHT
    return simulate.pose(torch.tensor(position), torch.tensor(np.arctan2(ahead[:, 1], ahead[:, 0])))


def _moved(things: towns.Things, lanes: Sequence[np.ndarray], speeds: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Returns the spots (N, K, 4) of K things after N times [s], moved along their lanes (..., 3) [m]."""
    spots = np.empty((len(times), len(lanes), 4))
    for k, lane in enumerate(lanes):
        along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(lane, axis=0), axis=1)))
        start = np.hypot(*(lane[:, :2] - things.spot[k, :2]).T).argmin()
        s = (along[start] + speeds[k] * times) % max(along[-1], 1e-9)
        position = np.stack([np.interp(s, along, column) for column in lane.T], 1)
        turned = np.unwrap(np.arctan2(*np.gradient(lane[:, :2], axis=0).T[::-1]))
        heading = np.interp(s, along, turned)
        # It keeps as far to the right of the lane's middle as it was drawn.
        gap = things.spot[k, :2] - lane[start, :2]
        right = gap[0] * math.sin(things.spot[k, 3]) - gap[1] * math.cos(things.spot[k, 3])
        position[:, :2] += right * np.stack([np.sin(heading), -np.cos(heading)], 1)
        spots[:, k] = np.column_stack([position, heading])
    return spots

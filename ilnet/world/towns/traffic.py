"""Traffic, drawn anew for every scan: vehicles on the lanes and at the kerb, people on the pavements."""

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ilnet.world.towns import vehicles
from ilnet.world.towns.parts import EMPTY, Part, merge, place, raster
from ilnet.world.towns.town import LIDAR_REACH, WAYPOINT_SPACING, Town

__all__ = ["BICYCLES", "PEOPLE", "Things", "draw", "traffic"]

# Numbers of the kinds, in the order of `_fleet`.
_CARS, _VAN, _LORRY, _BUS, _CYCLIST, _BICYCLE, PEOPLE = (0, 1, 2), 3, 4, 5, 6, 7, (8, 9, 10)
BICYCLES = _CYCLIST, _BICYCLE
# The sensor's own car is not drawn. So much is kept free for it ahead and behind, and to each side [m].
_OWN_CAR = (4.5, 1.3)
# Vehicles differ in length, width and height by up to 5 %.
_STRETCH = 1.05


class _Kind(NamedTuple):
    """A kind of vehicle or person."""

    part: Part
    """Stands at the origin and faces +x."""
    half_length: float
    """From its middle to its front, of the largest one, metres."""
    half_width: float
    """From its middle to its side, of the largest one, metres."""
    gap: float
    """Distance kept free ahead and behind while it drives, metres."""


class Things(NamedTuple):
    """N vehicles and people that may be drawn. Where two overlap, the later one is left out."""

    spot: np.ndarray
    """(N, 4) x, y, z [m] and heading [rad]."""
    slope: np.ndarray
    """(N,) rise over run along the heading."""
    kind: np.ndarray
    """(N,) number of the kind; some have names, such as `PEOPLE`."""
    gap: np.ndarray
    """(N,) distance kept free ahead and behind, metres."""
    drives: np.ndarray
    """(N,) bool, whether it moves along a lane."""
    scale: np.ndarray
    """(N, 3) its size relative to the kind, along its own axes."""

    def some(self, pick: np.ndarray) -> "Things":
        """Returns some of them, by their numbers or by a mask (N,)."""
        return Things(*(column[pick] for column in self))

    def mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns vertices (V, 3) float32 [m] and triangles (F, 3) int32."""
        part = merge([_instances(self, number) for number in range(len(_fleet()))])
        return raster(part.vertices), part.triangles.astype(np.int32)

    def owners(self) -> np.ndarray:
        """Returns the number (F,) of the thing that each triangle of `mesh` belongs to."""
        order = np.argsort(self.kind, kind="stable")
        return np.repeat(order, [len(_fleet()[kind].part.triangles) for kind in self.kind[order]])


@cache
def _fleet() -> tuple[_Kind, ...]:
    """Returns all kinds, by the numbers above."""
    walkers = [vehicles.pedestrian(*pose) for pose in ((0.7, 0.25), (0.5, 0.15), (0.1, 0.05))]
    gaps = {_LORRY: 3.5, _BUS: 3.5, _CYCLIST: 0.8} | dict.fromkeys((*_CARS, _VAN), 1.0)
    heavy = [vehicles.van(), vehicles.lorry(), vehicles.bus()]
    parts = [*map(vehicles.car, range(3)), *heavy, vehicles.cyclist(), vehicles.bicycle()]
    kinds = []
    for number, part in enumerate(parts + walkers):
        reach = np.abs(part.vertices[:, :2]).max(0) * _STRETCH
        kinds.append(_Kind(part, float(reach[0]), float(reach[1]), gaps.get(number, 0.1)))
    return tuple(kinds)


def draw(
    town: Town,
    at: ArrayLike,
    seed: int | Sequence[int],
    radius: float = LIDAR_REACH,
    sector: tuple[float, float] | None = None,
) -> Things:
    """Draws the vehicles and people around a sensor. Another seed draws others, more or fewer.

    No two overlap. The sensor's own car is not drawn, and its lane is free for about 5 m.

    Args:
        town: The town around the sensor.
        at: (3,) position of the sensor in the town's frame, metres.
        seed: Seed of the draw; the same town, position and seed give the same things.
        radius: Largest distance from the sensor at which they are drawn, metres.
        sector: For a sensor that does not see the full circle: the direction in which it looks (rad counter-clockwise
            from +x) and half the width of its field of view (rad). What stands outside is left out; the rest does not
            change.

    Raises:
        ValueError: If `at` is not three finite numbers.
    """
    position = np.asarray(at, dtype=np.float64)
    if position.shape != (3,) or not np.isfinite(position).all():
        raise ValueError(f"at is {at!r}; it should be three finite numbers: x, y and z in metres")
    rng, sensor = np.random.default_rng(seed), position[:2]
    near = np.nonzero(_distance(town.waypoints, sensor) < radius)[0]
    lane = np.column_stack([town.waypoints[near], town.headings[near]]).astype(np.float64)
    slope = _slope(town, near)
    parking, walks = (
        spots[_distance(spots, sensor) < radius].astype(np.float64) for spots in (town.parking, town.walks)
    )
    drawn = [
        _driving(lane, slope, walks, rng),
        _crossing(lane, walks, rng),
        _parked(parking, lane, slope, rng),
        _walking(walks, rng),
    ]
    things = Things(*(np.concatenate(column) for column in zip(*drawn, strict=True)))
    heading = lane[_distance(lane, sensor).argmin(), 3] if len(lane) else 0.0
    things = things.some(_apart(things, sensor, heading))
    things = things._replace(scale=rng.uniform(2 - _STRETCH, _STRETCH, (len(things.kind), 3)))
    return things.some(_in_sector(things, sensor, *sector)) if sector else things


def traffic(
    town: Town, at: ArrayLike, seed: int | Sequence[int], sector: tuple[float, float] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the mesh of what `draw` draws, whose arguments it takes, within the reach of a LiDAR.

    Returns:
        Vertices (V, 3) float32 [m] and triangles (F, 3) int32; both empty if nothing was drawn.

    Raises:
        ValueError: If `at` is not three finite numbers.
    """
    return draw(town, at, seed, sector=sector).mesh()


def _distance(points: np.ndarray, sensor: np.ndarray) -> np.ndarray:
    """Returns the horizontal distances (N,) [m] of points (N, 2 or more) from a sensor (2,)."""
    return np.hypot(points[:, 0] - sensor[0], points[:, 1] - sensor[1])


def _in_sector(things: Things, sensor: np.ndarray, heading: float, half: float) -> np.ndarray:
    """Returns which things reach into a sector, as (N,) bool. The circle around each one decides."""
    away = things.spot[:, :2] - sensor
    distance = np.hypot(away[:, 0], away[:, 1])
    reach = np.array([np.hypot(k.half_length, k.half_width) for k in _fleet()])[things.kind]
    aside = np.abs(np.mod(np.arctan2(away[:, 1], away[:, 0]) - heading + np.pi, 2 * np.pi) - np.pi)
    return (distance <= reach) | (aside < half + np.arcsin(np.minimum(reach / np.maximum(distance, 1e-9), 1)))


def _slope(town: Town, near: np.ndarray) -> np.ndarray:
    """Returns rise over run (N,) from waypoints `near` to the next on their lanes; 0 at the end of a lane."""
    step = (town.waypoints[np.minimum(near + 1, len(town.waypoints) - 1)] - town.waypoints[near]).astype(np.float64)
    run = np.hypot(step[:, 0], step[:, 1])
    # Waypoints on one lane are about `WAYPOINT_SPACING` apart; the first one of another lane is not.
    return np.where((run > 1.0) & (run < 2.5), step[:, 2] / np.maximum(run, 1.0), 0.0)


def _things(spot: np.ndarray, slope: ArrayLike, kind: np.ndarray, drives: bool) -> Things:
    """Returns things with the gaps of their kinds if they drive, else with small ones."""
    count = len(spot)
    gap = np.array([k.gap for k in _fleet()])[kind] if drives else np.full(count, 0.1)
    slopes = np.broadcast_to(np.asarray(slope, dtype=np.float64), (count,))
    return Things(spot, slopes, kind, gap, np.full(count, drives), np.ones((count, 3)))


def _aside(spot: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Returns spots (N, 4) moved `right` (N,) metres to the right of their headings."""
    step = np.column_stack([np.sin(spot[:, 3]), -np.cos(spot[:, 3])]) * right[:, None]
    return np.column_stack([spot[:, :2] + step, spot[:, 2:]])


def _driving(lane: np.ndarray, slope: np.ndarray, walks: np.ndarray, rng: np.random.Generator) -> Things:
    """Draws what drives on the lanes, from a few vehicles to dense traffic.

    Cyclists keep to the right, and to streets that have people beside them.
    """
    spacing = np.exp(rng.uniform(np.log(16), np.log(110)))
    pick = rng.permutation(np.nonzero(rng.random(len(lane)) < WAYPOINT_SPACING / spacing)[0])
    lorries, cyclists = rng.uniform(0.03, 0.2), rng.uniform(0.0, 0.12)
    cars = 0.87 - lorries - cyclists
    share = [0.4 * cars, 0.35 * cars, 0.25 * cars, 0.13, 0.8 * lorries, 0.2 * lorries, cyclists]
    kind = rng.choice([*_CARS, _VAN, _LORRY, _BUS, _CYCLIST], len(pick), p=share)
    kind = np.where((kind == _CYCLIST) & ~_beside(lane[pick], walks), _CARS[0], kind)
    right = np.where(kind == _CYCLIST, 0.75, rng.uniform(-0.15, 0.15, len(pick)))
    return _things(_aside(lane[pick], right), slope[pick], kind, drives=True)


def _crossing(lane: np.ndarray, walks: np.ndarray, rng: np.random.Generator) -> Things:
    """Draws a few people who cross a lane, where people walk beside it."""
    spot = lane[rng.random(len(lane)) < rng.uniform(0, 5) / max(len(lane), 1)]
    spot = spot[_beside(spot, walks)]
    spot = _aside(spot, rng.uniform(-1.5, 1.5, len(spot)))
    spot[:, 3] += np.pi / 2 * rng.choice([-1, 1], len(spot))
    return _things(spot, 0.0, rng.choice(PEOPLE, len(spot)), drives=False)


def _beside(lane: np.ndarray, walks: np.ndarray) -> np.ndarray:
    """Returns which of points (N, 4) on lanes have a spot for people within 12 m, as (N,) bool."""
    return (np.hypot(*(lane[:, None, k] - walks[None, :, k] for k in (0, 1))) < 12).any(1)


def _parked(parking: np.ndarray, lane: np.ndarray, slope: np.ndarray, rng: np.random.Generator) -> Things:
    """Draws parked cars, vans and a few bicycles; most face the way the traffic goes."""
    spot = parking[rng.random(len(parking)) < rng.uniform(0.15, 0.75)]
    kind = rng.choice([*_CARS, _VAN, _BICYCLE], len(spot), p=[0.36, 0.27, 0.22, 0.12, 0.03])
    spot[:, 3] += np.pi * (rng.random(len(spot)) < 0.15) + rng.normal(0, 0.02, len(spot))
    tilt = np.zeros(len(spot))
    if len(spot) and len(lane):  # They stand as steeply as the lane beside them.
        beside = np.hypot(*(spot[:, None, k] - lane[None, :, k] for k in (0, 1))).argmin(1)
        tilt = slope[beside] * np.cos(spot[:, 3] - lane[beside, 3])
    return _things(spot, tilt, kind, drives=False)


def _walking(walks: np.ndarray, rng: np.random.Generator) -> Things:
    """Draws people on the pavements, and a few bicycles."""
    spot = walks[rng.random(len(walks)) < rng.uniform(0.02, 0.3)]
    kind = rng.choice([*PEOPLE, _BICYCLE], len(spot), p=[0.35, 0.3, 0.2, 0.15])
    return _things(spot, 0.0, kind, drives=False)


def _apart(things: Things, sensor: np.ndarray, heading: float) -> np.ndarray:
    """Returns the numbers of the things that overlap neither the sensor's car nor a thing kept before them.

    Two rectangles overlap if, along each of the four axes of the two, the distance between their centres is less than
    the sum of their half extents.
    """
    fleet = _fleet()
    length = np.array([k.half_length for k in fleet])[things.kind] + things.gap
    width = np.array([k.half_width for k in fleet])[things.kind]
    centre = np.concatenate([[sensor], things.spot[:, :2]])
    turn = np.concatenate([[heading], things.spot[:, 3]])
    length, width = np.concatenate([[_OWN_CAR[0]], length]), np.concatenate([[_OWN_CAR[1]], width])
    axis = np.column_stack([np.cos(turn), np.sin(turn)])
    gap = centre[None] - centre[:, None]
    along = np.abs(gap[..., 0] * axis[:, None, 0] + gap[..., 1] * axis[:, None, 1])
    across = np.abs(gap[..., 1] * axis[:, None, 0] - gap[..., 0] * axis[:, None, 1])
    cos, sin = np.abs(np.cos(turn[:, None] - turn)), np.abs(np.sin(turn[:, None] - turn))
    meet = (along < length[:, None] + length * cos + width * sin) & (
        across < width[:, None] + length * sin + width * cos
    )
    meet &= meet.T
    kept = np.zeros(len(turn), dtype=bool)
    for number in range(len(turn)):
        kept[number] = not (meet[number] & kept).any()
    return np.nonzero(kept[1:])[0]


def _instances(things: Things, number: int) -> Part:
    """Returns the mesh of all things of one kind, tilted like the road."""
    pick = things.kind == number
    if not pick.any():
        return EMPTY
    part = _fleet()[number].part
    spot, scale = things.spot[pick], things.scale[pick]
    placed = place(part, spot[:, :3], spot[:, 3], scale)
    rise = part.vertices[:, 0] * (scale[:, :1] * things.slope[pick, None])
    return Part(placed.vertices + np.array([0.0, 0.0, 1.0]) * rise.reshape(-1, 1), placed.triangles)

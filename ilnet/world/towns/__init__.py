"""Procedural towns: streets of triangles to drive a simulated LiDAR through, and traffic drawn anew for each scan.

How a plan (`town01.py` to `town10.py`) becomes a town (the steps are in `plan.py`):

1. The ground is laid and the streets are cut into it (`streets.py`).
2. The landmarks of this plan are set on it (`landmarks.py`).
3. Each side of each street is filled with lots: buildings, gardens, yards (`frontage.py`, `buildings.py`).
4. The streets and fields are dressed: lamps, signs, parking, trees (`dressing.py`, `furniture.py`, `plants.py`).
5. The site (`site.py`), which has collected all this, gives the town: mesh, waypoints and spots (`town.py`).

Afterwards `traffic.py` places vehicles and people (`vehicles.py`) around a sensor.
"""

from ilnet.world.towns import town01, town02, town03, town04, town05, town06, town07, town10
from ilnet.world.towns.plan import build_town
from ilnet.world.towns.town import SENSOR_HEIGHT, Town
from ilnet.world.towns.traffic import BICYCLES, PEOPLE, Things, draw, traffic

__all__ = [
    "BICYCLES",
    "NAMES",
    "PEOPLE",
    "SENSOR_HEIGHT",
    "TEST",
    "TRAIN",
    "WAYPOINTS",
    "Things",
    "Town",
    "build",
    "draw",
    "traffic",
]

# Each plan with its number of waypoints. As in the paper, the towns for training (the first six) have 22,244 and the
# towns for testing 2,847.
_TOWNS = {
    "town01": (town01.PLAN, 3050),
    "town02": (town02.PLAN, 2620),
    "town03": (town03.PLAN, 3450),
    "town04": (town04.PLAN, 4930),
    "town05": (town05.PLAN, 5224),
    "town06": (town06.PLAN, 2970),
    "town07": (town07.PLAN, 1385),
    "town10": (town10.PLAN, 1462),
}
NAMES = tuple(_TOWNS)
TRAIN, TEST = NAMES[:6], NAMES[6:]
WAYPOINTS = {name: count for name, (_, count) in _TOWNS.items()}


def build(name: str, seed: int = 0) -> Town:
    """Returns a town; the same name and seed give the same arrays on every machine.

    Args:
        name: One of `NAMES`.
        seed: Another seed gives another town of the same character.

    Raises:
        ValueError: If `name` is not one of `NAMES`.
    """
    if name not in _TOWNS:
        raise ValueError(f"name is {name!r}; it should be one of: {', '.join(NAMES)}")
    plan, waypoints = _TOWNS[name]
    return build_town(plan, name, seed, waypoints)

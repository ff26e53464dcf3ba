"""Procedural towns: streets of triangles to drive a simulated LiDAR through, and traffic drawn anew for each scan."""

from ilnet.world.towns import town01, town02, town03, town04, town05, town06, town07, town10
from ilnet.world.towns.plan import raise_town
from ilnet.world.towns.town import Town
from ilnet.world.towns.traffic import traffic

__all__ = ["NAMES", "TEST", "TRAIN", "WAYPOINTS", "Town", "build", "traffic"]

# plans, and how many waypoints to keep: 22,244 in the towns to train in and 2,847 in those to test in, as in the paper
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
    """Build a town; the same name and seed give the same arrays everywhere.

    Args:
        name: one of NAMES.
        seed: another seed gives another town of the same character.

    Raises:
        ValueError: for an unknown name.
    """
    if name not in _TOWNS:
        raise ValueError(f"name is {name!r}, should be one of: {', '.join(NAMES)}")
    plan, waypoints = _TOWNS[name]
    return raise_town(plan, name, seed, waypoints)

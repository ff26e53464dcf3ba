"""How a plan becomes a town: ground, landmarks, lots, dressing, in this order."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ilnet.world.towns.dressing import dress_street, plant_fields
from ilnet.world.towns.frontage import build_lots
from ilnet.world.towns.plants import Greens, greenery
from ilnet.world.towns.site import Site
from ilnet.world.towns.streets import KERB_HEIGHT, Ground, Street
from ilnet.world.towns.town import LIDAR_REACH, Town

__all__ = ["Plan", "build_town"]

# The ground ends beyond the reach of a LiDAR on the outermost street [m].
_MARGIN = LIDAR_REACH + 10.0


@dataclass(frozen=True)
class Plan:
    """The streets, landmarks and slopes that tell one town from another.

    Attributes:
        streets: Draws the streets; its result maps their names to them.
        landmarks: Builds what only this town has. It runs before the lots along the streets are filled.
        steepness: Rise over run of the steepest slope, approximately.
        kerb_height: Height of pavements and lots above the carriageway, metres.
    """

    streets: Callable[[np.random.Generator], dict[str, Street]]
    landmarks: Callable[[Site, dict[str, Street], Greens, np.random.Generator], None]
    steepness: float = 0.055
    kerb_height: float = KERB_HEIGHT


def build_town(plan: Plan, name: str, seed: int, waypoints: int) -> Town:
    """Returns the town of a plan. The number in its name and the seed decide every random choice.

    Args:
        plan: What to build.
        name: Name of the town; its last two characters are its number.
        seed: Another seed gives another town of the same character.
        waypoints: Largest number of waypoints to keep.
    """
    rng = np.random.default_rng([int(name[-2:]), seed])
    streets = plan.streets(rng)
    lines = list(streets.values())
    reach = max(np.abs(s.line_in_town).max() for s in lines)
    site = Site(Ground(lines, reach + _MARGIN, rng, plan.steepness, plan.kerb_height))
    greens = greenery(rng)
    plan.landmarks(site, streets, greens, rng)
    for street in lines:
        for side in street.sides:
            build_lots(site, street, side, greens, rng)
    for street in lines:
        dress_street(site, street, greens, rng)
    plant_fields(site, greens, reach + 40, rng)
    return site.town(name, seed, waypoints)

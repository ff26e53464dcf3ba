"""How a plan becomes a town: ground, landmarks, lots along the streets, furniture, fields."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ilnet.world.towns.dressing import dress_street, plant_fields
from ilnet.world.towns.frontage import build_lots
from ilnet.world.towns.plants import Greens, greenery
from ilnet.world.towns.site import Site
from ilnet.world.towns.streets import KERB, Ground, Street
from ilnet.world.towns.town import Town

__all__ = ["Plan", "raise_town"]

_MARGIN = 95.0  # metres of land around the town: a little more than a LiDAR's reach


@dataclass(frozen=True)
class Plan:
    """What tells one town from another.

    Attributes:
        streets: draws the streets by their names.
        landmarks: builds what stands nowhere else, before the lots along the streets are filled.
        steepness: rise over run of the steepest slope, about.
        kerb: metres.
    """

    streets: Callable[[np.random.Generator], dict[str, Street]]
    landmarks: Callable[[Site, dict[str, Street], Greens, np.random.Generator], None]
    steepness: float = 0.055
    kerb: float = KERB


def raise_town(plan: Plan, name: str, seed: int, waypoints: int) -> Town:
    """Returns the town of a plan; its name and seed decide the draw.

    Args:
        plan: what to build.
        name: ends in the town's two-digit number.
        seed: another seed gives another town of the same character.
        waypoints: how many to keep at most.
    """
    rng = np.random.default_rng([int(name[-2:]), seed])
    streets = plan.streets(rng)
    lines = list(streets.values())
    reach = max(np.abs(s.core).max() for s in lines)
    site = Site(Ground(lines, reach + _MARGIN, rng, plan.steepness, plan.kerb))
    greens = greenery(rng)
    plan.landmarks(site, streets, greens, rng)
    for street in lines:
        for side in street.sides:
            build_lots(site, street, side, greens, rng)
    for street in lines:
        dress_street(site, street, greens, rng)
    plant_fields(site, greens, reach + 40, rng)
    return site.town(name, seed, waypoints)

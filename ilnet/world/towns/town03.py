"""town03: a hilly town of winding roads around a large roundabout, with terraces behind retaining walls."""

import numpy as np

from ilnet.world.towns.landmarks import island, park
from ilnet.world.towns.plan import Plan
from ilnet.world.towns.plants import Greens
from ilnet.world.towns.site import Site
from ilnet.world.towns.streets import Draft, Street

__all__ = ["PLAN"]


def _streets(rng: np.random.Generator) -> dict[str, Street]:
    """Returns the streets of a town of about 500 m by 500 m."""
    draft = Draft(rng, 12.0)
    curve, on = draft.curve, draft.on
    ring = draft.ring((0, 0), 21.0)
    east = curve([on(ring, 0.0), (80, -25), (150, 25), (240, -10)], "s")
    north = curve([on(ring, 0.25), (25, 85), (-20, 140), (30, 190), (0, 245)], "s")
    west = curve([on(ring, 0.5), (-80, 30), (-150, -15), (-245, 30)], "s")
    south = curve([on(ring, 0.75), (-15, -90), (30, -155), (-10, -245)], "s")
    crescent = curve([on(north, 0.5), (60, 150), (110, 130), (120, 75), on(east, 0.55)], "se")
    steps = curve([on(west, 0.55), (-150, 60), (-90, 85), (-90, 130), (-150, 140), (-160, 190), (-110, 240)], "s")
    quarry = curve([on(south, 0.5), (-80, -120), (-130, -75), on(west, 0.62)], "se")
    cliff = curve([on(east, 0.72), (150, -70), (90, -105), (100, -160), (180, -180), (225, -235)], "s")
    narrow = curve([on(cliff, 0.5), (60, -150), on(south, 0.62)], "se")
    top = curve([on(steps, 0.66), (-100, 175), (-55, 175), on(north, 0.72)], "se")
    mill = curve([on(west, 0.8), (-205, -70), (-165, -140), (-90, -185), on(south, 0.76)], "se")
    ridge = curve([on(crescent, 0.45), (165, 165), (205, 110), (250, 115)], "s")
    half = rng.uniform(5.0, 5.5, 10)

    def road(line: np.ndarray, number: int, frontage: str, pavement: float = 2.2) -> Street:
        return Street(line, half[number], (1.6,), frontage, pavement)

    def lane(line: np.ndarray, frontage: str) -> Street:
        return Street(line, 3.2, (1.5,), frontage, 1.7, parking=False)

    return draft.settle(
        {
            "ring": Street(ring, 5.2, (-1.9, 1.9), "none", 3.0, parking=False, oneway=True, sides=(1,)),
            "east": road(east, 0, "shops", 3.0),
            "north": road(north, 1, "hillside"),
            "west": road(west, 2, "towers", 3.2),
            "south": road(south, 3, "rows"),
            "crescent": road(crescent, 4, "hillside"),
            "steps": lane(steps, "hillside"),
            "quarry": road(quarry, 5, "rows"),
            "cliff": lane(cliff, "hillside"),
            "narrow": lane(narrow, "rows"),
            "top": lane(top, "houses"),
            "mill": road(mill, 6, "houses"),
            "ridge": lane(ridge, "hillside"),
        }
    )


def _landmarks(site: Site, streets: dict[str, Street], greens: Greens, rng: np.random.Generator) -> None:
    """Fills the roundabout with trees and a statue, and builds a park on a slope."""
    island(site, streets["ring"], greens, rng)
    park(site, streets["crescent"], 0.45, 1, 46.0, 34.0, greens, rng)


PLAN = Plan(_streets, _landmarks, steepness=0.125)

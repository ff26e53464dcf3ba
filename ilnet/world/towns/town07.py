"""town07: farms, barns and fields along narrow lanes without kerbs, with walls, hedges, banks and rows of trees."""

import numpy as np

from ilnet.world.towns.landmarks import fields
from ilnet.world.towns.plan import Plan
from ilnet.world.towns.plants import Greens
from ilnet.world.towns.site import Site
from ilnet.world.towns.streets import Draft, Street

__all__ = ["PLAN"]


def _streets(rng: np.random.Generator) -> dict[str, Street]:
    """Returns the streets of a town of about 560 m by 440 m."""
    draft = Draft(rng)
    curve, on = draft.curve, draft.on
    road = curve([(-265, -65), (-190, 15), (-70, -30), (40, 35), (160, -20), (265, 40)])
    north = curve([on(road, 0.38), (-60, 60), (-110, 115), (-75, 165)], "s")
    south = curve([on(road, 0.68), (110, -80), (60, -140), (75, -195)], "s")
    track = curve([on(south, 0.5), (0, -110), (-55, -140), (-105, -125)], "s")
    half = rng.uniform(2.6, 2.9, 4)

    def lane(line: np.ndarray, number: int, frontage: str) -> Street:
        return Street(line, half[number], (1.3,), frontage, 0.9, parking=False)

    return draft.settle(
        {
            "road": lane(road, 0, "farms"),
            "north": lane(north, 1, "farms"),
            "south": lane(south, 2, "open"),
            "track": lane(track, 3, "farms"),
        }
    )


def _landmarks(site: Site, streets: dict[str, Street], greens: Greens, rng: np.random.Generator) -> None:
    """Bounds the fields."""
    fields(site, greens, rng)


PLAN = Plan(_streets, _landmarks, steepness=0.07, kerb_height=0.0)

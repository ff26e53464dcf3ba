"""town04: a highway of six lanes that curves past a small settlement, with slip roads and noise walls."""

import numpy as np

from ilnet.world.towns.landmarks import bridge, churchyard, fields, noise_walls
from ilnet.world.towns.plan import Plan
from ilnet.world.towns.plants import Greens
from ilnet.world.towns.site import Site
from ilnet.world.towns.streets import Draft, Street

__all__ = ["PLAN"]

_HIGHWAY_HALF_WIDTH = 14.6


def _streets(rng: np.random.Generator) -> dict[str, Street]:
    """Returns the streets of a town of about 760 m by 480 m."""
    draft = Draft(rng, 9.0)
    curve, on, beside = draft.curve, draft.on, draft.beside
    highway = curve([(-370, -10), (-230, -75), (-60, -95), (110, -70), (250, -10), (370, 95)])
    village = curve([(-245, 120), (-130, 70), (0, 55), (100, 85), (200, 180), (215, 270)])
    off = [
        beside(highway, 0.78, 10.9),
        beside(highway, 0.72, 13.0),
        beside(highway, 0.655, 20),
        (95, 5),
        on(village, 0.56),
    ]
    onto = [
        on(village, 0.3),
        (-95, 10),
        beside(highway, 0.35, 24),
        beside(highway, 0.29, 13.5),
        beside(highway, 0.23, 10.9),
    ]
    north = curve([on(village, 0.33), (-110, 150), (-150, 230)], "s")
    hill = curve([on(village, 0.52), (10, 130), (60, 200), (40, 270)], "s")
    link = curve([on(north, 0.45), (-55, 165), on(hill, 0.5)], "se")
    lane = curve([(-330, -190), (-190, -190), (-20, -200), (150, -180), (330, -150)])
    still = Draft.straight
    return draft.settle(
        {
            "highway": Street(
                highway, _HIGHWAY_HALF_WIDTH, (3.75, 7.25, 10.75), "highway", 3.0, parking=False, median=1.35
            ),
            "village": Street(village, 5.2, (1.6,), "shops", 2.4),
            "off": Street(still(off), 2.7, (0.0,), "ramp", 1.5, parking=False, oneway=True),
            "onto": Street(still(onto), 2.7, (0.0,), "ramp", 1.5, parking=False, oneway=True),
            "north": Street(north, 5.1, (1.6,), "houses", 2.0),
            "hill": Street(hill, 5.1, (1.6,), "rows", 2.0),
            "link": Street(link, 3.1, (1.5,), "cottages", 1.8, parking=False),
            "lane": Street(lane, 3.0, (1.5,), "open", 1.6, parking=False),
        }
    )


def _landmarks(site: Site, streets: dict[str, Street], greens: Greens, rng: np.random.Generator) -> None:
    """Builds noise walls in front of the settlement, a bridge, a church and fields."""
    noise_walls(site, streets["highway"], -1, 0.36, 0.66, rng)
    bridge(site, streets["highway"], 0.51)
    churchyard(site, streets["village"], 0.72, greens, rng)
    fields(site, greens, rng)


PLAN = Plan(_streets, _landmarks, steepness=0.04)

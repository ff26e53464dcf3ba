"""town01: a small town around an avenue, with a market street, rows of houses, gardens and open edges."""

import numpy as np

from ilnet.world.towns.dressing import signals
from ilnet.world.towns.plan import Plan
from ilnet.world.towns.plants import Greens
from ilnet.world.towns.site import Site
from ilnet.world.towns.streets import Draft, Street

__all__ = ["PLAN"]


def _streets(rng: np.random.Generator) -> dict[str, Street]:
    """Returns the streets of a town of about 450 m by 450 m."""
    draft = Draft(rng)
    curve, on = draft.curve, draft.on
    avenue = curve([(-225, -20), (-110, 5), (0, -10), (110, -25), (225, 10)])
    market = curve([(-70, -225), (-55, -110), (-65, 0), (-50, 110), (-75, 225)])
    east = curve([on(avenue, 0.74), (100, 70), (85, 150), (110, 225)], "s")
    link = curve([on(market, 0.78), (-10, 135), (45, 115), on(east, 0.5)], "se")
    loop = curve([on(avenue, 0.82), (150, -80), (95, -150), (10, -135), on(market, 0.24)], "se")
    west = curve([on(market, 0.68), (-120, 95), (-225, 70)], "s")
    lane = curve([on(avenue, 0.12), (-165, 40), on(west, 0.55)], "se")
    south = curve([on(market, 0.14), (-120, -150), (-150, -90), on(avenue, 0.14)], "se")
    rim = curve([on(loop, 0.42), (170, -165), (225, -150)], "s")
    width = rng.uniform(0.0, 0.5, 8)
    wide = rng.uniform(1.4, 2.0)
    inner = wide + 1.75
    return draft.settle(
        {
            "avenue": Street(avenue, inner + 7.35, (inner, inner + 3.3), "towers", rng.uniform(3.2, 4.6), median=wide),
            "market": Street(market, 5.3 + width[0], (1.6,), "shops", rng.uniform(2.2, 3.4)),
            "east": Street(east, 5.4 + width[1], (1.7,), "shops", rng.uniform(2.5, 3.2)),
            "link": Street(link, 5.1 + width[2], (1.5,), "rows", rng.uniform(1.9, 2.6)),
            "loop": Street(loop, 5.2 + width[3], (1.6,), "houses", rng.uniform(1.9, 2.8)),
            "west": Street(west, 3.1 + width[4], (1.5,), "houses", rng.uniform(1.8, 2.4), parking=False),
            "lane": Street(lane, 3.0 + width[5], (1.4,), "rows", 1.6, parking=False),
            "south": Street(south, 5.2 + width[6], (1.6,), "rows", rng.uniform(1.9, 2.6)),
            "rim": Street(rim, 3.2 + width[7], (1.6,), "open", 1.8, parking=False),
        }
    )


def _landmarks(site: Site, streets: dict[str, Street], greens: Greens, rng: np.random.Generator) -> None:
    """Sets traffic lights on the avenue."""
    for other in ("market", "east"):
        signals(site, streets["avenue"], streets[other])


PLAN = Plan(_streets, _landmarks)

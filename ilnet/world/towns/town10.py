"""town10: a dense old centre of narrow curved streets around a market square, with a tram and towers at the edge."""

import numpy as np

from ilnet.world.towns.dressing import signals
from ilnet.world.towns.landmarks import market_square, tram_line
from ilnet.world.towns.plan import Plan
from ilnet.world.towns.plants import Greens
from ilnet.world.towns.site import Site
from ilnet.world.towns.streets import Draft, Street

__all__ = ["PLAN"]


def _streets(rng: np.random.Generator) -> dict[str, Street]:
    """Returns the streets of a town of about 400 m by 380 m."""
    draft = Draft(rng, 7.0)
    curve, on = draft.curve, draft.on
    square = draft.closed([(40, 0), (36, 24), (0, 30), (-38, 26), (-42, 0), (-36, -25), (0, -29), (38, -24)])
    north = curve([on(square, 0.22), (-5, 75), (25, 115), (5, 178)], "s")
    west = curve([on(square, 0.44), (-85, 45), (-130, 30), (-185, 70)], "s")
    south = curve([on(square, 0.68), (-25, -80), (-60, -120), (-45, -180)], "s")
    east = curve([on(square, 0.93), (85, -35), (135, -15), (190, -50)], "s")
    lane = curve([on(west, 0.45), (-95, 85), (-55, 100), on(north, 0.5)], "se")
    alley = curve([on(south, 0.42), (15, -85), (60, -75), on(east, 0.4)], "se")
    boulevard = curve([on(east, 0.72), (150, 60), (95, 130), on(north, 0.8)], "se")
    return draft.settle(
        {
            "square": Street(square, 3.3, (0.0,), "old", 2.2, parking=False, oneway=True, sides=(1,)),
            "north": Street(north, 4.9, (1.5,), "old", 1.9),
            "west": Street(west, 3.1, (1.5,), "old", 1.5, parking=False),
            "south": Street(south, 3.1, (1.5,), "old", 1.6, parking=False),
            "east": Street(east, 4.9, (1.6,), "old", 2.2),
            "lane": Street(lane, 2.9, (1.4,), "old", 1.3, parking=False),
            "alley": Street(alley, 2.9, (1.4,), "old", 1.3, parking=False),
            "boulevard": Street(boulevard, 7.8, (3.6,), "downtown", 3.4, median=1.7),
        }
    )


def _landmarks(site: Site, streets: dict[str, Street], greens: Greens, rng: np.random.Generator) -> None:
    """Builds the market square, the masts and wires of the tram, and traffic lights on the boulevard."""
    market_square(site, streets["square"], greens, rng)
    for name in ("east", "north"):
        tram_line(site, streets[name])
        signals(site, streets["boulevard"], streets[name])


PLAN = Plan(_streets, _landmarks, steepness=0.045)

"""town05: a dense downtown grid of wide streets, towers over arcades, and a park."""

import numpy as np

from ilnet.world.towns.dressing import signals
from ilnet.world.towns.landmarks import green_square
from ilnet.world.towns.plan import Plan
from ilnet.world.towns.plants import Greens
from ilnet.world.towns.site import Site
from ilnet.world.towns.streets import Draft, Street

__all__ = ["PLAN"]


def _streets(rng: np.random.Generator) -> dict[str, Street]:
    """Returns the streets of a town of about 460 m by 440 m."""
    draft = Draft(rng, 5.0)
    lines = {}
    for name, y in (("first", -135), ("second", 0), ("third", 130)):
        lines[name] = draft.curve([(-230, y), (-80, y), (80, y), (230, y)])
    for name, x in (("a", -160), ("b", -55), ("c", 60), ("d", 165)):
        lines[name] = draft.curve([(x, -225), (x, -70), (x, 70), (x, 225)])
    streets = {
        "second": Street(lines["second"], 11.5, (3.4, 6.7), "downtown", 4.2, median=1.6),
        "first": Street(lines["first"], 9.2, (1.7, 5.0), "downtown", 3.4),
        "third": Street(lines["third"], 9.2, (1.7, 5.0), "downtown", 3.4),
        "c": Street(lines["c"], 7.4, (-4.0, 0.0, 4.0), "downtown", 3.2, parking=False, oneway=True),
    }
    for name in "abd":
        streets[name] = Street(lines[name], 5.6, (1.7,), "downtown", rng.uniform(2.6, 3.4))
    return draft.settle(streets)


def _landmarks(site: Site, streets: dict[str, Street], greens: Greens, rng: np.random.Generator) -> None:
    """Sets traffic lights at the crossings, and fills one block with a park."""
    for across in ("first", "second", "third"):
        for along in "abcd":
            signals(site, streets[across], streets[along])
    green_square(site, [streets[name] for name in ("second", "third", "b", "c")], greens, rng)


PLAN = Plan(_streets, _landmarks, steepness=0.035)

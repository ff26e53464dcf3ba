"""town02: a village of cottages and gardens with a church, and side lanes that end in turning circles."""

import numpy as np

from ilnet.world.towns.landmarks import churchyard
from ilnet.world.towns.plan import Plan
from ilnet.world.towns.plants import Greens
from ilnet.world.towns.site import Site
from ilnet.world.towns.streets import Draft, Street

__all__ = ["PLAN"]


def _streets(rng: np.random.Generator) -> dict[str, Street]:
    """Returns the streets of a town of about 500 m by 450 m."""
    draft = Draft(rng)
    curve, on = draft.curve, draft.on
    main = curve([(-250, -50), (-130, 25), (0, -20), (120, 30), (250, -15)])
    mill = curve([on(main, 0.26), (-120, 90), (-95, 150), (-130, 215)], "s")
    church = curve([on(main, 0.6), (45, 80), (110, 130), (60, 200)], "s")
    hollow = curve([on(main, 0.44), (-35, -100), (-80, -150), (-60, -225)], "s")
    green = curve([on(main, 0.8), (145, -70), (90, -150), (10, -150), on(hollow, 0.62)], "se")
    field = curve([on(mill, 0.62), (-180, 120), (-250, 150)], "s")
    close = curve([on(church, 0.42), (130, 80), (190, 110)], "s")
    yard = curve([on(hollow, 0.3), (-110, -70), (-170, -95)], "s")
    end = curve([on(green, 0.4), (160, -160), (210, -120)], "s")
    back = curve([on(mill, 0.75), (-45, 180), (10, 160), on(church, 0.78)], "se")
    half = rng.uniform(2.9, 3.3, 10)

    def street(line: np.ndarray, number: int, frontage: str = "cottages") -> Street:
        return Street(line, half[number], (1.5,), frontage, rng.uniform(1.5, 2.2), parking=False)

    def turning(line: np.ndarray) -> Street:
        return Street(draft.ring((line[-1, 0], line[-1, 1]), 4.5), 4.6, (), "none", 1.6, parking=False, sides=())

    return draft.settle(
        {
            "main": Street(main, 4.9 + half[0] / 3, (1.6,), "cottages", 2.3),
            "mill": street(mill, 1, "houses"),
            "church": street(church, 2),
            "hollow": street(hollow, 3),
            "green": street(green, 4, "houses"),
            "field": street(field, 5, "open"),
            "close": street(close, 6),
            "yard": street(yard, 7),
            "end": street(end, 8, "houses"),
            "back": street(back, 9),
            "close turning": turning(close),
            "yard turning": turning(yard),
            "end turning": turning(end),
            "church turning": turning(church),
            "mill turning": turning(mill),
        }
    )


def _landmarks(site: Site, streets: dict[str, Street], greens: Greens, rng: np.random.Generator) -> None:
    """Builds the church."""
    churchyard(site, streets["main"], 0.52, greens, rng)


PLAN = Plan(_streets, _landmarks, steepness=0.045)

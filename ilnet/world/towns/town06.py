"""town06: halls, warehouses and yards along wide roads, with tanks, containers and a power line."""

import numpy as np

from ilnet.world.towns.dressing import signals
from ilnet.world.towns.landmarks import container_yard, power_line, tank_farm
from ilnet.world.towns.plan import Plan
from ilnet.world.towns.plants import Greens
from ilnet.world.towns.site import Site
from ilnet.world.towns.streets import Draft, Street

__all__ = ["PLAN"]


def _streets(rng: np.random.Generator) -> dict[str, Street]:
    """Returns the streets of a town of about 560 m by 500 m."""
    draft = Draft(rng, 10.0)
    curve, on = draft.curve, draft.on
    spine = curve([(-280, -30), (-120, 0), (60, -15), (280, 30)])
    gate = curve([(-130, -250), (-115, -120), (-120, 0), (-100, 120), (-120, 250)])
    dock = curve([(125, -245), (110, -110), (125, 0), (110, 130), (135, 245)])
    north = curve([on(gate, 0.84), (-30, 175), (50, 165), on(dock, 0.82)], "se")
    south = curve([on(gate, 0.16), (-20, -165), (60, -180), on(dock, 0.14)], "se")
    rail = curve([on(gate, 0.66), (-190, 90), (-280, 130)], "s")
    half = rng.uniform(6.0, 6.9, 6)
    return draft.settle(
        {
            "spine": Street(spine, 9.6, (2.9, 6.3), "works", 2.6, median=1.1, parking=False),
            "gate": Street(gate, half[0], (1.9,), "works", 2.4),
            "dock": Street(dock, half[1], (1.9,), "works", 2.4),
            "north": Street(north, half[2], (1.9,), "works", 2.0),
            "south": Street(south, half[3], (1.9,), "works", 2.0),
            "rail": Street(rail, half[4], (1.9,), "works", 2.0),
        }
    )


def _landmarks(site: Site, streets: dict[str, Street], greens: Greens, rng: np.random.Generator) -> None:
    """Builds traffic lights, a tank farm, two container yards and a power line."""
    for other in ("gate", "dock"):
        signals(site, streets["spine"], streets[other])
    tank_farm(site, streets["dock"], 0.3, 1, rng)
    container_yard(site, streets["gate"], 0.34, 1, rng)
    container_yard(site, streets["dock"], 0.7, -1, rng)
    power_line(site, streets["spine"], 46.0, rng)


PLAN = Plan(_streets, _landmarks, steepness=0.025)

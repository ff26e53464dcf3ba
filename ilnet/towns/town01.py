"""town01: a small town around an avenue, with a market street, rows, gardens and open edges."""

import numpy as np

from ilnet.towns.dressing import dress_street, greenery, plant_fields, signals
from ilnet.towns.frontage import build_lots
from ilnet.towns.site import Site
from ilnet.towns.streets import Ground, Street, spline
from ilnet.towns.town import Town

__all__ = ["plan"]


def _streets(rng: np.random.Generator) -> list[Street]:
    """The plan, on about 450 m x 450 m."""
    mirror = rng.choice([-1.0, 1.0])
    turn = rng.uniform(-0.2, 0.2) + np.pi / 2 * int(rng.integers(0, 4))
    rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])

    def curve(points: list[tuple[float, float]], fixed: str = "") -> np.ndarray:
        """A jittered spline; `fixed` says which ends ("s", "e") lie on another street and stay."""
        at = np.array(points, dtype=np.float64)
        wobble = rng.uniform(-14, 14, at.shape)
        if "s" in fixed:
            wobble[0] = 0
        if "e" in fixed:
            wobble[-1] = 0
        return spline(at + wobble)

    def on(line: np.ndarray, share: float) -> tuple[float, float]:
        x, y = line[round(share * (len(line) - 1))]
        return float(x), float(y)

    avenue = curve([(-225, -20), (-110, 5), (0, -10), (110, -25), (225, 10)])
    market = curve([(-70, -225), (-55, -110), (-65, 0), (-50, 110), (-75, 225)])
    east = curve([on(avenue, 0.74), (100, 70), (85, 150), (110, 225)], "s")
    link = curve([on(market, 0.78), (-10, 135), (45, 115), on(east, 0.5)], "se")
    loop = curve([on(avenue, 0.82), (150, -80), (95, -150), (10, -135), on(market, 0.24)], "se")
    west = curve([on(market, 0.68), (-120, 95), (-225, 70)], "s")
    lane = curve([on(avenue, 0.12), (-165, 40), on(west, 0.55)], "se")
    south = curve([on(market, 0.14), (-120, -150), (-150, -90), on(avenue, 0.14)], "se")
    rim = curve([on(loop, 0.42), (170, -165), (225, -150)], "s")
    width = rng.uniform(0.0, 0.5, 9)
    wide, market_half = rng.uniform(1.4, 2.0), 5.3 + width[0]
    inner = wide + 1.75
    streets = [
        Street(avenue, inner + 3.3 + 1.75 + 2.3, (inner, inner + 3.3), "towers", rng.uniform(3.2, 4.6), median=wide),
        Street(market, market_half, (1.6,), "shops", rng.uniform(2.2, 3.4)),
        Street(east, 5.4 + width[1], (1.7,), "shops", rng.uniform(2.5, 3.2)),
        Street(link, 5.1 + width[2], (1.5,), "rows", rng.uniform(1.9, 2.6)),
        Street(loop, 5.2 + width[3], (1.6,), "houses", rng.uniform(1.9, 2.8)),
        Street(west, 3.1 + width[4], (1.5,), "houses", rng.uniform(1.8, 2.4), parking=False),
        Street(lane, 3.0 + width[5], (1.4,), "rows", 1.6, parking=False),
        Street(south, 5.2 + width[6], (1.6,), "rows", rng.uniform(1.9, 2.6)),
        Street(rim, 3.2 + width[7], (1.6,), "open", 1.8, parking=False),
    ]
    return [Street(**{**vars(s), "line": s.line * (1, mirror) @ rotation}) for s in streets]


def plan(seed: int) -> Town:
    """Build town01."""
    rng = np.random.default_rng([1, seed])
    streets = _streets(rng)
    reach = max(np.abs(s.line).max() for s in streets)
    site = Site(Ground(streets, reach + 100, rng))
    greens = greenery(rng)
    for street in streets:
        for side in (1, -1):
            build_lots(site, street, side, greens, rng)
    for street in streets:
        dress_street(site, street, greens, rng)
    avenue, market, east = streets[:3]
    for other in (market, east):
        signals(site, avenue, other)
    plant_fields(site, greens, reach + 40, rng)
    return site.town("town01", seed)

"""Procedural towns: streets of triangles to drive a simulated LiDAR through."""

from ilnet.towns.town import Town
from ilnet.towns.town01 import plan as _town01
from ilnet.towns.traffic import traffic

__all__ = ["NAMES", "Town", "build", "traffic"]

_PLANS = {"town01": _town01}
NAMES = tuple(_PLANS)


def build(name: str, seed: int = 0) -> Town:
    """Build a town; the same name and seed give the same arrays everywhere.

    Args:
        name: one of NAMES.
        seed: another seed gives another town of the same character.

    Raises:
        ValueError: for an unknown name.
    """
    if name not in _PLANS:
        raise ValueError(f"name is {name!r}, should be one of: {', '.join(NAMES)}")
    return _PLANS[name](seed)

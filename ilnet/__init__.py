"""The Implicit LiDAR Network (ICRA 2022): sensors, scans, towns, models, training and evaluation.

The modules that are used most have short names here: `from ilnet import data, models, simulate`. Each is imported on
first use.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ilnet.learning import evaluate, metrics, train
    from ilnet.world import effects, meshes, places, rosette, simulate, towns

__all__ = ["effects", "evaluate", "meshes", "metrics", "places", "rosette", "simulate", "towns", "train"]

_ROOMS = {
    "learning": ("evaluate", "metrics", "train"),
    "world": ("effects", "meshes", "places", "rosette", "simulate", "towns"),
}


def __getattr__(name: str) -> Any:
    for room, modules in _ROOMS.items():
        if name in modules:
            return import_module(f"ilnet.{room}.{name}")
    raise AttributeError(f"module 'ilnet' has no attribute {name!r}")

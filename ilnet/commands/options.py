"""Options that hold more than one value: lists of towns and sizes, effects with their values."""

from collections.abc import Iterable
from dataclasses import fields
from typing import Any

from ilnet import memory
from ilnet.sensor import PAPER_INPUT, PRESETS, Sensor, parse_size
from ilnet.world.effects import Effects
from ilnet.world.towns import NAMES

__all__ = ["effects", "error_line", "sensors", "towns"]

# Those that show in ranges, which are all that an archive holds.
_EFFECTS = tuple(field.name for field in fields(Effects) if field.name != "intensity")


def towns(text: str) -> list[tuple[str, int]]:
    """Returns the names and seeds in a list such as "town01,town02:7"; without a number the seed is 0."""
    found = []
    for label in text.split(","):
        name, _, seed = label.partition(":")
        if name not in NAMES or not (seed or "0").isdecimal():
            raise ValueError(
                f"--towns names {label!r}; it should be one of {', '.join(NAMES)}, or such as {NAMES[0]}:7, the same "
                "town with another seed"
            )
        found.append((name, int(seed or 0)))
    return found


def sensors(text: str) -> list[Sensor]:
    """Returns the paper's sensor for each size in a list such as "16x1024,64x1024": even beams over ±15°, 2 to 80 m."""
    found = []
    for size in text.split(","):
        try:
            shape = parse_size(size)
        except ValueError as error:
            raise ValueError(f"--sizes: {error}") from None
        found.append(PRESETS.get(f"paper-{size}") or PAPER_INPUT.resize(*shape))
    return found


def error_line(error: BaseException) -> str:
    """Returns one line on an error, with the option that helps where there is one."""
    line = " ".join(str(error).split())
    if memory.ran_out(error):
        return f"there is not enough memory: {line or 'try a smaller size'}"
    if isinstance(error, memory.TooLarge) or isinstance(error.__cause__, memory.TooLarge):
        line += ": --max-memory GB"
    return line


def effects(settings: Iterable[str]) -> Effects | None:
    """Returns the effects that settings such as "range_noise=0.02" or "velocity=10,0,0" name; None without any."""
    values: dict[str, Any] = {}
    for setting in settings:
        name, _, value = setting.partition("=")
        if name not in _EFFECTS:
            raise ValueError(f"--effect is {setting!r}; it should be NAME=VALUE, with a name of: {', '.join(_EFFECTS)}")
        values[name] = value.split(",") if isinstance(getattr(Effects(), name), tuple) else value
    return Effects(**values) if values else None

"""How much memory one file or one size may ask for. What asks for more is refused before any is taken."""

import contextlib
from collections.abc import Iterator

__all__ = ["LIMIT", "TooLarge", "check", "limit", "limited", "ran_out"]

LIMIT = 2_000_000_000
"""The limit by default [bytes]."""

_limit: float = LIMIT


class TooLarge(ValueError):
    """Something asks for more memory than the limit."""


def check(what: str, needed: int) -> None:
    """Raises a `TooLarge` if `what` needs more memory than the limit.

    Args:
        what: What needs it, as the first words of the message.
        needed: About how much [bytes].
    """
    if needed > _limit:
        amount = f"about {needed / 1e9:.3g} GB" if needed < 1e18 else "more than a billion GB"
        raise TooLarge(f"{what} would take {amount} of memory; the limit is {_limit / 1e9:g} GB")


def ran_out(error: BaseException) -> bool:
    """Returns whether an error says that there is not enough memory, in Python's words or in torch's."""
    says = "can't allocate memory" in str(error) or type(error).__name__ == "OutOfMemoryError"
    return isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and says)


def limit() -> float:
    """Returns the limit of this process [bytes]."""
    return _limit


@contextlib.contextmanager
def limited(size: float) -> Iterator[None]:
    """Sets the limit [bytes] of this process inside a `with` block."""
    global _limit
    before, _limit = _limit, size
    try:
        yield
    finally:
        _limit = before

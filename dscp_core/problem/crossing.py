"""Where something changes its sign, for simulations whose flights end by event."""

from __future__ import annotations

from collections.abc import Callable


def crossing(rising: Callable[..., float], end: float) -> float:
    """Where a function that goes from below zero at 0 to above does so, to rounding.

    Args:
        rising: The function; not below zero at the end.
        end: Where to look no further.
    """
    low, high = 0.0, end
    while True:
        middle = 0.5 * (low + high)
        if not low < middle < high:
            return high
        if rising(middle) >= 0.0:
            high = middle
        else:
            low = middle

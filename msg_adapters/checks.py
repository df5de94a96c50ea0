"""Checks that several adapters share; each raises the numbered error of its cause."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from msg_adapters.errors import InputCode, RejectedInputError


def require_finite(values: Iterable[tuple[str, float]]) -> None:
    """Check named numbers.

    Args:
        values: Pairs of field name and value.

    Raises:
        RejectedInputError: NOT_FINITE, for the first offender.
    """
    for field, value in values:
        if not math.isfinite(value):
            raise RejectedInputError(InputCode.NOT_FINITE, field, float(value), "finite")


def require_frame(field: str, frame: str, expected: str | None = None) -> None:
    """Check a frame id.

    Raises:
        RejectedInputError: EMPTY_FRAME, or WRONG_FRAME where one is expected.
    """
    if not frame:
        bound = f"'{expected}'" if expected else "a frame id"
        raise RejectedInputError(InputCode.EMPTY_FRAME, field, frame, bound)
    if expected is not None and frame != expected:
        raise RejectedInputError(InputCode.WRONG_FRAME, field, frame, f"'{expected}'")


def require_names(field: str, names: Sequence[str], expected: Sequence[str]) -> None:
    """Check that ``names`` holds every expected name once, in any order.

    Raises:
        RejectedInputError: DUPLICATE_NAME, UNKNOWN_NAME or MISSING_NAME.
    """
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise RejectedInputError(InputCode.DUPLICATE_NAME, field, name, "each name once")
        if name not in expected:
            bound = f"one of {', '.join(expected)}"
            raise RejectedInputError(InputCode.UNKNOWN_NAME, field, name, bound)
        seen.add(name)
    for name in expected:
        if name not in seen:
            bound = f"every one of {', '.join(expected)}"
            raise RejectedInputError(InputCode.MISSING_NAME, field, list(names), f"{bound}: {name}")


def require_length(field: str, length: int, expected: int, *, empty_allowed: bool = False) -> None:
    """Check an array's length.

    Raises:
        RejectedInputError: WRONG_ARRAY_LENGTH.
    """
    if length == expected or (empty_allowed and length == 0):
        return
    bound = f"length {expected}{' or 0' if empty_allowed else ''}"
    raise RejectedInputError(InputCode.WRONG_ARRAY_LENGTH, f"{field} length", length, bound)

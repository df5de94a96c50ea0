"""Numbered causes for which a message is refused."""

from __future__ import annotations

from enum import IntEnum
from typing import Any

from dscp_core.errors import InvalidInputError


class InputCode(IntEnum):
    """Why an input was refused; the hundreds follow the order in which inputs are checked.

    Numbers below 100 are left to `dscp_core.planning.plan.PlanStatus`, so that one ``code`` in a
    report tells both apart.
    """

    NOT_FINITE = 101
    """A field that is used holds NaN or an infinity."""

    EMPTY_FRAME = 201
    """A frame id is empty."""
    WRONG_FRAME = 202
    """A frame id is not the expected one."""

    MISSING_NAME = 301
    """A named scalar is missing."""
    DUPLICATE_NAME = 302
    """A named scalar is given twice."""
    UNKNOWN_NAME = 303
    """A named scalar that the problem does not have."""
    WRONG_ARRAY_LENGTH = 304
    """An array's length does not fit the names."""
    TIME_NOT_INCREASING = 305
    """Times of trajectory points do not start at zero and increase."""

    NON_UNIT_QUATERNION = 401
    """The attitude that rotates the velocity has a norm other than 1."""
    MASS_NOT_POSITIVE = 402
    """Mass is zero or negative."""
    BELOW_GROUND = 403
    """Altitude is below the landing site by more than the tolerance."""
    OUT_OF_RANGE = 404
    """A position or speed beyond the plausible."""

    INVALID_STAMP = 501
    """The stamp is no time: negative seconds, or a billion nanoseconds and more."""
    STALE_STAMP = 502
    """The stamp is older than the permitted age."""
    FUTURE_STAMP = 503
    """The stamp is ahead of the clock by more than the tolerance."""

    STAMP_BACKWARD = 601
    """The stamp is not after the last accepted one."""

    MASS_MISSING = 701
    """A state without mass arrived, and neither a mass message nor a fallback is there."""
    MASS_STALE = 702
    """A state without mass arrived, the last mass is too old, and there is no fallback."""
    STATE_MISSING = 703
    """A plan was asked for before any state was accepted."""

    REPORT_MISSING_KEY = 801
    """A report lacks a key that every report has."""
    REPORT_BAD_VALUE = 802
    """A report's value cannot be read."""


class RejectedInputError(InvalidInputError):
    """A message was refused.

    Attributes:
        code: The cause.
        field: Name of the offending field.
        value: The value that was given.
        bound: What was expected.
    """

    def __init__(self, code: InputCode, field: str, value: Any, bound: str) -> None:
        super().__init__(field, value, bound)
        self.code = code

    def __str__(self) -> str:
        return f"{self.code.name} ({self.code.value}): {super().__str__()}"

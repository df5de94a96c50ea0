"""Exceptions shared by every package of the project."""

from __future__ import annotations

from typing import Any


class DscpError(Exception):
    """Base class of every error that this project raises on purpose.

    Example:
        >>> from dscp_core import DscpError, problems
        >>> try:
        ...     problems.get("ascent")
        ... except DscpError as error:
        ...     print(type(error).__name__)
        InvalidInputError
    """


class InvalidInputError(DscpError, ValueError):
    """A value from outside violates a stated bound.

    Attributes:
        field: Name of the offending field or parameter.
        value: The value that was given.
        bound: What was expected, in words or as an interval.

    Example:
        >>> from dscp_core import InvalidInputError
        >>> str(InvalidInputError("mass", -1.0, "> 0 kg"))
        'mass: got -1.0, expected > 0 kg'
    """

    def __init__(self, field: str, value: Any, bound: str) -> None:
        super().__init__(f"{field}: got {value!r}, expected {bound}")
        self.field = field
        self.value = value
        self.bound = bound

    def __reduce__(self) -> tuple[type[InvalidInputError], tuple[str, Any, str]]:
        """Rebuild from the three parts, not the message: it crosses process boundaries."""
        return type(self), (self.field, self.value, self.bound)


class HelperLostError(DscpError):
    """A process that computes for this one is gone or silent, which says nothing of any result."""

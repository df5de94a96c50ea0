"""How a flight ends, and what it may burn on the way: parts of a declaration for a certificate."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dscp_core.errors import InvalidInputError
from dscp_core.problem import checks
from dscp_core.problem.parameters import ParameterTable
from dscp_core.problem.tracing import KnownParameters, of_values

Tolerance = float | Callable[[Mapping[str, Any]], float]
"""A number, or a function of the parameters' values by name."""


def accepted_tolerance(
    what: str,
    tolerance: Tolerance,
    table: ParameterTable,
    values: KnownParameters,
    *,
    infinite: bool = False,
) -> float:
    """A tolerance for the values of the parameters.

    Args:
        what: The tolerance, as messages call it.
        tolerance: As declared.
        table: Parameters of the problem.
        values: Of them.
        infinite: Whether a function may return infinity.

    Raises:
        InvalidInputError: The function raises, or returns no number from zero.
    """
    value = of_values(what, table, tolerance, values) if callable(tolerance) else tolerance
    if not (infinite and isinstance(value, float) and value == math.inf):
        checks.not_negative(what, value)
    return float(value)


def require_tolerance(what: str, tolerance: Any) -> None:
    """Refuse what is neither a function nor a number from zero.

    Raises:
        InvalidInputError: With the value.
    """
    if not callable(tolerance):
        checks.not_negative(what, tolerance)


@dataclass(frozen=True)
class EventLimit:
    """A number that a certificate checks where a flight meets the event that it is meant to meet.

    Attributes:
        name: Name in reports.
        expression: ``(x, u, p)`` to a nonnegative scalar, SI; u is what was held last, before any
            control `EndEvent.after` the plan.
        unit: Its unit.
        tolerance: Largest value that a certificate accepts, or a function of the parameters' values
            that returns it.

    Example:
        >>> import casadi as ca
        >>> from dscp_core import EventLimit
        >>> tilt = lambda x, u, p: ca.atan2(ca.norm_2(u[1:3]), u[0])
        >>> EventLimit("contact_tilt", tilt, "rad", lambda values: values["contact_tilt_max"]).unit
        'rad'
    """

    name: str
    expression: Callable[[ca.SX, ca.SX, Mapping[str, ca.SX]], ca.SX]
    unit: str
    tolerance: Tolerance

    def __post_init__(self) -> None:
        what = f"end event's limit {self.name}"
        checks.named("name of an end event's limit", self.name)
        checks.plain(what, self)
        checks.function(what, self.expression)
        require_tolerance(f"tolerance of {what}", self.tolerance)


@dataclass(frozen=True)
class EndEvent:
    """Where a flight ends, whatever the plan says: where a quantity falls through zero.

    A flight that is meant to end there and has not by the plan's end goes on; one that is not meant
    to, and does, fails its certificate.

    Attributes:
        name: In reports, such as ``contact``.
        expression: ``(x, p)`` to a scalar, SI; the flight ends where it falls through zero.
        floor: Name of the check that it has not fallen further.
        unit: Of the expression.
        tolerance: How far below zero it may be on the way, in ``unit``: for a start that is
            measured with noise. A number, or a function of the parameters' values.
        meant: Whether flights are meant to end there, from the parameters' values; None for always.
        after: The control (nu,), SI, from the plan's end to the event, from the parameters' values;
            None where nothing can be flown then.
        patience_s: How long the flight may go on after the plan's end.
        limits: What is checked at the event.

    Example:
        >>> from dscp_core import EndEvent
        >>> contact = EndEvent("contact", lambda x, p: x[0], "altitude_floor", "m", tolerance=0.02)
        >>> contact.patience_s
        20.0
    """

    name: str
    expression: Callable[[ca.SX, Mapping[str, ca.SX]], ca.SX]
    floor: str
    unit: str
    tolerance: Tolerance
    meant: Callable[[Mapping[str, Any]], bool] | None = None
    after: Callable[[Mapping[str, Any]], Sequence[float]] | None = None
    patience_s: float = 20.0
    limits: tuple[EventLimit, ...] = ()

    def __post_init__(self) -> None:
        checks.named("name of the end event", self.name)
        what = f"end event {self.name}"
        checks.named(f"floor of {what}", self.floor)
        checks.plain(what, self)
        for function in (self.expression, self.meant, self.after):
            if function is not None:
                checks.function(what, function)
        require_tolerance(f"tolerance of {what}", self.tolerance)
        checks.positive(f"patience_s of {what}", self.patience_s)
        limits = checks.members(f"limits of {what}", self.limits, EventLimit)
        object.__setattr__(self, "limits", limits)

    def is_meant(self, table: ParameterTable, values: KnownParameters) -> bool:
        """Whether flights with these values of the parameters are meant to end there."""
        if self.meant is None:
            return True
        return bool(of_values(f"meant of end event {self.name}", table, self.meant, values))

    def control_after(
        self, table: ParameterTable, values: KnownParameters, size: int
    ) -> NDArray[np.float64] | None:
        """Control (size,), SI, from the plan's end on; None where nothing can be flown.

        Raises:
            InvalidInputError: The function raises, or returns something else.
        """
        if self.after is None:
            return None
        what = f"after of end event {self.name}"
        given = of_values(what, table, self.after, values)
        try:
            control = np.asarray(given, dtype=np.float64)
        except (TypeError, ValueError):
            control = np.full(0, np.nan)
        if control.shape != (size,) or not np.isfinite(control).all():
            raise InvalidInputError(what, given, f"{size} finite numbers")
        return control


@dataclass(frozen=True)
class Propellant:
    """Which state is the mass that a flight burns, and which parameter the mass without propellant.

    Attributes:
        mass: Name of a state, kg.
        dry_mass: Name of a parameter, kg; where its value is 0 nobody knows; None where there is
            none.

    Example:
        >>> from dscp_core import Propellant
        >>> Propellant("mass", "dry_mass").mass
        'mass'
    """

    mass: str
    dry_mass: str | None = None

    def __post_init__(self) -> None:
        checks.plain("propellant", self)

    def require_known(self, states: Sequence[str], table: ParameterTable) -> None:
        """Refuse names that the problem does not have.

        Raises:
            InvalidInputError: No such state or parameter, or a vector.
        """
        if self.mass not in states:
            raise InvalidInputError("mass of propellant", self.mass, f"one of {', '.join(states)}")
        if self.dry_mass is not None and table[self.dry_mass].is_vector:
            raise InvalidInputError("dry_mass of propellant", self.dry_mass, "a number")

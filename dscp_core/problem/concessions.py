"""What a problem gives up, and in which order, where no feasible trajectory exists."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dscp_core.problem import checks
from dscp_core.problem.elements import ConeConstraint, Constraint, Parameters, Variable

Price = Callable[[Mapping[str, Any]], float]


@dataclass(frozen=True)
class Shortfall:
    """An error at the end that a best effort makes least instead of zero.

    Attributes:
        name: Name in reports and parameters, such as ``final_speed_error``.
        error: ``(x(t_f), p)`` to its components, (k, 1), affine in the state; their norm counts.
        unit: Of the error.
        scale: SI value of one scaled unit.
        frees: Pinned final states that it stands for.
        price: Of the parameters' values: cost, in the problem's unit, of one unit of the error
            while it is made least. The larger, the less is it traded for the problem's own cost.
        tolerance: What later steps may add to it, in ``unit``, besides a thousandth of it.

    Example:
        >>> from dscp_core import Shortfall
        >>> error = lambda x, p: x[0] - p["target"]
        >>> Shortfall("miss", error, "m", 10.0, ("place",), lambda p: 1e4, 0.01).frees
        ('place',)
    """

    name: str
    error: Callable[[ca.SX, Parameters], ca.SX]
    unit: str
    scale: float
    frees: tuple[str, ...]
    price: Price
    tolerance: float

    def __post_init__(self) -> None:
        checks.named("name of a shortfall", self.name)
        checks.plain(f"shortfall {self.name}", self)
        checks.function(f"error of shortfall {self.name}", self.error)
        checks.function(f"price of shortfall {self.name}", self.price)
        checks.positive(f"scale of shortfall {self.name}", self.scale)
        checks.positive(f"tolerance of shortfall {self.name}", self.tolerance)
        frees = checks.members(f"frees of shortfall {self.name}", self.frees, str)
        object.__setattr__(self, "frees", frees)


@dataclass(frozen=True)
class Concessions:
    """What gives way, in lexicographic order, before the problem's own cost counts.

    Attributes:
        shortfalls: Errors at the end, the gravest first.
        anchors: Constants along the flight that are decided besides, such as the point that is
            reached instead of the target: states appended to the problem's, zero in the guess.
        constraints: Imposed in place of the problem's of the same name, or besides; they see the
            states with the anchors.
        softened: Constraints, by name, that give way only where they cannot be met: the price of
            one unit of violation for one second.
        widen: ``(state, values)`` to the parameters, by name, that have to change for a start from
            a state (nx,): a bound that it violates already. None where there are none.

    Example:
        >>> from dscp_core import Concessions, problems
        >>> concessions = problems.get("powered_descent").concessions
        >>> [shortfall.name for shortfall in concessions.shortfalls]
        ['final_speed_error', 'final_position_error']
        >>> Concessions(()).softened
        {}
    """

    shortfalls: tuple[Shortfall, ...]
    anchors: tuple[Variable, ...] = ()
    constraints: tuple[Constraint, ...] = ()
    softened: Mapping[str, Price] = field(default_factory=dict)
    widen: Callable[[NDArray[np.float64], Mapping[str, Any]], Mapping[str, float]] | None = None

    def __post_init__(self) -> None:
        for name, kind in (
            ("shortfalls", Shortfall),
            ("anchors", Variable),
            ("constraints", Constraint),
        ):
            members = checks.members(f"{name} of concessions", getattr(self, name), kind)
            object.__setattr__(self, name, members)
        checks.distinct("shortfalls", (s.name for s in self.shortfalls))
        checks.mapping("softened of concessions", self.softened)
        for name, price in self.softened.items():
            checks.function(f"softened {name}", price)
        if self.widen is not None:
            checks.function("widen of concessions", self.widen)

    @property
    def freed(self) -> frozenset[str]:
        """Final states that are pinned no longer."""
        return frozenset(name for shortfall in self.shortfalls for name in shortfall.frees)

    def replace_in(self, declared: tuple[Constraint, ...]) -> tuple[Constraint, ...]:
        """The constraints that hold: the declared ones but for those replaced.

        Raises:
            InvalidInputError: A softened constraint that there is not.
        """
        own = {constraint.name for constraint in self.constraints}
        kept = tuple(c for c in declared if c.name not in own) + self.constraints
        names = [c.name for c in kept]
        checks.among("softened of concessions", self.softened, names, "names of constraints")
        return tuple(sorted(kept, key=lambda c: isinstance(c, ConeConstraint)))

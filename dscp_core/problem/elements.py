"""What a declaration is made of: variables, constraints, costs, misses, a guess."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum

import casadi as ca

from dscp_core.errors import InvalidInputError
from dscp_core.problem import checks
from dscp_core.problem.ending import Tolerance, accepted_tolerance, require_tolerance
from dscp_core.problem.flight import ControlHold
from dscp_core.problem.parameters import ParameterTable
from dscp_core.problem.tracing import KnownParameters


@dataclass(frozen=True)
class Variable:
    """A state or control component.

    Attributes:
        name: Unique name.
        unit: SI unit.
        scale: SI value of one scaled unit; the subproblems are solved in scaled units.
        description: What it is.

    Example:
        >>> from dscp_core import Variable
        >>> Variable("height", "m", scale=100.0, description="Above the pad.").unit
        'm'
    """

    name: str
    unit: str
    scale: float
    description: str

    def __post_init__(self) -> None:
        checks.named("name of a variable", self.name)
        checks.plain(self.name, self)
        checks.positive(f"scale of {self.name}", self.scale)


class Where(Enum):
    """Where along the trajectory an expression is imposed.

    Example:
        >>> from dscp_core import Where
        >>> [where.value for where in Where]
        ['node', 'interval mean']
    """

    NODE = "node"
    MEAN = "interval mean"


class Quadrature(Enum):
    """Weights of the nodes in the running cost, times the interval length T.

    TRAPEZOID: 1, and 1/2 at both ends; the error of the cost falls with the square of T. SUM: 1
    everywhere, as the paper sums; the error falls with T.

    Example:
        >>> from dscp_core import Quadrature, problems
        >>> problems.get("entry").quadrature is Quadrature.SUM
        True
    """

    TRAPEZOID = "trapezoid"
    SUM = "sum"


@dataclass(frozen=True)
class StagePoint:
    """Symbols at one node or interval mean; all are CasADi SX in SI units.

    Attributes:
        x: State, (nx, 1).
        u: Control, (nu, 1).
        step: Interval length T in seconds.
        over_interval: Change of the control over the interval, (nu, 1); None at a node.

    Example:
        >>> import casadi as ca
        >>> from dscp_core import StagePoint
        >>> at = StagePoint(x=ca.SX.sym("x", 2), u=ca.SX.sym("u"), step=ca.SX.sym("T"))
        >>> at.x[1] + at.step * at.u
        SX((x_1+(T*u)))
    """

    x: ca.SX
    u: ca.SX
    step: ca.SX
    over_interval: ca.SX | None = None

    @property
    def u_change(self) -> ca.SX:
        """Change of the control over the interval, (nu, 1): T times its rate if held linearly.

        Plans whose controls are held at their means jump instead: there, a constraint with it is
        left out of the subproblems, and refused by the planner unless its bound is infinite.

        Raises:
            InvalidInputError: At a node.
        """
        if self.over_interval is None:
            raise InvalidInputError("u_change", "a node", "an interval: where=Where.MEAN")
        return self.over_interval


Parameters = Mapping[str, ca.SX]

ACCEPTED_VIOLATION, ACCEPTED_MISS = 1e-3, 1e-2
"""What a certificate accepts where a declaration does not say, in units of the scale."""


@dataclass(frozen=True)
class Constraint:
    """What path and cone constraints have in common.

    Attributes:
        name: Name in reports.
        expression: Of a point and the parameters, SI; what it returns is the subclass's matter.
        scale: SI magnitude by which the rows are divided.
        unit: Unit of the expression.
        where: Node or interval mean.
        skip_first: Leave out the first node or interval (its state is pinned).
        skip_last: Number of last nodes or intervals to leave out.
        only_last: Number of last ones to leave all others out for; 0 for none. A certificate then
            checks it where the flight ends.
        tolerance: Violation of the flown trajectory that a certificate accepts, in ``unit``; a
            function of the parameters' values where it grows with the vehicle; None for a
            thousandth of the scale.
    """

    name: str
    expression: Callable[[StagePoint, Parameters], ca.SX]
    scale: float
    unit: str
    where: Where = Where.NODE
    skip_first: bool = False
    skip_last: int = 0
    tolerance: Tolerance | None = None
    only_last: int = 0

    def __post_init__(self) -> None:
        checks.named("name of a constraint", self.name)
        checks.plain(f"constraint {self.name}", self, Where=Where)
        checks.positive(f"scale of constraint {self.name}", self.scale)
        checks.function(f"constraint {self.name}", self.expression)
        if self.tolerance is not None:
            require_tolerance(f"tolerance of constraint {self.name}", self.tolerance)
        for label in ("skip_last", "only_last"):
            value = getattr(self, label)
            if not (isinstance(value, int) and value >= 0):
                what = f"{label} of constraint {self.name}"
                raise InvalidInputError(what, value, "a whole number >= 0")
        if self.only_last and (self.skip_first or self.skip_last):
            what, bound = f"only_last of constraint {self.name}", "0 with skip_first or skip_last"
            raise InvalidInputError(what, self.only_last, bound)

    def places(self, count: int) -> range:
        """Indices of the nodes or intervals, of which there are this many, where it is imposed."""
        first = max(0, count - self.only_last) if self.only_last else int(self.skip_first)
        return range(first, count - self.skip_last)

    def accepted(self, table: ParameterTable, values: KnownParameters) -> float:
        """The tolerance for the parameters' values; infinite only where the function says so.

        Raises:
            InvalidInputError: The function raises, or returns no number from zero.
        """
        if self.tolerance is None:
            return ACCEPTED_VIOLATION * self.scale
        what = f"tolerance of constraint {self.name}"
        return accepted_tolerance(what, self.tolerance, table, values, infinite=True)


class PathConstraint(Constraint):
    """``g(x, u, p) <= 0`` with the scalar g as the expression, linearised (eq. 7).

    It is not imposed where g is minus infinity: at an infinite bound.

    Example:
        >>> from dscp_core import PathConstraint
        >>> limit = PathConstraint("force_max", lambda at, p: at.u[0] - p["force_max"], 10.0, "N")
        >>> limit.where.value
        'node'
    """


class ConeConstraint(Constraint):
    """``|g1(x, u, p)|_2 <= g0(x, u, p)``, affine in (x, u); the expression is [g0; g1].

    It is not imposed where g0 is infinite.

    Example:
        >>> import casadi as ca
        >>> from dscp_core import ConeConstraint
        >>> thrust = lambda at, p: ca.vertcat(p["thrust_max"], at.u)  # |u| <= thrust_max
        >>> ConeConstraint("thrust_max", thrust, scale=1e5, unit="N").name
        'thrust_max'
    """


@dataclass(frozen=True)
class Miss:
    """A distance from the target at the end of the flown trajectory.

    Attributes:
        name: Name in reports.
        expression: ``(x(t_f), p)`` to a nonnegative scalar, SI.
        unit: Its unit.
        tolerance: Largest value that a certificate accepts, or a function of the parameters' values
            that returns it.

    Example:
        >>> import casadi as ca
        >>> from dscp_core import Miss
        >>> miss = Miss("miss_position", lambda x, p: ca.norm_2(x[:3] - p["target"]), "m", 1.0)
        >>> miss.tolerance
        1.0
    """

    name: str
    expression: Callable[[ca.SX, Parameters], ca.SX]
    unit: str
    tolerance: Tolerance

    def __post_init__(self) -> None:
        checks.named("name of a miss", self.name)
        checks.plain(f"miss {self.name}", self)
        checks.function(f"miss {self.name}", self.expression)
        require_tolerance(f"tolerance of miss {self.name}", self.tolerance)

    def accepted(self, table: ParameterTable, values: KnownParameters) -> float:
        """The tolerance for the parameters' values.

        Raises:
            InvalidInputError: The function raises, or returns no finite number from zero.
        """
        return accepted_tolerance(f"tolerance of miss {self.name}", self.tolerance, table, values)


def pinned_miss(index: int, state: Variable, final: Callable[[Parameters], ca.SX]) -> Miss:
    """How far a pinned state is off."""
    return Miss(
        f"miss_{state.name}",
        lambda x, p: ca.fabs(x[index] - final(p)),
        state.unit,
        ACCEPTED_MISS * state.scale,
    )


@dataclass(frozen=True)
class CostTerm:
    """A cost of the subproblem, summed over nodes or interval means.

    Terms whose gradient at the reference is not zero have to be a model of the running cost: their
    gradients there sum up to that of T times the running cost. At nodes they get the weights of
    the problem's quadrature. At interval means they sum the running cost by the midpoint rule,
    which does not see controls that alternate from node to node; 1e-4 of their curvature on the
    controls' change from node to node is added to what a subproblem minimises, so that it does.

    Attributes:
        name: Name in reports.
        expression: Returns a scalar, at most quadratic and convex in the decision; arguments are
            the decision's point, the reference's point and the parameters. Units of the cost.
        where: Node or interval mean.
        hold: How the dynamics see the controls between the nodes where this term counts, the
            midpoint rule being MEAN; None for always.

    Example:
        >>> import casadi as ca
        >>> from dscp_core import CostTerm, Where
        >>> CostTerm("effort", lambda at, ref, p: ref.step * ca.sumsqr(at.u), Where.NODE).name
        'effort'
    """

    name: str
    expression: Callable[[StagePoint, StagePoint, Parameters], ca.SX]
    where: Where = Where.MEAN
    hold: ControlHold | None = None

    def __post_init__(self) -> None:
        checks.named("name of a cost term", self.name)
        checks.plain(f"cost term {self.name}", self, Where=Where, ControlHold=ControlHold)
        checks.function(f"cost term {self.name}", self.expression)


@dataclass(frozen=True)
class InitialGuess:
    """Reference trajectory of the first iteration, as CasADi expressions of the parameters.

    Attributes:
        states: (nx, N+1), SI.
        controls: (nu, N+1), SI.

    Example:
        >>> import casadi as ca
        >>> from dscp_core import InitialGuess
        >>> line = ca.MX(ca.DM([[0.0, 0.5, 1.0]]))
        >>> InitialGuess(states=line, controls=0.0 * line).states.shape
        (1, 3)
    """

    states: ca.MX
    controls: ca.MX

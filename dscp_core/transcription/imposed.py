"""Which constraints of a declaration count: under a hold, and with values of the parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dscp_core.problem.declaration import (
    Constraint,
    OptimalControlProblem,
    PathConstraint,
    StagePoint,
    Where,
    named,
)
from dscp_core.problem.flight import ControlHold
from dscp_core.problem.tracing import Tracer

Array = NDArray[np.float64]


def held(problem: OptimalControlProblem, hold: ControlHold) -> OptimalControlProblem:
    """The problem without limits of the controls' change where that is none over an interval."""
    if hold is ControlHold.LINEAR:
        return problem
    return _where(problem, lambda constraint: not limits_change(problem, constraint))


def imposed(problem: OptimalControlProblem, packed: Array) -> OptimalControlProblem:
    """The problem without constraints that packed parameters, SI, make no bound of."""
    states = np.array([s.scale for s in problem.states])
    controls = np.array([c.scale for c in problem.controls])

    def counts(constraint: Constraint) -> bool:
        value, symbols = _traced(problem, constraint)
        head = -value if isinstance(constraint, PathConstraint) else value[0]
        function = ca.Function("head", symbols, [head])
        return float(function(states, controls, 1.0, controls, packed)) != np.inf

    return _where(problem, counts)


def limits_change(problem: OptimalControlProblem, constraint: Constraint) -> bool:
    """Whether a constraint depends on the change of the controls over an interval."""
    if constraint.where is Where.NODE:
        return False
    value, symbols = _traced(problem, constraint)
    return bool(ca.depends_on(value, symbols[3]))


def _where(
    problem: OptimalControlProblem, counts: Callable[[Constraint], bool]
) -> OptimalControlProblem:
    return replace(
        problem,
        path_constraints=tuple(c for c in problem.path_constraints if counts(c)),
        cone_constraints=tuple(c for c in problem.cone_constraints if counts(c)),
    )


def _traced(
    problem: OptimalControlProblem, constraint: Constraint
) -> tuple[ca.SX, tuple[ca.SX, ...]]:
    """A constraint's expression, and its symbols: x, u, T, the change of u, the parameters."""
    x, u = ca.SX.sym("x", len(problem.states)), ca.SX.sym("u", len(problem.controls))
    step, change = ca.SX.sym("T"), ca.SX.sym("change", u.numel())
    packed = ca.SX.sym("p", problem.table.size)
    symbols = (x, u, step, change, packed)
    value = Tracer(problem.table, *symbols)(
        f"constraint {constraint.name}",
        constraint.expression,
        StagePoint(x, u, step, None if constraint.where is Where.NODE else change),
        named(problem, packed),
        rows=1 if isinstance(constraint, PathConstraint) else None,
    )
    return value, symbols

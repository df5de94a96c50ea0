"""What a certificate checks of a problem: along the flight, at its end, at its end event."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dscp_core.errors import InvalidInputError
from dscp_core.planning.propagation import Watched
from dscp_core.problem.declaration import (
    Constraint,
    OptimalControlProblem,
    PathConstraint,
    StagePoint,
    Where,
    named,
)
from dscp_core.problem.ending import Tolerance, accepted_tolerance
from dscp_core.problem.flight import ControlHold
from dscp_core.problem.tracing import KnownParameters, Tracer
from dscp_core.transcription.compiled import CompiledFunction
from dscp_core.transcription.imposed import limits_change
from dscp_core.transcription.stages import constraints

Array = NDArray[np.float64]
Accepted = Callable[[KnownParameters], float]
"""What is accepted for values of the parameters."""


@dataclass(frozen=True)
class Limit:
    """A number with a bound.

    Attributes:
        name: Constraint, miss or limit of the end event.
        what: Its bound, as messages call it.
        unit: Of the number and its bound.
        accepted: Its bound.
        distance: Whether a negative number is wrong too.
        scale: Its size, for rounding.
    """

    name: str
    what: str
    unit: str
    accepted: Accepted
    distance: bool = False
    scale: float = 1.0


class Limits:
    """All limits of one problem.

    Attributes:
        along: Of every watched quantity; that of the end event, if there is one, comes first.
        watched: What is watched.
        of_state: (watched,) whether it depends on the state alone.
        misses: Checked at the end of a flight.
        at_event: Checked too where the flight is meant to end in its event.
        at_end: Constraints that are imposed at the end only.
    """

    def __init__(self, problem: OptimalControlProblem) -> None:
        """Gather them.

        Args:
            problem: The declaration.
        """
        self._problem = problem
        self._table = problem.table
        event = problem.end_event
        # Along the flight there is no difference between nodes and interval means.
        every = [c for where in Where for c in constraints(problem, where)]
        along = [c for c in every if not c.only_last]
        last = [c for c in every if c.only_last]
        self.watched = [_watched(c) for c in along]
        self.along = [_limit(problem, c) for c in along]
        self.at_end = [_limit(problem, c) for c in last]
        self.misses = [self._of(m.name, m.unit, m.tolerance, "miss") for m in problem.end_checks]
        self.at_event = []
        if event is not None:
            floor = self._of(event.floor, event.unit, event.tolerance, "end event")
            self.along.insert(0, replace(floor, distance=False))
            below = event.expression
            self.watched.insert(
                0, Watched(lambda at, p: -below(at.x, p), f"end event {event.name}")
            )
            self.at_event = [
                self._of(one.name, one.unit, one.tolerance, "end event's limit")
                for one in event.limits
            ]
        self._compile(along, last)

    def _of(self, name: str, unit: str, tolerance: Tolerance, kind: str) -> Limit:
        what = f"tolerance of {kind} {name}"
        return Limit(
            name,
            what,
            unit,
            lambda values: accepted_tolerance(what, tolerance, self._table, values),
            distance=True,
        )

    def _compile(self, along: list[Constraint], last: list[Constraint]) -> None:
        problem = self._problem
        nx, nu = len(problem.states), len(problem.controls)
        x, u, change = ca.SX.sym("x", nx), ca.SX.sym("u", nu), ca.SX.sym("change", nu)
        step, packed = ca.SX.sym("T"), ca.SX.sym("p", problem.table.size)
        parameters = named(problem, packed)
        trace = Tracer(problem.table, x, u, step, change, packed)
        point = StagePoint(x, u, step, change)

        def value(one: Watched) -> ca.SX:
            given = trace(one.what, one.expression, point, parameters, rows=None if one.cone else 1)
            return ca.norm_2(given[1:]) - given[0] if one.cone else given

        values = [value(one) for one in self.watched]
        controls = ca.vertcat(u, change)
        self.of_state = np.array([not ca.depends_on(v, controls) for v in values], dtype=bool)
        first = len(values) - len(along)
        changing = [
            (c, v) for c, v in zip(along, values[first:], strict=True) if limits_change(problem, c)
        ]
        self._changing = [c.name for c, _ in changing]
        inputs = [x, u, change, ca.vertcat(step, packed)]
        self._changes = CompiledFunction("changes", inputs, [_stack(v for _, v in changing)])
        self._typical = (
            np.array([s.scale for s in problem.states]),
            np.array([c.scale for c in problem.controls]),
        )
        ends = [trace(f"miss {m.name}", m.expression, x, parameters) for m in problem.end_checks]
        if problem.end_event is not None:
            ends += [
                trace(f"end event's limit {one.name}", one.expression, x, u, parameters)
                for one in problem.end_event.limits
            ]
        ends += [value(_watched(c)) for c in last]
        self._ends = CompiledFunction("ends", inputs, [_stack(ends)])
        alone = [v for v, of_state in zip(values, self.of_state, strict=True) if of_state]
        self._of_states = CompiledFunction("of_states", inputs, [_stack(alone)])

    def of_states(self, state: Array, packed: Array) -> list[tuple[Limit, float]]:
        """Limits along the flight that depend on the state alone, with their values at one."""
        limits = [one for one, alone in zip(self.along, self.of_state, strict=True) if alone]
        nothing = np.zeros(len(self._problem.controls))
        values = self._of_states(state, nothing, nothing, np.append(1.0, packed))[0]
        return list(zip(limits, values, strict=True))

    def ends(
        self, state: Array, control: Array, change: Array, interval_s: float, packed: Array
    ) -> list[tuple[Limit, float]]:
        """Misses, limits of the end event and constraints of the end, with their values."""
        values = self._ends(state, control, change, np.append(interval_s, packed))[0]
        return list(zip([*self.misses, *self.at_event, *self.at_end], values, strict=True))

    def bounds(self, values: KnownParameters) -> dict[str, float]:
        """What is accepted of every limit, by its name.

        Raises:
            InvalidInputError: A tolerance is no number from zero.
        """
        every = (*self.along, *self.misses, *self.at_event, *self.at_end)
        return {limit.name: limit.accepted(values) for limit in every}

    def require_hold(self, packed: Array, hold: ControlHold) -> None:
        """Refuse to hold controls at their means where packed parameters, SI, limit their rate.

        Raises:
            InvalidInputError: A constraint limits the controls' change over an interval, while they
                jump at the nodes.
        """
        if hold is ControlHold.LINEAR or not self._changing:
            return
        states, controls = self._typical
        found = self._changes(states, controls, controls, np.append(1.0, packed))[0]
        for name, value in zip(self._changing, found, strict=True):
            if not np.isneginf(value):
                bound = f"{ControlHold.LINEAR.value} where {name} limits the controls' change: "
                raise InvalidInputError("hold", hold.value, bound + "they jump at the nodes")


def _watched(constraint: Constraint) -> Watched:
    linear = isinstance(constraint, PathConstraint)
    return Watched(constraint.expression, f"constraint {constraint.name}", cone=not linear)


def _limit(problem: OptimalControlProblem, constraint: Constraint) -> Limit:
    return Limit(
        constraint.name,
        f"tolerance of constraint {constraint.name}",
        constraint.unit,
        lambda values: constraint.accepted(problem.table, values),
        scale=constraint.scale,
    )


def _stack(scalars: Iterable[ca.SX]) -> ca.SX:
    return ca.vertcat(*scalars, ca.SX(0, 1))

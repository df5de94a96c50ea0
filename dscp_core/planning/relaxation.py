"""The relaxed problem of a best effort: errors at the end and softened constraints have a price.

One problem, compiled once, serves every step of the lexicographic order: what is made least has a
price, what was made least before has a bound, and both are parameters.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dscp_core.problem.concessions import Concessions, Shortfall
from dscp_core.problem.declaration import (
    TERMINAL_TIME,
    TRUST_REGION_CONTROL,
    TRUST_REGION_STATE,
    ConeConstraint,
    Constraint,
    CostTerm,
    InitialGuess,
    OptimalControlProblem,
    Parameters,
    PathConstraint,
    StagePoint,
    Variable,
)
from dscp_core.problem.extras import Extras
from dscp_core.problem.parameters import Parameter

Array = NDArray[np.float64]

CURVATURE = "best_effort_curvature"
"""Parameter that multiplies the declared curvature terms: the price of what they stand for."""
# A flight that is shorter than the least terminal time has no other way to end.
_LEAST_TIME = 1e-3


def price_name(what: str) -> str:
    """Parameter with the price of an error, or of a constraint's violation."""
    return f"best_effort_price_{what}"


def bound_name(what: str) -> str:
    """Parameter with the bound of an error."""
    return f"best_effort_bound_{what}"


def slack_name(constraint: str) -> str:
    """Control by which a softened constraint may be violated."""
    return f"best_effort_slack_{constraint}"


@dataclass(frozen=True)
class Relaxation:
    """A problem with its concessions, as another problem.

    Its states are the problem's, then the anchors, then one constant per shortfall that bounds
    the error; its controls the problem's, then one slack per softened constraint.

    Attributes:
        problem: The original.
        concessions: What gives way.
        relaxed: The other problem.
    """

    problem: OptimalControlProblem
    concessions: Concessions
    relaxed: OptimalControlProblem

    @staticmethod
    def of(problem: OptimalControlProblem, models: Collection[str]) -> Relaxation | None:
        """The relaxation of a problem, or None where it declares no concessions.

        Args:
            problem: The declaration.
            models: Cost terms that model its running cost, which are no curvature.
        """
        if problem.concessions is None:
            return None
        relaxed = _relaxed(problem, problem.concessions, models)
        return Relaxation(problem, problem.concessions, relaxed)

    def pack(self, packed: Array, changes: Mapping[str, Any]) -> Array:
        """Packed parameters of the relaxed problem.

        Args:
            packed: Of the original, SI.
            changes: Parameters of the relaxed problem by name.
        """
        values = self.problem.table.unpack(packed)
        for name, size in (
            (TRUST_REGION_STATE, len(self.relaxed.states)),
            (TRUST_REGION_CONTROL, len(self.relaxed.controls)),
        ):
            weights = np.zeros(size)
            weights[: np.size(values[name])] = values[name]
            values[name] = weights
        # As planned with: a terminal time out of its bounds is a guess as good as another.
        seconds = values.pop(TERMINAL_TIME)
        known = {n: v for n, v in values.items() if n in self.relaxed.table.names}
        result = self.relaxed.table.pack({**known, **changes})
        result[self.relaxed.table.slice(TERMINAL_TIME)] = seconds
        return result

    def extended(self, states: Array, controls: Array) -> tuple[Array, Array]:
        """States and controls of the relaxed problem from those of the original, SI."""
        more = len(self.relaxed.states) - states.shape[1]
        slack = len(self.relaxed.controls) - controls.shape[1]
        rows = len(states)
        return (
            np.hstack([states, np.zeros((rows, more))]),
            np.hstack([controls, np.zeros((rows, slack))]),
        )


def _relaxed(
    problem: OptimalControlProblem, concessions: Concessions, models: Collection[str]
) -> OptimalControlProblem:
    nx, nu = len(problem.states), len(problem.controls)
    anchored = nx + len(concessions.anchors)
    bounds = tuple(
        Variable(f"best_effort_{s.name}", s.unit, s.scale, "Bound of the error.")
        for s in concessions.shortfalls
    )
    constraints = concessions.replace_in((*problem.path_constraints, *problem.cone_constraints))
    slacks = tuple(
        Variable(slack_name(c.name), c.unit, c.scale, "What it is violated by.")
        for c in constraints
        if c.name in concessions.softened
    )
    order = {slack.name: nu + i for i, slack in enumerate(slacks)}
    paths: list[PathConstraint] = []
    cones: list[ConeConstraint] = []
    for c in constraints:
        slack = order.get(slack_name(c.name))
        known = anchored if c in concessions.constraints else nx
        changed = replace(c, expression=_softened(c, known, nu, slack))
        (cones if isinstance(c, ConeConstraint) else paths).append(changed)  # type: ignore[arg-type]
    for index, slack_variable in enumerate(slacks):
        paths.append(_not_negative(slack_variable, nu + index))
    for index, shortfall in enumerate(concessions.shortfalls):
        cone, path = _bounded(shortfall, anchored + index, nx)
        cones.append(cone)
        paths.append(path)
    added = (*concessions.anchors, *bounds)
    names = [s.name for s in concessions.shortfalls]
    return replace(
        problem,
        states=(*problem.states, *added),
        controls=(*problem.controls, *slacks),
        parameters=(*problem.parameters, *_parameters(concessions)),
        dynamics=_then_zeros(lambda x, u, p: problem.dynamics(x[:nx], u[:nu], p), len(added)),
        initial_state=_then_zeros(problem.initial_state, len(added)),
        free_initial_states=tuple(v.name for v in added),
        initial_state_parameters=(),
        initial_guess=_extended_guess(problem, len(added), len(slacks)),
        final_state={
            name: value
            for name, value in problem.final_state.items()
            if name not in concessions.freed
        },
        terminal_cost=_priced_end(problem, names, anchored),
        running_cost=_priced_flight(problem, list(concessions.softened), order),
        terminal_time_bounds=_wider(problem),
        cost_terms=tuple(_curved(t, t.name not in models, nx, nu) for t in problem.cost_terms),
        path_constraints=tuple(paths),
        cone_constraints=tuple(cones),
        virtual_control_scale=(),
        trust_region_state=_padded(problem.trust_region_state, len(added)),
        trust_region_control=_padded(problem.trust_region_control, len(slacks)),
        vehicle_tables={},
        check_parameters=None,
        check_state=None,
        terminal_time_guess=None,
        least_time_parameters={},
        misses=(),
        end_event=None,
        propellant=None,
        file_defaults={},
        control_states=(),
        concessions=None,
        extras=Extras(),
    )


def _parameters(concessions: Concessions) -> tuple[Parameter, ...]:
    priced = [*(s.name for s in concessions.shortfalls), *concessions.softened]
    return (
        Parameter(CURVATURE, 1.0, "1", "Factor of the curvature terms.", lower=0.0),
        *(Parameter(price_name(n), 0.0, "1", "Cost of one unit.", lower=0.0) for n in priced),
        *(
            Parameter(
                bound_name(s.name), math.inf, s.unit, "Largest error.", lower=0.0, infinite=True
            )
            for s in concessions.shortfalls
        ),
    )


def _padded(weights: tuple[float, ...], count: int) -> tuple[float, ...]:
    return (*weights, *(0.0,) * count) if weights else ()


def _then_zeros(function: Callable[..., ca.SX], count: int) -> Callable[..., ca.SX]:
    return lambda *arguments: ca.vertcat(function(*arguments), ca.SX.zeros(count))


def _extended_guess(
    problem: OptimalControlProblem, states: int, controls: int
) -> Callable[[Mapping[str, ca.MX], int], InitialGuess]:
    def guess(p: Mapping[str, ca.MX], intervals: int) -> InitialGuess:
        own = problem.initial_guess(p, intervals)
        nothing = ca.MX.zeros(states, intervals + 1), ca.MX.zeros(controls, intervals + 1)
        return InitialGuess(
            ca.vertcat(own.states, nothing[0]), ca.vertcat(own.controls, nothing[1])
        )

    return guess


def _priced_end(
    problem: OptimalControlProblem, names: list[str], first: int
) -> Callable[[ca.SX, ca.SX, Parameters], ca.SX]:
    nx = len(problem.states)

    def cost(x: ca.SX, time: ca.SX, p: Parameters) -> ca.SX:
        total = ca.SX(0)
        if problem.terminal_cost is not None:
            total += problem.terminal_cost(x[:nx], time, p)
        for index, name in enumerate(names):
            total += p[price_name(name)] * x[first + index]
        return total

    return cost


def _priced_flight(
    problem: OptimalControlProblem, softened: list[str], order: Mapping[str, int]
) -> Callable[[ca.SX, ca.SX, Parameters], ca.SX] | None:
    nx, nu = len(problem.states), len(problem.controls)
    own = problem.running_cost
    if not softened and own is None:
        return None

    def cost(x: ca.SX, u: ca.SX, p: Parameters) -> ca.SX:
        total = ca.SX(0) if own is None else own(x[:nx], u[:nu], p)
        for name in softened:
            total += p[price_name(name)] * u[order[slack_name(name)]]
        return total

    return cost


def _wider(
    problem: OptimalControlProblem,
) -> Callable[[Parameters], tuple[ca.SX, ca.SX]] | None:
    declared = problem.terminal_time_bounds
    if declared is None:
        return None

    def bounds(p: Parameters) -> tuple[ca.SX, ca.SX]:
        low, high = declared(p)
        return _LEAST_TIME * low, high

    return bounds


def _curved(term: CostTerm, is_curvature: bool, nx: int, nu: int) -> CostTerm:
    def cost(at: StagePoint, reference: StagePoint, p: Parameters) -> ca.SX:
        own = term.expression(_first(at, nx, nu), _first(reference, nx, nu), p)
        return p[CURVATURE] * own if is_curvature else own

    return replace(term, expression=cost)


def _first(at: StagePoint, nx: int, nu: int) -> StagePoint:
    change = None if at.over_interval is None else at.over_interval[:nu]
    return StagePoint(at.x[:nx], at.u[:nu], at.step, change)


def _softened(
    constraint: Constraint, nx: int, nu: int, slack: int | None
) -> Callable[[StagePoint, Parameters], ca.SX]:
    cone = isinstance(constraint, ConeConstraint)

    def expression(at: StagePoint, p: Parameters) -> ca.SX:
        value = constraint.expression(_first(at, nx, nu), p)
        if slack is None:
            return value
        if cone:
            return ca.vertcat(value[0] + at.u[slack], value[1:])
        return value - at.u[slack]

    return expression


def _not_negative(slack: Variable, index: int) -> PathConstraint:
    return PathConstraint(slack.name, lambda at, p: -at.u[index], slack.scale, slack.unit)


def _bounded(shortfall: Shortfall, index: int, nx: int) -> tuple[ConeConstraint, PathConstraint]:
    """The error within its bound, and the bound within what it was made least to."""
    return (
        ConeConstraint(
            f"best_effort_error_{shortfall.name}",
            lambda at, p: ca.vertcat(at.x[index], shortfall.error(at.x[:nx], p)),
            shortfall.scale,
            shortfall.unit,
            only_last=1,
        ),
        PathConstraint(
            bound_name(shortfall.name),
            lambda at, p: at.x[index] - p[bound_name(shortfall.name)],
            shortfall.scale,
            shortfall.unit,
            only_last=1,
        ),
    )

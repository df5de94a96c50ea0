"""Compiled functions of one interval, one node and the end of a trajectory.

Each returns the nonzeros of its rows and columns as one dense column; `scatter` says where they
go. They are mapped over the trajectory, so that their size does not grow with N.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dscp_core.errors import InvalidInputError
from dscp_core.problem.declaration import (
    TERMINAL_TIME,
    TRUST_REGION_CONTROL,
    TRUST_REGION_STATE,
    TRUST_REGION_STEP,
    VIRTUAL_CONTROL_WEIGHT,
    Constraint,
    InitialGuess,
    OptimalControlProblem,
    Parameters,
    PathConstraint,
    Where,
    named,
)
from dscp_core.problem.flight import ControlHold, Discretisation
from dscp_core.problem.tracing import Tracer, called
from dscp_core.transcription.analysis import CostAnalysis, CostForm, analyse
from dscp_core.transcription.costs import (
    add_running_cost,
    add_terminal_cost,
    add_terms,
    node_weights,
    running_cost,
    terminal_cost,
)
from dscp_core.transcription.dynamics import defect
from dscp_core.transcription.imposed import held
from dscp_core.transcription.layout import TrajectoryLayout
from dscp_core.transcription.stage import Collector, Kind, Stage, Symbols

Array = NDArray[np.float64]

# Those of 220 states that all act on each other; they take 10 s.
_LEAST_TIME = 1e-3
"""Of the default: least free terminal time where the parameter has no positive lower bound."""
_MOST_NONZEROS = 100_000


@dataclass(frozen=True)
class StageFunctions:
    """All stages of a problem, and how to evaluate them along a trajectory.

    Attributes:
        problem: The declaration.
        layout: Where quantities stand in the decision vector.
        costs: What the costs are.
        weights: (N+1,) the quadrature's weight of every node.
        interval: Stage of an interval.
        node: Stage of a node.
        terminal: Stage of the end.
        boundary: Stage of what is pinned, and of the virtual control.
    """

    problem: OptimalControlProblem
    layout: TrajectoryLayout
    costs: CostAnalysis
    weights: Array
    interval: Stage
    node: Stage
    terminal: Stage
    boundary: Stage
    _defect: ca.Function
    _running_cost: ca.Function
    _terminal_cost: ca.Function

    def _locals(self, reference: ca.MX) -> tuple[ca.MX, ca.MX]:
        """Local vectors of all nodes and of all intervals, as columns."""
        layout = self.layout
        nodes = ca.reshape(reference[layout.offset :], layout.nx + layout.nu, -1)
        intervals = ca.vertcat(nodes[:, :-1], nodes[:, 1:])
        if layout.free_terminal_time:
            nodes = ca.vertcat(ca.repmat(reference[0], 1, nodes.shape[1]), nodes)
            intervals = ca.vertcat(ca.repmat(reference[0], 1, intervals.shape[1]), intervals)
        return nodes, intervals

    @staticmethod
    def _map(function: ca.Function, columns: ca.MX, parameters: ca.MX) -> ca.MX:
        mapped = function.map(function.name(), "serial", columns.shape[1], [1], [])
        return mapped(columns, parameters)

    def sources(self, reference: ca.MX, parameters: ca.MX) -> ca.MX:
        """Outputs of every stage, one after the other, then the constant 1."""
        nodes, intervals = self._locals(reference)
        return ca.vertcat(
            ca.vec(self._map(self.interval.function, intervals, parameters)),
            ca.vec(self._map(self.node.function, nodes, parameters)),
            self.terminal.function(nodes[:, -1], parameters),
            self.boundary.function(nodes[:, -1], parameters),
            ca.MX(1.0),
        )

    def evaluation(self, reference: ca.MX, parameters: ca.MX) -> tuple[ca.MX, ca.MX]:
        """True cost, and defects (nx, N) in SI."""
        nodes, intervals = self._locals(reference)
        cost = self._terminal_cost(nodes[:, -1], parameters)
        if self.costs.running is not CostForm.NONE:
            at_nodes = self.costs.where is Where.NODE
            places = nodes if at_nodes else intervals
            weights = ca.DM(self.weights if at_nodes else np.ones(self.layout.intervals))
            cost += ca.mtimes(self._map(self._running_cost, places, parameters), weights)
        return cost, self._map(self._defect, intervals, parameters)

    def initial_guess(self, parameters: ca.MX) -> ca.MX:
        """Reference vector of the first iteration."""
        layout = self.layout
        guess = initial_guess(self.problem, layout.intervals, parameters)
        nodes = ca.vertcat(
            guess.states / ca.DM(layout.state_scale), guess.controls / ca.DM(layout.control_scale)
        )
        if layout.free_terminal_time:
            time = parameters[self.problem.table.slice(TERMINAL_TIME)]
            return ca.vertcat(time / layout.time_scale, ca.vec(nodes))
        return ca.vec(nodes)


def initial_guess(
    problem: OptimalControlProblem, intervals: int, parameters: ca.MX
) -> InitialGuess:
    """States (nx, N+1) and controls (nu, N+1) of the declared guess, dense, SI.

    Raises:
        InvalidInputError: The function raises, or returns something else.
    """
    what, values = "initial_guess", named(problem, parameters)
    guess = called(what, problem.table, problem.initial_guess, values, intervals)
    if not isinstance(guess, InitialGuess):
        raise InvalidInputError(what, f"a {type(guess).__name__}", "an InitialGuess")
    parts = []
    for name, size in (("states", len(problem.states)), ("controls", len(problem.controls))):
        given = getattr(guess, name)
        if not isinstance(given, ca.MX | ca.DM | np.ndarray):
            got = f"a {type(given).__name__}"
            raise InvalidInputError(f"{name} of {what}", got, "a casadi.MX of the parameters")
        part = called(f"{name} of {what}", problem.table, ca.MX, given)
        if part.shape != (size, intervals + 1):
            bound = f"shape ({size}, {intervals + 1})"
            raise InvalidInputError(f"{name} of {what}", f"shape {part.shape}", bound)
        parts.append(ca.densify(part))
    traced = ca.Function("guess", [parameters], parts, {"allow_free": True})
    foreign = ", ".join(sorted(str(symbol) for symbol in traced.free_mx()))
    if foreign:
        raise InvalidInputError(what, foreign, "symbols of its arguments only")
    return InitialGuess(*parts)


def build_stages(
    problem: OptimalControlProblem,
    layout: TrajectoryLayout,
    discretisation: Discretisation,
    hold: ControlHold,
) -> StageFunctions:
    """Derive every stage of a problem: linearisation (eqs. 6 to 8) and quadratic costs.

    Raises:
        InvalidInputError: A function of the declaration is wrong.
    """
    seen = ControlHold.MEAN if discretisation is Discretisation.MIDPOINT else hold
    terms = tuple(term for term in problem.cost_terms if term.hold in (None, seen))
    problem = replace(held(problem, hold), cost_terms=terms)
    pair, single = Symbols(problem, layout, 2), Symbols(problem, layout, 1)
    residual = defect(problem, pair, discretisation, hold)
    packed = ca.MX.sym("parameters", problem.table.size)
    guess = initial_guess(problem, layout.intervals, packed)
    guessed = ca.Function("guess", [packed], [guess.states.T, guess.controls.T])

    def numbers(parameters: Array) -> tuple[Array, Array]:
        states, controls = guessed(parameters)
        return states.full(), controls.full()

    costs = analyse(problem, layout.intervals, numbers, free=layout.free_terminal_time)
    summed = single if costs.where is Where.NODE else pair
    point = summed.at(costs.where, summed.reference)
    return StageFunctions(
        problem,
        layout,
        costs,
        node_weights(problem.quadrature, layout.intervals),
        _interval_stage(problem, layout, pair, residual, costs),
        _node_stage(problem, layout, single, costs),
        _terminal_stage(problem, layout, single, costs),
        _boundary_stage(problem, layout, single),
        ca.Function("defect", [pair.reference, pair.packed], [residual]),
        ca.Function(
            "running_cost",
            [summed.reference, summed.packed],
            [point.step * running_cost(problem, summed, point)],
        ),
        ca.Function(
            "terminal_cost",
            [single.reference, single.packed],
            [terminal_cost(problem, single, single.reference)],
        ),
    )


def _interval_stage(
    problem: OptimalControlProblem,
    layout: TrajectoryLayout,
    symbols: Symbols,
    residual: ca.SX,
    costs: CostAnalysis,
) -> Stage:
    collect = Collector()
    residual = residual / ca.DM(layout.state_scale)
    nonzeros = ca.jacobian_sparsity(residual, symbols.reference).nnz()
    if nonzeros > _MOST_NONZEROS:
        bound = f"at most {_MOST_NONZEROS} nonzeros: more take minutes to compile"
        raise InvalidInputError("Jacobian of dynamics", nonzeros, bound)
    jacobian = ca.jacobian(residual, symbols.reference)
    collect.matrix(Kind.EQUALITY_MATRIX, "dynamics", jacobian)
    offset = ca.mtimes(jacobian, symbols.reference) - residual
    collect.vector(Kind.EQUALITY_VECTOR, "dynamics", offset)
    _add_constraints(collect, problem, symbols, Where.MEAN)
    add_terms(collect, problem, symbols, costs, Where.MEAN)
    return collect.stage("interval", symbols.reference, symbols.packed)


def _node_stage(
    problem: OptimalControlProblem, layout: TrajectoryLayout, symbols: Symbols, costs: CostAnalysis
) -> Stage:
    collect = Collector()

    _add_constraints(collect, problem, symbols, Where.NODE)
    add_terms(collect, problem, symbols, costs, Where.NODE)
    change = symbols.decision[layout.offset :] - symbols.reference[layout.offset :]
    if costs.running in (CostForm.EXACT, CostForm.CONVEXIFIED):
        add_running_cost(collect, problem, symbols, costs.running)
    weights = ca.vertcat(
        symbols.parameters[TRUST_REGION_STATE], symbols.parameters[TRUST_REGION_CONTROL]
    )
    penalty = ca.dot(weights, change**2)
    if problem.trust_region_per_second:
        penalty *= symbols.node(symbols.reference).step
    collect.quadratic("trust_region", penalty, symbols)
    return collect.stage("node", symbols.reference, symbols.packed)


def _terminal_stage(
    problem: OptimalControlProblem, layout: TrajectoryLayout, symbols: Symbols, costs: CostAnalysis
) -> Stage:
    collect = Collector()
    decision, reference = symbols.decision, symbols.reference
    if costs.terminal is not CostForm.NONE:
        add_terminal_cost(collect, problem, symbols, costs.terminal)
    if layout.free_terminal_time:
        relative = decision[0] / reference[0] - 1
        weight = symbols.parameters[TRUST_REGION_STEP]
        collect.quadratic("trust_region_step", weight * relative**2, symbols)
        lower, upper = terminal_time_bounds(problem, symbols.trace, symbols.parameters)
        rows = ca.jacobian(ca.vertcat(-decision[0], decision[0]), decision)
        collect.matrix(Kind.CONE_MATRIX, TERMINAL_TIME, rows)
        bound = ca.vertcat(-lower, upper) / layout.time_scale
        collect.vector(Kind.CONE_VECTOR, TERMINAL_TIME, bound)
    return collect.stage("terminal", reference, symbols.packed)


def terminal_time_bounds(
    problem: OptimalControlProblem, trace: Tracer, parameters: Parameters
) -> tuple[ca.SX, ca.SX]:
    """Least and greatest free terminal time, s: as declared, or else the parameter's own bounds.

    Raises:
        InvalidInputError: What the declared function returns is no pair of scalars.
    """
    if problem.terminal_time_bounds is not None:
        return trace.pair("terminal_time_bounds", problem.terminal_time_bounds, parameters)
    own = problem.table[TERMINAL_TIME]
    least = own.lower if own.lower > 0.0 else _LEAST_TIME * float(np.ravel(own.default)[0])
    return ca.SX(least), ca.SX(own.upper)


def pinned_at_start(problem: OptimalControlProblem) -> list[int]:
    """Indices of the states whose value at the start is given, in order."""
    free = problem.free_initial_states
    return [index for index, state in enumerate(problem.states) if state.name not in free]


def _boundary_stage(
    problem: OptimalControlProblem, layout: TrajectoryLayout, symbols: Symbols
) -> Stage:
    """Pinned values of the first and last state, and the virtual-control penalty."""
    collect = Collector()
    p, trace = symbols.parameters, symbols.trace
    initial = trace("initial_state", problem.initial_state, p, rows=layout.nx)
    scaled = initial / ca.DM(layout.state_scale)
    pinned = scaled[pinned_at_start(problem)]
    collect.vector(Kind.EQUALITY_VECTOR, "initial_state", pinned)
    scales = {s.name: s.scale for s in problem.states}
    final = [
        trace(f"final_state {name}", value, p) / scales[name]
        for name, value in problem.final_state.items()
    ]
    collect.vector(Kind.EQUALITY_VECTOR, "final_state", ca.vertcat(*final))
    if layout.virtual_states.size:
        weight = 2 * p[VIRTUAL_CONTROL_WEIGHT] / problem.cost_scale
        collect.vector(Kind.COST_MATRIX, "virtual_control", weight)
    return collect.stage("boundary", symbols.reference, symbols.packed)


def _add_constraints(
    collect: Collector, problem: OptimalControlProblem, symbols: Symbols, where: Where
) -> None:
    reference = symbols.reference
    for constraint in constraints(problem, where):
        linear = isinstance(constraint, PathConstraint)
        what = f"constraint {constraint.name}"
        value = symbols.trace(
            what,
            constraint.expression,
            symbols.at(where, reference),
            symbols.parameters,
            rows=1 if linear else None,
        )
        value = value / constraint.scale
        jacobian = ca.jacobian(value, reference)
        if not linear:
            _require_cone(what, value, jacobian, reference)
            value, jacobian = -value, -jacobian
        collect.matrix(Kind.CONE_MATRIX, constraint.name, jacobian)
        offset = ca.mtimes(jacobian, reference) - value
        collect.vector(Kind.CONE_VECTOR, constraint.name, offset)


def _require_cone(what: str, value: ca.SX, jacobian: ca.SX, reference: ca.SX) -> None:
    """Refuse what is no second-order cone of the decision.

    Raises:
        InvalidInputError: Fewer than two rows, or not affine.
    """
    if value.shape[0] < 2:
        raise InvalidInputError(what, f"shape {value.shape}", "at least 2 rows, [g0; g1]")
    for row in range(value.shape[0]):
        if ca.depends_on(jacobian[row, :], reference):
            bound = "affine in state, control and interval length"
            raise InvalidInputError(what, f"row {row}, which is not", bound)


def constraints(problem: OptimalControlProblem, where: Where) -> Iterable[Constraint]:
    """Constraints at nodes or at interval means, linear ones first."""
    every: tuple[Constraint, ...] = (*problem.path_constraints, *problem.cone_constraints)
    return (constraint for constraint in every if constraint.where is where)

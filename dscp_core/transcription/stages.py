"""Compiled functions of one interval, one node and the end of a trajectory.

Each returns the nonzeros of its rows and columns as one dense column; `scatter` says where they
go. They are mapped over the trajectory, so that their size does not grow with N.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from enum import Enum

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
    CostTerm,
    OptimalControlProblem,
    PathConstraint,
    StagePoint,
    Where,
    named,
)
from dscp_core.transcription.layout import TrajectoryLayout

Indices = NDArray[np.int64]


class Kind(Enum):
    """Which value array a nonzero belongs to."""

    COST_MATRIX = "q"
    COST_VECTOR = "c"
    EQUALITY_MATRIX = "a"
    EQUALITY_VECTOR = "b"
    CONE_MATRIX = "g"
    CONE_VECTOR = "h"


@dataclass(frozen=True)
class Block:
    """Consecutive entries of a stage's output that belong together.

    Attributes:
        kind: Target array.
        group: Constraint that owns the rows, or "" for cost and dynamics.
        rows: Local row of each entry (local column of the cost vector's entries).
        columns: Local column of each entry; empty for vectors.
    """

    kind: Kind
    group: str
    rows: Indices
    columns: Indices


@dataclass
class Stage:
    """A compiled stage and the meaning of its output.

    Attributes:
        function: (local reference vector, parameters) -> dense column.
        blocks: Meaning of the output's entries, in order.
    """

    function: ca.Function
    blocks: tuple[Block, ...]

    @property
    def size(self) -> int:
        """Length of the output column."""
        return sum(block.rows.size for block in self.blocks)


@dataclass
class _Collector:
    """Gathers expressions and their blocks while a stage is built."""

    blocks: list[Block] = field(default_factory=list)
    parts: list[ca.SX] = field(default_factory=list)

    def matrix(self, kind: Kind, group: str, matrix: ca.SX) -> None:
        rows, columns = matrix.sparsity().get_triplet()
        self.blocks.append(Block(kind, group, np.array(rows, int), np.array(columns, int)))
        self.parts.append(ca.vec(matrix.nz[:]))

    def vector(self, kind: Kind, group: str, vector: ca.SX) -> None:
        rows = np.arange(vector.numel())
        self.blocks.append(Block(kind, group, rows, np.zeros(0, int)))
        self.parts.append(ca.densify(vector))

    def stage(self, name: str, reference: ca.SX, parameters: ca.SX) -> Stage:
        column = ca.cse(ca.vertcat(*self.parts))
        return Stage(ca.Function(name, [reference, parameters], [column]), tuple(self.blocks))


class _Symbols:
    """Local symbols: decision, reference and parameters of a stage with one or two nodes."""

    def __init__(self, problem: OptimalControlProblem, layout: TrajectoryLayout, nodes: int):
        size = layout.offset + nodes * (layout.nx + layout.nu)
        self._layout = layout
        self.packed = ca.SX.sym("p", problem.table.size)
        self.parameters = named(problem, self.packed)
        self.decision = ca.SX.sym("z", size)
        self.reference = ca.SX.sym("z_ref", size)

    def nodes(self, vector: ca.SX) -> list[StagePoint]:
        """Points at the nodes that a local scaled vector holds, in SI."""
        layout = self._layout
        step = self.terminal_time(vector) / layout.intervals
        points = []
        for start in range(layout.offset, vector.numel(), layout.nx + layout.nu):
            x = vector[start : start + layout.nx] * ca.DM(layout.state_scale)
            u = vector[start + layout.nx : start + layout.nx + layout.nu]
            points.append(StagePoint(x, u * ca.DM(layout.control_scale), step))
        return points

    def mean(self, vector: ca.SX) -> StagePoint:
        """Point at the interval mean."""
        first, second = self.nodes(vector)
        return StagePoint((first.x + second.x) / 2, (first.u + second.u) / 2, first.step)

    def terminal_time(self, vector: ca.SX) -> ca.SX:
        """Terminal time in seconds: a decision, or the parameter."""
        if self._layout.free_terminal_time:
            return vector[0] * self._layout.time_scale
        return self.parameters[TERMINAL_TIME]


@dataclass(frozen=True)
class StageFunctions:
    """All stages of a problem, and how to evaluate them along a trajectory."""

    problem: OptimalControlProblem
    layout: TrajectoryLayout
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
        if self.problem.running_cost is not None:
            cost += ca.sum2(self._map(self._running_cost, nodes, parameters))
        return cost, self._map(self._defect, intervals, parameters)

    def initial_guess(self, parameters: ca.MX) -> ca.MX:
        """Scaled reference vector of the first iteration."""
        layout = self.layout
        values = named(self.problem, parameters)
        guess = self.problem.initial_guess(values, layout.intervals)
        nodes = ca.vertcat(
            guess.states / ca.DM(layout.state_scale), guess.controls / ca.DM(layout.control_scale)
        )
        if layout.free_terminal_time:
            return ca.vertcat(values[TERMINAL_TIME] / layout.time_scale, ca.vec(nodes))
        return ca.vec(nodes)


def build_stages(problem: OptimalControlProblem, layout: TrajectoryLayout) -> StageFunctions:
    """Derive every stage of a problem: linearisation (eqs. 6 to 8) and quadratic costs."""
    pair, single = _Symbols(problem, layout, 2), _Symbols(problem, layout, 1)
    defect = _defect(problem, pair)
    terminal_cost = problem.terminal_cost(
        single.nodes(single.reference)[0].x,
        single.terminal_time(single.reference),
        single.parameters,
    )
    running = ca.SX(0)
    if problem.running_cost is not None:
        point = single.nodes(single.reference)[0]
        running = point.step * problem.running_cost(point.x, point.u, single.parameters)
    arguments = [single.reference, single.packed]
    return StageFunctions(
        problem,
        layout,
        _interval_stage(problem, layout, pair, defect),
        _node_stage(problem, layout, single),
        _terminal_stage(problem, layout, single, terminal_cost),
        _boundary_stage(problem, layout, single),
        ca.Function("defect", [pair.reference, pair.packed], [defect]),
        ca.Function("running_cost", arguments, [running]),
        ca.Function("terminal_cost", arguments, [terminal_cost]),
    )


def _defect(problem: OptimalControlProblem, symbols: _Symbols) -> ca.SX:
    """Residual of the discrete dynamics at the reference, eq. ch2-disdy, SI."""
    first, second = symbols.nodes(symbols.reference)
    mean = symbols.mean(symbols.reference)
    return second.x - first.x - mean.step * problem.dynamics(mean.x, mean.u, symbols.parameters)


def _interval_stage(
    problem: OptimalControlProblem, layout: TrajectoryLayout, symbols: _Symbols, defect: ca.SX
) -> Stage:
    collect = _Collector()
    residual = defect / ca.DM(layout.state_scale)
    jacobian = ca.jacobian(residual, symbols.reference)
    collect.matrix(Kind.EQUALITY_MATRIX, "", jacobian)
    collect.vector(Kind.EQUALITY_VECTOR, "", ca.mtimes(jacobian, symbols.reference) - residual)
    _add_stage(collect, problem, symbols, symbols.mean, Where.MEAN)
    return collect.stage("interval", symbols.reference, symbols.packed)


def _node_stage(
    problem: OptimalControlProblem, layout: TrajectoryLayout, symbols: _Symbols
) -> Stage:
    collect = _Collector()
    _add_stage(collect, problem, symbols, lambda vector: symbols.nodes(vector)[0], Where.NODE)
    change = symbols.decision[layout.offset :] - symbols.reference[layout.offset :]
    weights = ca.vertcat(
        symbols.parameters[TRUST_REGION_STATE], symbols.parameters[TRUST_REGION_CONTROL]
    )
    penalty = ca.dot(weights, change**2)
    if problem.trust_region_per_second:
        penalty *= symbols.nodes(symbols.reference)[0].step
    _add_quadratic(collect, "trust_region", penalty, symbols)
    return collect.stage("node", symbols.reference, symbols.packed)


def _terminal_stage(
    problem: OptimalControlProblem, layout: TrajectoryLayout, symbols: _Symbols, cost: ca.SX
) -> Stage:
    collect = _Collector()
    gradient = ca.gradient(cost, symbols.reference) / problem.cost_scale
    collect.vector(Kind.COST_VECTOR, "", gradient)
    if layout.free_terminal_time:
        relative = symbols.decision[0] / symbols.reference[0] - 1
        weight = symbols.parameters[TRUST_REGION_STEP]
        _add_quadratic(collect, "trust_region_step", weight * relative**2, symbols)
        if problem.terminal_time_bounds is not None:
            lower, upper = problem.terminal_time_bounds(symbols.parameters)
            rows = ca.jacobian(
                ca.vertcat(-symbols.decision[0], symbols.decision[0]), symbols.decision
            )
            collect.matrix(Kind.CONE_MATRIX, "terminal_time", rows)
            bound = ca.vertcat(-lower, upper) / layout.time_scale
            collect.vector(Kind.CONE_VECTOR, "terminal_time", bound)
    return collect.stage("terminal", symbols.reference, symbols.packed)


def _boundary_stage(
    problem: OptimalControlProblem, layout: TrajectoryLayout, symbols: _Symbols
) -> Stage:
    """Pinned values of the first and last state, and the virtual-control penalty."""
    collect = _Collector()
    initial = problem.initial_state(symbols.parameters) / ca.DM(layout.state_scale)
    collect.vector(Kind.EQUALITY_VECTOR, "initial", initial)
    scales = {s.name: s.scale for s in problem.states}
    final = [
        value(symbols.parameters) / scales[name] for name, value in problem.final_state.items()
    ]
    collect.vector(Kind.EQUALITY_VECTOR, "final", ca.vertcat(*final))
    if layout.virtual_states.size:
        weight = 2 * symbols.parameters[VIRTUAL_CONTROL_WEIGHT] / problem.cost_scale
        collect.vector(Kind.COST_MATRIX, "virtual_control", weight)
    return collect.stage("boundary", symbols.reference, symbols.packed)


def _add_stage(
    collect: _Collector,
    problem: OptimalControlProblem,
    symbols: _Symbols,
    at: Callable[[ca.SX], StagePoint],
    where: Where,
) -> None:
    reference = symbols.reference
    for constraint in constraints(problem, where):
        value = constraint.expression(at(reference), symbols.parameters) / constraint.scale
        jacobian = ca.jacobian(value, reference)
        offset = ca.mtimes(jacobian, reference) - value
        if isinstance(constraint, PathConstraint):
            collect.matrix(Kind.CONE_MATRIX, constraint.name, jacobian)
            collect.vector(Kind.CONE_VECTOR, constraint.name, offset)
        else:
            collect.matrix(Kind.CONE_MATRIX, constraint.name, -jacobian)
            collect.vector(Kind.CONE_VECTOR, constraint.name, -offset)
    for term in _terms(problem, where):
        expression = term.expression(at(symbols.decision), at(reference), symbols.parameters)
        _add_quadratic(collect, term.name, expression / problem.cost_scale, symbols)


def _add_quadratic(collect: _Collector, name: str, cost: ca.SX, symbols: _Symbols) -> None:
    hessian, gradient = ca.hessian(cost, symbols.decision)
    if ca.depends_on(hessian, symbols.decision):
        raise InvalidInputError(f"cost term {name}", "Hessian depends on the decision", "quadratic")
    collect.matrix(Kind.COST_MATRIX, "", ca.triu(hessian))
    linear = ca.substitute(gradient, symbols.decision, ca.DM.zeros(symbols.decision.shape))
    collect.vector(Kind.COST_VECTOR, "", linear)


def constraints(problem: OptimalControlProblem, where: Where) -> Iterable[Constraint]:
    """Constraints at nodes or at interval means, linear ones first."""
    every: tuple[Constraint, ...] = (
        *problem.path_constraints,
        *problem.cone_constraints,
    )
    return (constraint for constraint in every if constraint.where is where)


def _terms(problem: OptimalControlProblem, where: Where) -> Iterable[CostTerm]:
    return (term for term in problem.cost_terms if term.where is where)

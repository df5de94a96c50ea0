"""One stage: local symbols, and a compiled function with the meaning of its output."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import Enum

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dscp_core.cone.convexity import require_convex
from dscp_core.errors import InvalidInputError
from dscp_core.problem.declaration import (
    TERMINAL_TIME,
    OptimalControlProblem,
    StagePoint,
    Where,
    named,
)
from dscp_core.problem.tracing import Tracer
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
        group: What it comes from: the constraint that owns the rows, the cost, the equation.
        rows: Local row of each entry (local column of the cost vector's entries).
        columns: Local column of each entry; empty for vectors.
        weighted: Whether the quadrature's weight of the node applies.
    """

    kind: Kind
    group: str
    rows: Indices
    columns: Indices
    weighted: bool = False


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

    def located(self) -> Iterator[tuple[Block, Indices]]:
        """Every block with the positions of its entries in the output."""
        start = 0
        for block in self.blocks:
            yield block, np.arange(start, start + block.rows.size)
            start += block.rows.size


@dataclass
class Collector:
    """Gathers expressions and their blocks while a stage is built."""

    blocks: list[Block] = field(default_factory=list)
    parts: list[ca.SX] = field(default_factory=list)

    def matrix(self, kind: Kind, group: str, matrix: ca.SX, *, weighted: bool = False) -> None:
        """Add the nonzeros of a matrix."""
        rows, columns = (np.array(part, int) for part in matrix.sparsity().get_triplet())
        self.blocks.append(Block(kind, group, rows, columns, weighted))
        self.parts.append(ca.vec(matrix.nz[:]))

    def vector(self, kind: Kind, group: str, vector: ca.SX, *, weighted: bool = False) -> None:
        """Add a vector."""
        rows = np.arange(vector.numel())
        self.blocks.append(Block(kind, group, rows, np.zeros(0, int), weighted))
        self.parts.append(ca.densify(vector))

    def quadratic(
        self, group: str, cost: ca.SX, symbols: Symbols, *, weighted: bool = False
    ) -> None:
        """Add a cost, at most quadratic in the decision.

        Raises:
            InvalidInputError: It is not, or its Hessian is a constant that is not positive
                semidefinite.
        """
        hessian, gradient = ca.hessian(cost, symbols.decision)
        if ca.depends_on(hessian, symbols.decision):
            bound = "at most quadratic in the decision"
            raise InvalidInputError(f"cost term {group}", "a Hessian that depends on it", bound)
        if not ca.depends_on(hessian, ca.vertcat(symbols.reference, symbols.packed)):
            require_convex(f"cost term {group}", ca.evalf(ca.densify(hessian)).full())
        self.matrix(Kind.COST_MATRIX, group, ca.triu(hessian), weighted=weighted)
        linear = ca.substitute(gradient, symbols.decision, ca.DM.zeros(symbols.decision.shape))
        self.vector(Kind.COST_VECTOR, group, linear, weighted=weighted)

    def stage(self, name: str, reference: ca.SX, parameters: ca.SX) -> Stage:
        """The stage of all that was added."""
        column = ca.cse(ca.vertcat(*self.parts))
        return Stage(ca.Function(name, [reference, parameters], [column]), tuple(self.blocks))


class Symbols:
    """Local symbols: decision, reference and parameters of a stage with one or two nodes.

    Attributes:
        packed: Packed parameters.
        parameters: The same by name.
        decision: Local decision vector, scaled.
        reference: Local reference vector, scaled.
        offset: Position of the first node in both.
        trace: Calls the declaration's functions with expressions of these.
    """

    def __init__(self, problem: OptimalControlProblem, layout: TrajectoryLayout, nodes: int):
        size = layout.offset + nodes * (layout.nx + layout.nu)
        self._layout = layout
        self.offset = layout.offset
        self.packed = ca.SX.sym("p", problem.table.size)
        self.parameters = named(problem, self.packed)
        self.decision = ca.SX.sym("z", size)
        self.reference = ca.SX.sym("z_ref", size)
        self.trace = Tracer(problem.table, self.decision, self.reference, self.packed)

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
        x, u = (first.x + second.x) / 2, (first.u + second.u) / 2
        return StagePoint(x, u, first.step, second.u - first.u)

    def node(self, vector: ca.SX) -> StagePoint:
        """Point at the first node."""
        return self.nodes(vector)[0]

    def at(self, where: Where, vector: ca.SX) -> StagePoint:
        """Point at the first node or at the interval mean."""
        return self.node(vector) if where is Where.NODE else self.mean(vector)

    def terminal_time(self, vector: ca.SX) -> ca.SX:
        """Terminal time in seconds: a decision, or the parameter."""
        if self._layout.free_terminal_time:
            return vector[0] * self._layout.time_scale
        return self.parameters[TERMINAL_TIME]

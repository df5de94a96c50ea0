"""Where the stages' outputs go in the value arrays of a subproblem."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from dscp_core.cone.program import ConePattern, CscPattern
from dscp_core.problem.declaration import (
    TERMINAL_TIME,
    ConeConstraint,
    Constraint,
    OptimalControlProblem,
    Where,
)
from dscp_core.transcription.layout import TrajectoryLayout
from dscp_core.transcription.stage import Block, Kind, Stage
from dscp_core.transcription.stages import StageFunctions, pinned_at_start

Indices = NDArray[np.int64]


@dataclass(frozen=True)
class RowGroup:
    """Rows of G that one constraint owns.

    Attributes:
        name: Constraint.
        start: First row.
        dimension: Rows per place (cone dimension; 1 for a linear row).
        places: Node or interval of each row or cone, in order.
    """

    name: str
    start: int
    dimension: int
    places: Indices


class ValueScatter:
    """Sparse matrix from stage outputs to values ``[q, c, a, b, g, h]``, and the pattern.

    Attributes:
        pattern: Sparsity of the subproblems.
        matrix: CasADi constant, (n_values, n_sources).
        n_values: Length of the flat value vector.
        row_groups: Owners of the rows of G.
    """

    def __init__(
        self, problem: OptimalControlProblem, layout: TrajectoryLayout, stages: StageFunctions
    ) -> None:
        self._problem = problem
        self._layout = layout
        self._stages = stages
        self._entries: dict[Kind, list[tuple[Indices, Indices, Indices, NDArray[np.float64]]]] = {
            kind: [] for kind in Kind
        }
        self._one = (
            layout.intervals * stages.interval.size
            + (layout.intervals + 1) * stages.node.size
            + stages.terminal.size
            + stages.boundary.size
        )
        self._assign_rows()
        self._collect()
        self._finish()

    def _assign_rows(self) -> None:
        """Give every inequality its rows: linear ones first, then cone after cone."""
        layout = self._layout
        groups: list[RowGroup] = []
        start = 0
        terminal = any(block.group == TERMINAL_TIME for block in self._stages.terminal.blocks)
        if terminal:
            groups.append(RowGroup(TERMINAL_TIME, 0, 1, np.zeros(2, int)))
            start = 2
        every: list[Constraint] = [
            *self._problem.path_constraints,
            *self._problem.cone_constraints,
        ]
        soc_dims: list[int] = []
        for constraint in every:
            stage = self._stages.node if constraint.where is Where.NODE else self._stages.interval
            dimension = next(
                block.rows.size
                for block in stage.blocks
                if block.group == constraint.name and block.kind is Kind.CONE_VECTOR
            )
            count = layout.intervals + (constraint.where is Where.NODE)
            places = np.array(constraint.places(count), dtype=int)
            if isinstance(constraint, ConeConstraint):
                soc_dims += [dimension] * places.size
            groups.append(RowGroup(constraint.name, start, dimension, places))
            start += dimension * places.size
        self.row_groups = tuple(groups)
        self._n_rows = start
        self._soc_dims = tuple(soc_dims)
        self._n_nonnegative = start - sum(soc_dims)
        self._final = [
            next(i for i, s in enumerate(self._problem.states) if s.name == name)
            for name in self._problem.final_state
        ]
        self._initial = pinned_at_start(self._problem)
        pinned = len(self._initial) + len(self._final)
        self._n_equalities = layout.intervals * layout.nx + pinned

    def _add(
        self,
        kind: Kind,
        rows: Indices,
        columns: Indices,
        sources: Indices,
        factor: float | NDArray[np.float64] = 1.0,
    ) -> None:
        rows, columns, sources, factors = np.broadcast_arrays(rows, columns, sources, factor)
        self._entries[kind].append(
            (rows.ravel(), columns.ravel(), sources.ravel(), factors.ravel().astype(float))
        )

    def _collect(self) -> None:
        layout, stages = self._layout, self._stages
        width = layout.nx + layout.nu
        source = 0
        for stage, count in (
            (stages.interval, layout.intervals),
            (stages.node, layout.intervals + 1),
        ):
            places = np.arange(count)
            for block, entries in stage.located():
                self._add_block(
                    stage, block, places, source + places[:, None] * stage.size + entries
                )
            source += count * stage.size
        last = np.array([layout.intervals])
        for block, entries in stages.terminal.located():
            self._add_block(stages.terminal, block, last, source + entries[None, :])
        source += stages.terminal.size
        self._add_boundary(source, width)
        self._add_virtual_control()

    def _add_block(self, stage: Stage, block: Block, places: Indices, sources: Indices) -> None:
        """One block at every place where it is imposed; sources is (places, entries)."""
        columns = self._columns(block.columns if block.columns.size else block.rows, places)
        factor = self._stages.weights[places][:, None] if block.weighted else 1.0
        if block.kind is Kind.COST_VECTOR:
            columns = self._columns(block.rows, places)
            self._add(block.kind, columns, np.zeros_like(columns), sources, factor)
            return
        if block.kind is Kind.COST_MATRIX:
            rows = self._columns(block.rows, places)
            self._add(block.kind, rows, columns, sources, factor)
            return
        if block.kind in (Kind.EQUALITY_MATRIX, Kind.EQUALITY_VECTOR):
            rows = places[:, None] * self._layout.nx + block.rows
        else:
            group = next(g for g in self.row_groups if g.name == block.group)
            if stage is self._stages.terminal:
                rows = group.start + block.rows[None, :]
            else:
                kept = np.isin(places, group.places)
                sources, columns = sources[kept], columns[kept]
                order = np.arange(group.places.size)[:, None]
                rows = group.start + order * group.dimension + block.rows
        if block.columns.size or block.kind in (Kind.EQUALITY_MATRIX, Kind.CONE_MATRIX):
            self._add(block.kind, rows, columns, sources)
        else:
            self._add(block.kind, rows, np.zeros_like(rows), sources)

    def _columns(self, local: Indices, places: Indices) -> Indices:
        """Global columns (places, entries) of local ones."""
        layout = self._layout
        moved = local + places[:, None] * (layout.nx + layout.nu)
        return np.where(local < layout.offset, local, moved)

    def _add_boundary(self, source: int, width: int) -> None:
        layout = self._layout
        row = layout.intervals * layout.nx
        one = np.array([self._one])
        for block in self._stages.boundary.blocks:
            entries = source + np.arange(block.rows.size)
            source += block.rows.size
            if block.group == "virtual_control":
                columns = np.arange(layout.reference_size, layout.size)
                self._add(Kind.COST_MATRIX, columns, columns, entries)
                continue
            if block.group == "initial_state":
                states, node = np.array(self._initial, int), 0
            else:
                states, node = np.array(self._final, int), layout.intervals
            rows = row + np.arange(states.size)
            columns = layout.offset + node * width + states
            self._add(Kind.EQUALITY_VECTOR, rows, np.zeros_like(rows), entries)
            self._add(Kind.EQUALITY_MATRIX, rows, columns, one)
            row += states.size

    def _add_virtual_control(self) -> None:
        layout = self._layout
        states = layout.virtual_states
        rows = (np.arange(layout.intervals)[:, None] * layout.nx + states).ravel()
        columns = layout.reference_size + np.arange(rows.size)
        factor = np.tile(-(layout.virtual_scale / layout.state_scale)[states], layout.intervals)
        self._add(Kind.EQUALITY_MATRIX, rows, columns, np.array([self._one]), factor)

    def _finish(self) -> None:
        n, m, p = self._layout.size, self._n_rows, self._n_equalities
        q, q_map = self._matrix(Kind.COST_MATRIX, (n, n))
        a, a_map = self._matrix(Kind.EQUALITY_MATRIX, (p, n))
        g, g_map = self._matrix(Kind.CONE_MATRIX, (m, n))
        maps = [
            q_map,
            self._vector(Kind.COST_VECTOR, n),
            a_map,
            self._vector(Kind.EQUALITY_VECTOR, p),
            g_map,
            self._vector(Kind.CONE_VECTOR, m),
        ]
        stacked = sp.csc_matrix(sp.vstack(maps))
        stacked.sort_indices()
        self.n_values = int(stacked.shape[0])
        sparsity = ca.Sparsity(*stacked.shape, stacked.indptr.tolist(), stacked.indices.tolist())
        self.matrix = ca.DM(sparsity, stacked.data)
        self.pattern = ConePattern(
            n=n, q=q, a=a, g=g, n_nonnegative=self._n_nonnegative, soc_dims=self._soc_dims
        )

    def _gathered(self, kind: Kind) -> tuple[Indices, Indices, Indices, NDArray[np.float64]]:
        entries = self._entries[kind]
        if not entries:
            nothing = np.zeros(0, int)
            return nothing, nothing, nothing, np.zeros(0)
        rows, columns, sources, factors = (
            np.concatenate(part) for part in zip(*entries, strict=True)
        )
        return rows, columns, sources, factors

    def _matrix(self, kind: Kind, shape: tuple[int, int]) -> tuple[CscPattern, sp.csc_matrix]:
        rows, columns, sources, factors = self._gathered(kind)
        keys = columns.astype(np.int64) * shape[0] + rows
        unique, position = np.unique(keys, return_inverse=True)
        indptr = np.searchsorted(unique, np.arange(shape[1] + 1) * shape[0])
        rows_of_entries = (unique % shape[0]).astype(np.int32)
        pattern = CscPattern(*shape, indptr.astype(np.int32), rows_of_entries)
        scatter = sp.csc_matrix((factors, (position, sources)), shape=(unique.size, self._one + 1))
        return pattern, scatter

    def _vector(self, kind: Kind, size: int) -> sp.csc_matrix:
        rows, _, sources, factors = self._gathered(kind)
        return sp.csc_matrix((factors, (rows, sources)), shape=(size, self._one + 1))

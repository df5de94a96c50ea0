"""KKT matrix of an active set with one sparsity pattern for all active sets (eq. KKT1).

Unknowns are (z, nu, eta) with one eta per row of G: the multiplier of an active nonnegative row;
in the first row of a cone on its boundary its lambda_0; in every row of a cone at its apex its
dual.  All other rows are decoupled by a diagonal -1 and zero couplings, so that ordering and
symbolic factorisation are done once per pattern.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import numpy as np
import qdldl
import scipy.sparse as sp
import scipy.sparse.linalg
from numpy.typing import NDArray

from dscp_core.cone.derivative.active_set import ActiveSet, ConeFrame, ConeRows, IndexArray
from dscp_core.cone.program import ConePattern, ConeValues, FloatArray

_REFINED_RESIDUAL = 1e-3
"""Largest relative residual of a solve that is refined once: of entries and landings those by grown
factors are above 0.1, others below 1e-4."""

_STRONGER = 100.0
"""Regularisation over the usual one: the square of what is added to the diagonal then is above the
rounding unit, below which a pivot left by cancellation is noise."""

_INNER_REFINEMENTS = 3
"""From a solve with the stronger regularisation to one with the usual."""


@dataclass(frozen=True)
class Conditioning:
    """What probing the factored matrix with a random vector showed.

    Attributes:
        condition_estimate: Largest entry of the matrix times the growth of the probe under two
            steps of inverse iteration: an estimate of |H| |H^-1| from below.
        singularity: Regularisation times that growth: what one refinement step leaves of the
            error, near 1 for a singular matrix.
    """

    condition_estimate: float
    singularity: float


class KktMatrix:
    """Assembles, factors and solves; bound to one pattern.

    Args:
        pattern: Structure of the program.
        rows: Index maps of its cone rows.
        regularisation: Added to the diagonal of the factored matrix, positive in the rows of z,
            negative elsewhere; refinement removes its effect on the solution.
        max_refinements: Largest number of refinement steps of one solve.
    """

    def __init__(
        self,
        pattern: ConePattern,
        rows: ConeRows,
        regularisation: float,
        max_refinements: int,
    ) -> None:
        self._rows = rows
        self._max_refinements = max_refinements
        n, p, m = pattern.n, pattern.n_equalities, pattern.n_cone_rows
        self.size = n + p + m
        self._first_cone_slot = n + p
        g_rows, g_columns = pattern.g.indices, pattern.g.columns
        slot_of_row = n + p + np.arange(m)
        first_slot_of_row = slot_of_row.copy()
        first_slot_of_row[rows.tails] = slot_of_row[rows.starts][rows.tail_cone]
        self._g_rows = g_rows
        # Entries of G in the tail rows of cones, with the position of their row among the tails.
        position = np.full(m, -1)
        position[rows.tails] = np.arange(rows.tails.size)
        self._tail_entries: IndexArray = np.flatnonzero(position[g_rows] >= 0)
        self._tail_position: IndexArray = position[g_rows][self._tail_entries]
        self._tail_cone: IndexArray = rows.tail_cone[self._tail_position]
        left, right = _pairs_within_cones(self._tail_cone, g_columns[self._tail_entries])
        self._left, self._right = left, right
        self._pair_cone = self._tail_cone[left]
        self._pair_same_row = (self._tail_position[left] == self._tail_position[right]).astype(
            np.float64
        )
        tail_columns = g_columns[self._tail_entries]
        diagonal = np.arange(self.size)
        # Sources of values, in the order in which `assemble` concatenates them.
        targets = (
            (pattern.q.indices, pattern.q.columns),
            (tail_columns[left], tail_columns[right]),
            (pattern.a.columns, n + pattern.a.indices),
            (g_columns, first_slot_of_row[g_rows]),
            (tail_columns, slot_of_row[g_rows[self._tail_entries]]),
            (diagonal, diagonal),
        )
        self._set_up_pattern(targets)
        self._regularisation = np.full(self.size, -regularisation)
        self._regularisation[:n] = regularisation
        self._strength = regularisation
        self._values = np.zeros(self._factored.nnz)
        self._held: tuple[ConeValues, bytes] | None = None
        # Random signs, so that no direction of the solution space is missed systematically.
        self._probe_vector = np.random.default_rng(0).choice((-1.0, 1.0), self.size)

    def _set_up_pattern(self, targets: tuple[tuple[NDArray[np.integer], ...], ...]) -> None:
        target_rows = np.concatenate([t[0] for t in targets]).astype(np.int64)
        target_columns = np.concatenate([t[1] for t in targets]).astype(np.int64)
        cells, cell_of_source = np.unique(
            target_columns * self.size + target_rows, return_inverse=True
        )
        columns, row_indices = np.divmod(cells, self.size)
        indptr = np.searchsorted(columns, np.arange(self.size + 1))
        shape = (self.size, self.size)
        ones = np.ones(cells.size)
        self._factored = sp.csc_matrix((ones, row_indices, indptr), shape=shape)
        # Both triangles, with the number of the upper-triangle cell that each entry repeats.
        numbered = sp.csc_array((np.arange(1.0, cells.size + 1.0), row_indices, indptr), shape)
        self._full = sp.csc_array(numbered + sp.triu(numbered, k=1).T)
        self._full_cells: IndexArray = np.rint(self._full.data).astype(np.intp) - 1
        n_sources = cell_of_source.size
        self._gather = sp.csr_array(
            (np.ones(n_sources), (cell_of_source, np.arange(n_sources))),
            shape=(cells.size, n_sources),
        )
        self._diagonal_cells: IndexArray = np.flatnonzero(row_indices == columns)
        # A first factorisation of a quasidefinite sample fixes ordering and symbolic work.
        sample = np.zeros(cells.size)
        sample[self._diagonal_cells] = 1.0
        sample[self._diagonal_cells[self._first_cone_slot :]] = -1.0
        self._factored.data = sample
        self._factor = qdldl.Solver(self._factored, upper=True)
        self._solve: Callable[[FloatArray], FloatArray] = self._factor.solve

    def update(
        self,
        values: ConeValues,
        active: ActiveSet,
        frame: ConeFrame,
        eta: FloatArray,
        slot_diagonal: FloatArray | None = None,
    ) -> None:
        """Assemble and factor the matrix of one point.

        Without second-order cones it depends on data and active set alone, and nothing is done
        when both are those of the last call.

        Args:
            values: Data of the program, not changed in place between calls.
            active: Which rows are coupled.
            frame: Geometry of the slack.
            eta: (m,) multipliers.
            slot_diagonal: (m,) added to the diagonal of the rows of eta, zero if None.
        """
        key = active.key()
        depends_on_point = slot_diagonal is not None or bool(self._rows.starts.size)
        held = self._held
        if not depends_on_point and held is not None and held[0] is values and held[1] == key:
            return
        self._held = None
        self._assemble(values, active, frame, eta, slot_diagonal)
        self._refactor()
        if not depends_on_point:
            self._held = (values, key)

    def _assemble(
        self,
        values: ConeValues,
        active: ActiveSet,
        frame: ConeFrame,
        eta: FloatArray,
        slot_diagonal: FloatArray | None = None,
    ) -> None:
        """Set the values of the matrix of one point."""
        rows = self._rows
        # Weight of each row of G in the normal of its constraint: (1, -u) on a cone's boundary.
        weight = np.zeros(rows.n_rows)
        weight[: rows.n_nonnegative] = active.linear
        weight[rows.starts] = active.boundary | active.apex
        weight[rows.tails] = -frame.direction * active.boundary[rows.tail_cone]
        apex = active.apex[self._tail_cone]
        tail_g = values.g[self._tail_entries]
        # Curvature lambda_0 G1'(I - u u')G1 / |g1| of eq. 32.
        safe = np.where(active.boundary, frame.tail_norm, 1.0)
        curvature = np.where(active.boundary, eta[rows.starts] / safe, 0.0)
        along = tail_g * frame.direction[self._tail_position]
        left, right = self._left, self._right
        pairs = curvature[self._pair_cone] * (
            self._pair_same_row * tail_g[left] * tail_g[right] - along[left] * along[right]
        )
        diagonal = np.zeros(self.size)
        diagonal[self._first_cone_slot :] = active.rows(rows) - 1.0
        if slot_diagonal is not None:
            diagonal[self._first_cone_slot :] += slot_diagonal
        sources = np.concatenate(
            (
                values.q,
                pairs,
                values.a,
                values.g * weight[self._g_rows],
                tail_g * apex,
                diagonal,
            )
        )
        self._values = self._gather @ sources
        self._full.data = self._values[self._full_cells]

    def _refactor(self) -> None:
        """Factor the assembled matrix, regularised; more carefully where factors have grown."""
        self._factor_with(self._regularisation)
        self._solve = self._factor.solve
        if self._is_accurate():
            return
        self._factor_with(_STRONGER * self._regularisation)
        self._solve = self._refined
        if not self._is_accurate():
            self._solve = self._pivoted() or self._refined

    def _factor_with(self, regularisation: FloatArray) -> None:
        values = self._values.copy()
        values[self._diagonal_cells] += regularisation
        self._factored.data = values
        self._factor.update(self._factored, upper=True)

    def _is_accurate(self) -> bool:
        """Whether refinement by the solve converges: without pivots factors may have grown."""
        right = self._probe_vector
        solved = self._solve(right)
        solved = solved + self._solve(self._regularised_defect(solved, right))
        residual = np.abs(self._regularised_defect(solved, right)).max()
        return bool(residual <= _REFINED_RESIDUAL)  # False for NaN too

    def _refined(self, right: FloatArray) -> FloatArray:
        """Solve with the regularised matrix by the factors of one with more regularisation."""
        solved: FloatArray = self._factor.solve(right)
        for _ in range(_INNER_REFINEMENTS):
            solved = solved + self._factor.solve(self._regularised_defect(solved, right))
        return solved

    def _regularised_defect(self, solved: FloatArray, right: FloatArray) -> FloatArray:
        return right - self.times(solved) - self._regularisation * solved

    def _pivoted(self) -> Callable[[FloatArray], FloatArray] | None:
        """A slower solve with the same regularised matrix, or None where it is singular."""
        try:
            factor = scipy.sparse.linalg.splu(
                sp.csc_array(self._full + sp.diags_array(self._regularisation))
            )
        except RuntimeError:
            return None
        return cast("Callable[[FloatArray], FloatArray]", factor.solve)

    def times(self, x: FloatArray) -> FloatArray:
        """(size,) product with the assembled matrix, without regularisation."""
        return np.asarray(self._full @ x)

    def probe(self) -> Conditioning:
        """Conditioning of the factored matrix, by two solves."""
        first = self._solve(self._probe_vector)
        growth = float(np.linalg.norm(self._solve(first / np.linalg.norm(first))))
        largest = float(np.abs(self._values).max())
        return Conditioning(largest * growth, self._strength * growth)

    def solve(self, right: FloatArray, tolerance: float) -> tuple[FloatArray, float]:
        """Solve with the assembled matrix by refining the regularised factorisation.

        Args:
            right: (size,) right-hand side.
            tolerance: Relative residual at which refinement stops.

        Returns:
            The (size,) solution and the largest entry of its residual relative to that of
            `right`.
        """
        scale = float(np.abs(right).max())
        if scale == 0.0:
            return np.zeros(self.size), 0.0
        best = self._solve(right)
        defect = right - self.times(best)
        best_residual = float(np.abs(defect).max()) / scale
        for _ in range(self._max_refinements):
            if best_residual <= tolerance:
                break
            candidate = best + self._solve(defect)
            defect = right - self.times(candidate)
            residual = float(np.abs(defect).max()) / scale
            if not residual < best_residual:
                break
            stalled = residual > 0.5 * best_residual
            best, best_residual = candidate, residual
            if stalled:
                break
        return best, best_residual


def _pairs_within_cones(
    cones: IndexArray, columns: NDArray[np.integer]
) -> tuple[IndexArray, IndexArray]:
    """All ordered pairs of entries of the same cone whose columns are (smaller, larger or equal).

    Entries of equal column pair both ways, so that sums over pairs give the upper triangle of
    the symmetric product.
    """
    order = np.argsort(cones, kind="stable")
    counts = np.bincount(cones) if cones.size else np.zeros(0, dtype=np.intp)
    lefts, rights = [np.zeros(0, dtype=np.intp)], [np.zeros(0, dtype=np.intp)]
    for entries in np.split(order, np.cumsum(counts)[:-1]) if counts.size else []:
        left, right = np.repeat(entries, entries.size), np.tile(entries, entries.size)
        keep = columns[left] <= columns[right]
        lefts.append(left[keep])
        rights.append(right[keep])
    return np.concatenate(lefts), np.concatenate(rights)

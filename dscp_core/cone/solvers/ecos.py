"""ECOS: the paper's solver; linear cost only, so the quadratic term becomes an epigraph cone.

With Q = F'F and any scale r > 0, 1/2 z'Qz <= t holds exactly when (t/r + r/2, t/r - r/2, F z)
lies in a second-order cone; the cost is then c'z + t.  Such a point is accurate only to about the
square root of the tolerance, best with r = |F z|.  ECOS is distributed under the GPL, version 3.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import qdldl
import scipy.sparse as sp

from dscp_core.cone.program import ConePattern, ConeSolution, ConeValues, FloatArray, SolveStatus
from dscp_core.cone.solvers.base import AnswerChecker, RawAnswer, SolverSettings, import_backend

# Exit flags of ECOS; 10, 11, 12 are the "inaccurate" forms of 0, 1, 2 and count as failures
# until the residual or certificate check says otherwise.
_CLAIMS = {
    0: SolveStatus.SOLVED,
    1: SolveStatus.INFEASIBLE,
    2: SolveStatus.UNBOUNDED,
    -1: SolveStatus.ITERATION_LIMIT,
}


class EcosSolver:
    """Backend for ECOS; its interface offers no data update and no time limit.

    `time_limit_s` only prevents a call with no time left.
    """

    name = "ecos"

    def __init__(self, pattern: ConePattern, settings: SolverSettings) -> None:
        self._package = import_backend("ecos")
        self._pattern = pattern
        self._checker = AnswerChecker(self.name, pattern, settings)
        self._options = {
            "abstol": settings.tolerance,
            "reltol": settings.tolerance,
            "feastol": settings.tolerance,
            "max_iters": settings.max_iterations,
            "verbose": False,
        }
        self._epigraph = _Epigraph(pattern) if pattern.q.nnz else None
        more_columns = 0 if self._epigraph is None else 1
        self._a = sp.csc_matrix(
            (
                np.ones(pattern.a.nnz),
                pattern.a.indices,
                np.append(pattern.a.indptr, [pattern.a.nnz] * more_columns),
            ),
            shape=(pattern.n_equalities, pattern.n + more_columns),
        )
        self._g = sp.csc_matrix(pattern.g.matrix(np.ones(pattern.g.nnz)))

    def solve(self, values: ConeValues, *, time_limit_s: float | None = None) -> ConeSolution:
        """See `ConeSolver.solve`."""
        if time_limit_s is not None and time_limit_s <= 0.0:
            return self._checker.not_attempted(time_limit_s)
        self._checker.bind(values)
        solution = self._attempt(values, 0.0)
        if self._epigraph is None:
            return solution
        rescaled = self._epigraph.rescale(solution.z)
        if rescaled and solution.status in (
            SolveStatus.NUMERICAL_FAILURE,
            SolveStatus.ITERATION_LIMIT,
        ):
            return self._attempt(values, solution.seconds)
        return solution

    def _attempt(self, values: ConeValues, seconds_before: float) -> ConeSolution:
        pattern = self._pattern
        n, m = pattern.n, pattern.n_cone_rows
        start = time.perf_counter()
        cones = list(pattern.soc_dims)
        cost, g, h = values.c, self._g, values.h
        if self._epigraph is None:
            g.data = values.g
        else:
            g, h = self._epigraph.rows(values)
            cost = np.append(cost, 1.0)
            cones.append(self._epigraph.dim)
        self._a.data = values.a
        has_g, has_a = g.shape[0] > 0, pattern.n_equalities > 0
        answer: dict[str, Any] = self._package.solve(
            cost,
            g if has_g else None,
            h if has_g else None,
            {"l": pattern.n_nonnegative, "q": cones},
            self._a if has_a else None,
            values.b if has_a else None,
            **self._options,
        )
        seconds = time.perf_counter() - start
        flag = answer["info"]["exitFlag"]
        raw = RawAnswer(
            z=answer["x"][:n],
            duals=np.concatenate((answer["y"], answer["z"][:m])),
            slack=answer["s"][:m],
            claim=_CLAIMS.get(flag, SolveStatus.NUMERICAL_FAILURE),
            iterations=answer["info"]["iter"],
            seconds=seconds + seconds_before,
            setup_seconds=0.0,
            message=f"ecos: exit flag {flag}, {answer['info']['infostring']}",
        )
        return self._checker.check(values, raw)


class _Epigraph:
    """Cone rows of the program whose cost is c'z + t with 1/2 z'Qz <= t, scaled by r."""

    # Relative to the largest diagonal entry of Q: below any rounding that matters, enough for
    # the factor of a semidefinite Q to exist.
    _SHIFT = 1e-14

    def __init__(self, pattern: ConePattern) -> None:
        support = np.unique(pattern.q.indices)
        size = support.size
        self.dim = size + 2
        position = np.zeros(pattern.n, dtype=np.int64)
        position[support] = np.arange(size)
        rows, columns = position[pattern.q.indices], position[pattern.q.columns]
        # The map of columns to the support is increasing, so the order of entries is unchanged.
        self._diagonal = np.flatnonzero(rows == columns)
        # The identity, with the off-diagonal entries stored as zeros: only the structure of the
        # factor is wanted here.
        identity = np.where(rows == columns, 1.0, 0.0)
        self._q = sp.csc_matrix((identity, (rows, columns)), shape=(size, size))
        self._factor = qdldl.Solver(self._q, upper=True)
        lower, _, order = self._factor.factors()
        lower = sp.coo_array(lower)
        # F = sqrt(D) (I + L)' P', so entry (j, i) of L is entry (i, order[j]) of F.
        self._f_rows = np.concatenate((np.arange(size), lower.col)).astype(np.int64)
        f_columns = support[np.asarray(order)[np.concatenate((np.arange(size), lower.row))]]
        f_columns = f_columns.astype(np.int64)
        n, m = pattern.n, pattern.n_cone_rows
        all_rows = np.concatenate((pattern.g.indices, m + 2 + self._f_rows, [m, m + 1]))
        all_columns = np.concatenate((pattern.g.columns, f_columns, [n, n]))
        self._order = np.lexsort((all_rows, all_columns))
        self._g = sp.csc_matrix(
            (np.ones(all_rows.size), (all_rows, all_columns)), shape=(m + self.dim, n + 1)
        )
        self._f = sp.coo_array(
            (np.zeros(f_columns.size), (self._f_rows, f_columns)), shape=(size, pattern.n)
        )
        self._scale = 1.0

    def rows(self, values: ConeValues) -> tuple[sp.csc_matrix, FloatArray]:
        """G and h over the variables (z, t)."""
        diagonal = values.q[self._diagonal]
        largest = float(np.abs(diagonal).max())
        shift = self._SHIFT * largest if largest > 0.0 else 1e-300
        self._q.data = values.q.copy()
        self._q.data[self._diagonal] += shift
        self._factor.update(self._q, upper=True)
        lower, pivots, _ = self._factor.factors()
        roots = np.sqrt(np.maximum(pivots, 0.0))
        unscaled = np.concatenate((np.ones(roots.size), lower.data))
        self._f.data = roots[self._f_rows] * unscaled
        t = -1.0 / self._scale
        self._g.data = np.concatenate((values.g, -self._f.data, [t, t]))[self._order]
        half = 0.5 * self._scale
        return self._g, np.concatenate((values.h, [half, -half], np.zeros(self.dim - 2)))

    def rescale(self, z: FloatArray) -> bool:
        """Set the scale r to |F z| of a point; False if there is nothing to gain."""
        wanted = float(np.linalg.norm(self._f @ z))
        if not np.isfinite(wanted) or wanted == 0.0 or 0.5 < wanted / self._scale < 2.0:
            return False
        self._scale = wanted
        return True

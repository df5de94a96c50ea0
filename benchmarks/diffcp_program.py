"""A cone program in the form that diffcp differentiates."""

from __future__ import annotations

from typing import Any

import diffcp  # type: ignore[import-untyped]
import numpy as np
import scipy.sparse as sp

from benchmarks.timing import Array
from dscp_core.cone.program import ConePattern, ConeValues

MODES = ("lsqr", "dense")


class DiffcpProgram:
    """min c'x + t with 1/2 x'Qx <= t as one more second-order cone.

    Args:
        pattern: Structure of the program; every variable in Q has a positive definite part in it.
        values: Its data.
        tolerance: Of the solver.
    """

    def __init__(self, pattern: ConePattern, values: ConeValues, tolerance: float) -> None:
        self._pattern = pattern
        self._tolerance = tolerance
        upper = pattern.q.matrix(values.q)
        used = np.flatnonzero(upper.diagonal())
        full = (upper + sp.triu(upper, k=1).T).toarray()[np.ix_(used, used)]
        root = np.zeros((used.size, pattern.n))
        root[:, used] = np.linalg.cholesky(full).T
        time_column = sp.csr_array(([-1.0], ([0], [pattern.n])), shape=(1, pattern.n + 1))
        # |(sqrt(2) R x, t - 1)| <= t + 1 with Q = R'R
        parts = [
            _widened(sp.vstack([pattern.a.matrix(values.a), pattern.g.matrix(values.g)])),
            time_column,
            _widened(sp.csr_array(-np.sqrt(2.0) * root)),
            time_column,
        ]
        self._matrix = sp.csc_matrix(sp.vstack(parts))
        self._right = np.concatenate([values.b, values.h, [1.0], np.zeros(used.size), [-1.0]])
        self._cost = np.append(values.c, 1.0)
        self._cones = {
            diffcp.ZERO: pattern.n_equalities,
            diffcp.POS: pattern.n_nonnegative,
            diffcp.SOC: [*pattern.soc_dims, used.size + 2],
        }
        self._answer: Any = None
        self._gradient: Any = None

    def solve(self, mode: str) -> None:
        """Solve and set up the derivative in one of `MODES`."""
        self._answer = diffcp.solve_and_derivative(
            self._matrix,
            self._right,
            self._cost,
            self._cones,
            mode=mode,
            solve_method="Clarabel",
            tol_gap_abs=self._tolerance,
            tol_gap_rel=self._tolerance,
            tol_feas=self._tolerance,
            verbose=False,
        )

    def adjoint(self, seed: Array) -> None:
        """Compute the gradient of seed'x, after `solve`."""
        _, y, s, _, adjoint = self._answer
        self._gradient = adjoint(np.append(seed, 0.0), np.zeros_like(y), np.zeros_like(s))

    def derivative_along(self, direction: ConeValues) -> float:
        """That gradient along a change of c, A, b, G, h."""
        matrix, right, cost = self._gradient
        pattern = self._pattern
        rows = pattern.n_equalities + pattern.n_cone_rows
        change = sp.vstack([pattern.a.matrix(direction.a), pattern.g.matrix(direction.g)])
        return float(
            sp.csc_matrix(matrix)[:rows, : pattern.n].multiply(change).sum()
            + right[:rows] @ np.concatenate([direction.b, direction.h])
            + cost[: pattern.n] @ direction.c
        )


def _widened(matrix: Any) -> Any:
    """The matrix with one more column of zeros."""
    return sp.hstack([matrix, sp.csr_array((matrix.shape[0], 1))])

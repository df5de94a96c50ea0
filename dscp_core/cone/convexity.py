"""Whether the cost of a cone program is convex: its matrix Q positive semidefinite."""

from __future__ import annotations

import numpy as np
import qdldl
import scipy.sparse as sp

from dscp_core.cone.program import ConePattern, ConeValues, FloatArray
from dscp_core.errors import InvalidInputError

# A negative eigenvalue down to minus this is rounding, in units of the variables' own curvature.
_ROUNDING = 1e-9
# Curvatures below this share of the largest are judged by that: what is left where it cancels.
_LEAST_SHARE = 1e-6


class NotConvexError(InvalidInputError):
    """The matrix of a cost is not positive semidefinite."""


def require_convex(what: str, matrix: FloatArray) -> None:
    """Refuse a symmetric matrix (n, n) that is not positive semidefinite.

    Args:
        what: Its cost, as the message calls it.
        matrix: Its Hessian.

    Raises:
        NotConvexError: With the least eigenvalue.
    """
    least = least_eigenvalue(matrix)
    if least < -_ROUNDING * float(np.abs(matrix).max(initial=0.0)):
        raise NotConvexError(
            what, f"least eigenvalue {least:.3g} of its Hessian", "convex, none below 0"
        )


def least_eigenvalue(matrix: FloatArray) -> float:
    """Least eigenvalue of a symmetric matrix (n, n), that of its zero rows and columns included."""
    support = np.flatnonzero(np.abs(matrix).sum(axis=0))
    if not support.size:
        return 0.0
    least = float(np.linalg.eigvalsh(matrix[np.ix_(support, support)])[0])
    return least if support.size == len(matrix) else min(least, 0.0)


class ConvexityCheck:
    """Checks Q of the programs of one pattern; its ordering and symbolic work are done once."""

    def __init__(self, pattern: ConePattern) -> None:
        self._pattern = pattern
        rows, columns = pattern.q.indices, pattern.q.columns
        self._diagonal = np.flatnonzero(rows == columns)
        self._variables = rows[self._diagonal]
        self._off_diagonal = np.flatnonzero(rows != columns)
        coupled = np.unique([rows[self._off_diagonal], columns[self._off_diagonal]])
        position = np.full(pattern.n, -1)
        position[coupled] = np.arange(coupled.size)
        # Only variables with products between them need a factorisation.
        self._entries = np.flatnonzero(position[rows] >= 0)
        self._rows, self._columns = rows[self._entries], columns[self._entries]
        self._own = np.flatnonzero(self._rows == self._columns)
        self._matrix = sp.csc_matrix(
            (
                np.where(self._rows == self._columns, 1.0, 0.0),
                (position[self._rows], position[self._columns]),
            ),
            shape=(coupled.size, coupled.size),
        )
        self._factor = qdldl.Solver(self._matrix, upper=True) if coupled.size else None

    def check(self, values: ConeValues) -> None:
        """Refuse a matrix with negative curvature beyond rounding.

        Raises:
            NotConvexError: With its least eigenvalue.
        """
        own = values.q[self._diagonal]
        largest = float(np.abs(values.q).max(initial=0.0))
        if largest == 0.0:
            return
        sizes = np.ones(self._pattern.n)
        sizes[self._variables] = np.maximum(np.abs(own), _LEAST_SHARE * largest)
        if np.any(own < -_ROUNDING * sizes[self._variables]) or not self._factorable(values, sizes):
            upper = self._pattern.q.matrix(values.q).toarray()
            least = least_eigenvalue(upper + np.triu(upper, 1).T)
            raise NotConvexError("Q", f"least eigenvalue {least:.3g}", "positive semidefinite")

    def _factorable(self, values: ConeValues, sizes: FloatArray) -> bool:
        """Whether the scaled matrix, shifted by what is rounding, has positive pivots only."""
        if self._factor is None or not np.any(values.q[self._off_diagonal]):
            return True
        scaled = values.q[self._entries] / np.sqrt(sizes[self._rows] * sizes[self._columns])
        scaled[self._own] += _ROUNDING
        self._matrix.data = scaled
        self._factor.update(self._matrix, upper=True)
        return bool(np.all(self._factor.factors()[1] > 0.0))

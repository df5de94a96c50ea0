"""Whether the cost of a cone program is convex: its matrix Q positive semidefinite."""

from __future__ import annotations

import numpy as np
import qdldl
import scipy.linalg.lapack
import scipy.sparse as sp
import scipy.sparse.linalg

from dscp_core.cone.program import ConePattern, ConeValues, FloatArray
from dscp_core.errors import InvalidInputError

# A negative eigenvalue down to minus this is rounding, in units of the variables' own curvature.
_ROUNDING = 1e-9
# Curvatures below this share of the largest are judged by that: what is left where it cancels.
_LEAST_SHARE = 1e-6
# Variables up to which the offending eigenvalue is found in a dense matrix.
_MOST_DENSE = 2000
# Up to this many superdiagonals a banded factorisation is several times faster than a sparse one.
_WIDEST_BAND = 40


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
        # Only variables with products between them need a factorisation.
        products = rows != columns
        coupled = np.unique([rows[products], columns[products]])
        position = np.full(pattern.n, -1)
        position[coupled] = np.arange(coupled.size)
        self._entries = np.flatnonzero(position[rows] >= 0)
        self._rows, self._columns = (position[part[self._entries]] for part in (rows, columns))
        self._own = np.flatnonzero(self._rows == self._columns)
        self._matrix = sp.csc_matrix(
            (np.where(self._rows == self._columns, 1.0, 0.0), (self._rows, self._columns)),
            shape=(coupled.size, coupled.size),
        )
        self._band = int((self._columns - self._rows).max(initial=0))
        banded = self._band <= _WIDEST_BAND
        self._factor = None if banded else qdldl.Solver(self._matrix, upper=True)

    def check(self, values: ConeValues) -> None:
        """Refuse a matrix with negative curvature beyond rounding.

        Raises:
            NotConvexError: With its least eigenvalue.
        """
        if not values.q.size:
            return
        least_size = _LEAST_SHARE * float(np.abs(values.q).max())
        least_own = float(values.q[self._diagonal].min())
        if least_own < -_ROUNDING * least_size or not self._factorable(values.q, least_size):
            upper = self._pattern.q.matrix(values.q)
            full = upper + sp.triu(upper, 1).T
            if self._pattern.n <= _MOST_DENSE:
                least = least_eigenvalue(full.toarray())
            else:
                found = scipy.sparse.linalg.eigsh(full, 1, which="SA", return_eigenvectors=False)
                least = float(found[0])
            raise NotConvexError("Q", f"least eigenvalue {least:.3g}", "positive semidefinite")

    def _factorable(self, q: FloatArray, least_size: float) -> bool:
        """Whether the scaled matrix, shifted by what is rounding, has positive pivots only."""
        if self._band == 0 or least_size == 0.0:
            return True
        scaled = q[self._entries]
        root = np.sqrt(np.maximum(np.abs(scaled[self._own]), least_size))
        scaled /= root[self._rows]
        scaled /= root[self._columns]
        scaled[self._own] += _ROUNDING
        if self._factor is None:
            band = np.zeros((self._band + 1, root.size), order="F")
            band[self._band + self._rows - self._columns, self._columns] = scaled
            return bool(scipy.linalg.lapack.dpbtrf(band, overwrite_ab=True)[1] == 0)
        self._matrix.data = scaled
        self._factor.update(self._matrix, upper=True)
        return bool(self._factor.factors()[1].min() > 0.0)

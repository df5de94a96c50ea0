"""Second-order cone programs with a fixed sparsity pattern, and their solutions.

The standard form (eq. P2 of the paper, with every cone written as rows of G and h) is

    minimise    1/2 z'Qz + c'z
    subject to  A z = b
                G z + s = h,   s in R_+^{n_nonnegative} x SOC(d_1) x SOC(d_2) x ...

where SOC(d) = {(s0, s1) : s0 >= |s1|}.  Cone i of the paper, g_i = (a_i'z + b_i, G_i z + h_i),
is the block of d_i rows whose first row of G is -a_i' with h entry b_i, and whose other rows
are -G_i with h entries h_i, so that its slack is g_i itself.

The Lagrangian is 1/2 z'Qz + c'z + nu'(Az - b) + y'(Gz + s - h) with y in the (self-dual) cone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray

from dscp_core.errors import InvalidInputError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int32]
Matrix = Any  # scipy sparse array or matrix, or anything np.asarray takes


@dataclass(frozen=True, eq=False)
class CscPattern:
    """Positions of the stored entries of a sparse matrix, column by column.

    Attributes:
        n_rows: Number of rows.
        n_cols: Number of columns.
        indptr: (n_cols + 1,) start of each column in `indices`.
        indices: (nnz,) row of each entry, increasing within a column.

    Raises:
        InvalidInputError: On construction, if the arrays describe no such matrix.
    """

    n_rows: int
    n_cols: int
    indptr: IntArray
    indices: IntArray

    def __post_init__(self) -> None:
        for name in ("indptr", "indices"):
            array = np.ascontiguousarray(getattr(self, name), dtype=np.int32)
            object.__setattr__(self, name, array)
        if self.indptr.shape != (self.n_cols + 1,) or self.indptr[0] != 0:
            raise InvalidInputError(
                "indptr", self.indptr, f"{self.n_cols + 1} entries that start at 0"
            )
        if np.any(np.diff(self.indptr) < 0) or self.indptr[-1] != self.indices.size:
            raise InvalidInputError(
                "indptr", self.indptr, f"nondecreasing, ending at nnz = {self.indices.size}"
            )
        if self.nnz and (self.indices.min() < 0 or self.indices.max() >= self.n_rows):
            raise InvalidInputError("indices", self.indices, f"rows in [0, {self.n_rows})")
        same_column = np.diff(self.columns) == 0
        if np.any(np.diff(self.indices)[same_column] <= 0):
            raise InvalidInputError(
                "indices", self.indices, "strictly increasing rows within each column"
            )

    @classmethod
    def from_matrix(cls, matrix: sp.csc_array) -> CscPattern:
        """Pattern of a CSC matrix with sorted indices; explicit zeros are kept as entries."""
        n_rows, n_cols = matrix.shape
        return cls(n_rows, n_cols, matrix.indptr, matrix.indices)

    @property
    def nnz(self) -> int:
        """Number of stored entries."""
        return int(self.indices.size)

    @cached_property
    def columns(self) -> IntArray:
        """(nnz,) column of each stored entry."""
        return np.repeat(np.arange(self.n_cols, dtype=np.int32), np.diff(self.indptr))

    def matrix(self, values: FloatArray) -> sp.csc_array:
        """CSC array with the (nnz,) values in this pattern (shares memory, no copy)."""
        return sp.csc_array(
            (values, self.indices, self.indptr), shape=(self.n_rows, self.n_cols), copy=False
        )


@dataclass(frozen=True, eq=False)
class ConePattern:
    """Fixed structure of a cone program; values change, this does not.

    Attributes:
        n: Number of variables.
        q: (n x n) upper triangle of Q, diagonal included.
        a: (p x n) equality rows.
        g: (m x n) cone rows: nonnegative rows first, then the second-order cones in order.
        n_nonnegative: Number of leading rows of G with s >= 0.
        soc_dims: Dimension of each second-order cone, each at least 2.

    Raises:
        InvalidInputError: On construction, if the parts do not fit together or the pattern
            of Q cannot be positive semidefinite (an off-diagonal entry without its diagonal).
    """

    n: int
    q: CscPattern
    a: CscPattern
    g: CscPattern
    n_nonnegative: int
    soc_dims: tuple[int, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "soc_dims", tuple(int(d) for d in self.soc_dims))
        if self.n < 1:
            raise InvalidInputError("n", self.n, "at least one variable")
        if (self.q.n_rows, self.q.n_cols) != (self.n, self.n):
            raise InvalidInputError(
                "q", (self.q.n_rows, self.q.n_cols), f"shape ({self.n}, {self.n})"
            )
        for name, part in (("a", self.a), ("g", self.g)):
            if part.n_cols != self.n:
                raise InvalidInputError(f"{name}.n_cols", part.n_cols, f"n = {self.n} columns")
        if np.any(self.q.indices > self.q.columns):
            raise InvalidInputError("q", "an entry below the diagonal", "upper triangle only")
        off_diagonal = self.q.indices != self.q.columns
        has_diagonal = np.zeros(self.n, dtype=bool)
        has_diagonal[self.q.indices[~off_diagonal]] = True
        needed = np.concatenate([self.q.indices[off_diagonal], self.q.columns[off_diagonal]])
        missing = np.unique(needed[~has_diagonal[needed]])
        if missing.size:
            raise InvalidInputError(
                "q",
                f"off-diagonal entry without diagonal entry at {missing[:5].tolist()}",
                "positive semidefinite structure",
            )
        if self.n_nonnegative < 0:
            raise InvalidInputError("n_nonnegative", self.n_nonnegative, "[0, inf)")
        for i, dim in enumerate(self.soc_dims):
            if dim < 2:
                raise InvalidInputError(f"soc_dims[{i}]", dim, "[2, inf)")
        rows = self.n_nonnegative + sum(self.soc_dims)
        if rows != self.g.n_rows:
            raise InvalidInputError(
                "n_nonnegative + sum(soc_dims)", rows, f"= {self.g.n_rows} rows of g"
            )

    @property
    def n_equalities(self) -> int:
        """Number p of equality rows."""
        return self.a.n_rows

    @property
    def n_cone_rows(self) -> int:
        """Number m of rows of G."""
        return self.g.n_rows

    @cached_property
    def soc_starts(self) -> NDArray[np.intp]:
        """(n_soc,) row of G where each second-order cone starts."""
        sizes = np.asarray((self.n_nonnegative, *self.soc_dims), dtype=np.intp)
        return np.asarray(np.cumsum(sizes)[:-1], dtype=np.intp)

    @cached_property
    def flat_offsets(self) -> tuple[int, ...]:
        """Bounds of q, c, a, b, g, h in one flat vector of all values (7 numbers)."""
        sizes = (
            self.q.nnz,
            self.n,
            self.a.nnz,
            self.n_equalities,
            self.g.nnz,
            self.n_cone_rows,
        )
        return (0, *np.cumsum(sizes).tolist())

    @cached_property
    def stacked(self) -> CscPattern:
        """(p + m, n) pattern of A above G."""
        rows = np.concatenate((self.a.indices, self.n_equalities + self.g.indices))
        columns = np.concatenate((self.a.columns, self.g.columns))
        order = self.stacked_order
        indptr = np.searchsorted(columns[order], np.arange(self.n + 1))
        return CscPattern(
            self.n_equalities + self.n_cone_rows, self.n, indptr.astype(np.int32), rows[order]
        )

    @cached_property
    def stacked_order(self) -> NDArray[np.intp]:
        """Values of `stacked` are concatenate((a, g))[stacked_order]."""
        # Column by column, and within a column the entries of A come first already.
        return np.argsort(np.concatenate((self.a.columns, self.g.columns)), kind="stable")

    @property
    def n_values(self) -> int:
        """Length of the flat vector of all values."""
        return self.flat_offsets[-1]


@dataclass
class ConeValues:
    """Values of a cone program, aligned with the stored entries of its pattern.

    Also holds derivatives with respect to those values: an entry q of an off-diagonal position
    stands for both symmetric halves of Q.

    Attributes:
        q: (nnz of pattern.q,) upper triangle of Q.
        c: (n,) linear cost.
        a: (nnz of pattern.a,) equality matrix.
        b: (p,) equality right-hand side.
        g: (nnz of pattern.g,) cone matrix.
        h: (m,) cone right-hand side.
    """

    q: FloatArray
    c: FloatArray
    a: FloatArray
    b: FloatArray
    g: FloatArray
    h: FloatArray

    FIELDS: ClassVar[tuple[str, ...]] = ("q", "c", "a", "b", "g", "h")

    @staticmethod
    def from_flat(pattern: ConePattern, flat: FloatArray) -> ConeValues:
        """Views into one (n_values,) array in the order q, c, a, b, g, h.

        Raises:
            InvalidInputError: If the length does not fit the pattern.
        """
        if flat.shape != (pattern.n_values,):
            raise InvalidInputError("flat.shape", flat.shape, f"({pattern.n_values},)")
        bounds = pattern.flat_offsets
        return ConeValues(*(flat[bounds[i] : bounds[i + 1]] for i in range(6)))

    def to_flat(self) -> FloatArray:
        """New array of all values in the order q, c, a, b, g, h."""
        return np.concatenate((self.q, self.c, self.a, self.b, self.g, self.h))

    def copy(self) -> ConeValues:
        """Independent copy."""
        return ConeValues(*(getattr(self, name).copy() for name in self.FIELDS))

    def check(self, pattern: ConePattern) -> None:
        """Cheap check before use: sizes fit the pattern, all numbers are finite float64.

        Raises:
            InvalidInputError: Naming the first array and entry that offends.
        """
        bounds = pattern.flat_offsets
        for i, name in enumerate(self.FIELDS):
            array = getattr(self, name)
            expected = (bounds[i + 1] - bounds[i],)
            if array.shape != expected:
                raise InvalidInputError(f"{name}.shape", array.shape, str(expected))
            if array.dtype != np.float64:
                raise InvalidInputError(f"{name}.dtype", array.dtype, "float64")
            if not np.isfinite(array).all():
                first = int(np.flatnonzero(~np.isfinite(array))[0])
                raise InvalidInputError(f"{name}[{first}]", float(array[first]), "finite")


@dataclass(frozen=True, eq=False)
class ConeProgram:
    """A pattern with one set of values."""

    pattern: ConePattern
    values: ConeValues

    def __post_init__(self) -> None:
        self.values.check(self.pattern)

    @staticmethod
    def from_matrices(
        Q: Matrix,
        c: ArrayLike,
        A: Matrix = None,
        b: ArrayLike | None = None,
        G: Matrix = None,
        h: ArrayLike | None = None,
        n_nonnegative: int | None = None,
        soc_dims: Sequence[int] = (),
    ) -> ConeProgram:
        """Build pattern and values from dense or scipy sparse matrices.

        Args:
            Q: (n, n) symmetric positive semidefinite, full (both triangles), or None for zero.
            c: (n,) linear cost.
            A: (p, n) equality matrix, or None for no equalities.
            b: (p,) equality right-hand side, or None.
            G: (m, n) cone matrix, or None for no cones.
            h: (m,) cone right-hand side, or None.
            n_nonnegative: Number of leading rows of G with s >= 0; None for all but the cones'.
            soc_dims: Dimension of each second-order cone.

        Stored zeros of sparse input stay part of the pattern; zeros of dense input do not.

        Raises:
            InvalidInputError: Shapes, non-finite numbers, asymmetric or indefinite structure
                of Q, cone sizes.
        """
        b, h = ([] if right is None else right for right in (b, h))
        cost = np.array(c, dtype=np.float64, ndmin=1)
        if cost.ndim != 1:
            raise InvalidInputError("c.shape", cost.shape, "one dimension")
        n = cost.size
        full_q = _as_csc("Q", Q, (n, n), n)
        a = _as_csc("A", A, (0, n), n)
        g = _as_csc("G", G, (0, n), n)
        if full_q.shape != (n, n):
            raise InvalidInputError("Q.shape", full_q.shape, f"({n}, {n})")
        asymmetry = abs(full_q - full_q.T)
        scale = abs(full_q).max() if full_q.nnz else 0.0
        if asymmetry.nnz and asymmetry.max() > 1e-12 * scale:
            raise InvalidInputError("Q", f"asymmetry {asymmetry.max():.3e}", "symmetric")
        q = sp.csc_array(sp.triu(full_q, format="csc"))
        q.sort_indices()
        pattern = ConePattern(
            n,
            CscPattern.from_matrix(q),
            CscPattern.from_matrix(a),
            CscPattern.from_matrix(g),
            g.shape[0] - sum(soc_dims) if n_nonnegative is None else n_nonnegative,
            tuple(soc_dims),
        )
        values = ConeValues(
            q.data,
            cost,
            a.data,
            np.array(b, dtype=np.float64, ndmin=1),
            g.data,
            np.array(h, dtype=np.float64, ndmin=1),
        )
        return ConeProgram(pattern, values)


def _as_csc(name: str, matrix: Matrix, if_none: tuple[int, int], n: int) -> sp.csc_array:
    csc = sp.csc_array(if_none if matrix is None else matrix, dtype=np.float64, copy=True)
    if csc.shape[1] != n:
        raise InvalidInputError(f"{name}.shape", csc.shape, f"{n} columns")
    csc.sum_duplicates()
    return csc


class SolveStatus(Enum):
    """What a solver found out about a cone program."""

    SOLVED = "solved"
    INFEASIBLE = "infeasible"
    UNBOUNDED = "unbounded"
    ITERATION_LIMIT = "iteration limit"
    TIME_LIMIT = "time limit"
    NUMERICAL_FAILURE = "numerical failure"


@dataclass(frozen=True, eq=False)
class ConeSolution:
    """Answer of a cone solver; for a status other than SOLVED the point is its last iterate.

    Attributes:
        z: (n,) primal point.
        equality_dual: (p,) nu.
        cone_dual: (m,) y, inside the cone.
        slack: (m,) s, inside the cone.
        status: What the solver found.
        solver: Name of the backend that answered.
        iterations: Its interior-point iterations.
        seconds: Wall time of the update of the data and the solve [s].
        setup_seconds: Wall time of a symbolic set-up that this call needed, else zero [s].
        primal_residual: Largest violation of Az = b, Gz + s = h, s in K, over the largest term.
        dual_residual: Largest violation of stationarity and y in K, over the largest term.
        gap: |z'Qz + c'z + b'nu + h'y| over the larger of 1 and the objectives.
        message: In words, where the status needs them.
        attempts: Failed earlier attempts of a chain, in order.
    """

    z: FloatArray
    equality_dual: FloatArray
    cone_dual: FloatArray
    slack: FloatArray
    status: SolveStatus
    solver: str
    iterations: int
    seconds: float
    primal_residual: float
    dual_residual: float
    gap: float
    message: str = ""
    setup_seconds: float = 0.0
    attempts: tuple[ConeSolution, ...] = field(default=())

"""Residuals of a cone program at a point, computed the same way whatever solver gave the point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from dscp_core.cone.program import ConePattern, ConeValues, FloatArray


@dataclass(frozen=True)
class Residuals:
    """Relative residuals; all are infinite when the point is not finite.

    Attributes:
        primal: Largest violation of Az = b, Gz + s = h, s in K, over the largest term.
        dual: Largest violation of stationarity and y in K, over the largest term.
        gap: |z'Qz + c'z + b'nu + h'y| over the larger of 1 and the two objectives.
    """

    primal: float
    dual: float
    gap: float

    @property
    def worst(self) -> float:
        """Largest of the three."""
        return max(self.primal, self.dual, self.gap)


def soc_norms(pattern: ConePattern, x: FloatArray) -> FloatArray:
    """(n_soc,) Euclidean norm |x1| of the tail of each second-order cone block of x (m,)."""
    if not pattern.soc_dims:
        return np.zeros(0)
    squares = x[pattern.n_nonnegative :] ** 2
    starts = pattern.soc_starts - pattern.n_nonnegative
    squares[starts] = 0.0
    return np.asarray(np.sqrt(np.add.reduceat(squares, starts)))


def cone_violation(pattern: ConePattern, x: FloatArray) -> float:
    """How far x (m,) is outside the cone: the largest of -x_j and |x1| - x0, or zero."""
    worst = 0.0
    if pattern.n_nonnegative:
        worst = max(worst, -float(x[: pattern.n_nonnegative].min()))
    if pattern.soc_dims:
        worst = max(worst, float((soc_norms(pattern, x) - x[pattern.soc_starts]).max()))
    return worst


@dataclass(frozen=True)
class Products:
    """Matrix products at a point, from which every residual follows.

    Attributes:
        q_z: (n,) Q z.
        k_z: (p + m,) [A; G] z.
        k_duals: (n,) [A; G]'(nu, y).
    """

    q_z: FloatArray
    k_z: FloatArray
    k_duals: FloatArray


class BoundMatrices:
    """Sparse matrices of a pattern whose values are exchanged in place, without set-up cost."""

    def __init__(self, pattern: ConePattern) -> None:
        self._pattern = pattern
        upper = pattern.q.matrix(np.arange(pattern.q.nnz, dtype=np.float64) + 1.0)
        full = sp.csc_array(upper + sp.triu(upper, k=1).T)
        self._q_order = np.rint(full.data).astype(np.intp) - 1
        self._q = full
        stacked = pattern.stacked
        self._k = stacked.matrix(np.zeros(stacked.nnz))
        self._k_transposed = sp.csr_array(
            (self._k.data, stacked.indices, stacked.indptr),
            shape=(stacked.n_cols, stacked.n_rows),
            copy=False,
        )

    def bind(self, values: ConeValues) -> None:
        """Make all later products use these values (a snapshot is taken)."""
        self._q.data = values.q[self._q_order]
        data = np.concatenate((values.a, values.g))[self._pattern.stacked_order]
        self._k.data = data
        self._k_transposed.data = data

    @property
    def stacked_values(self) -> FloatArray:
        """Values of [A; G] in the order of `ConePattern.stacked`."""
        return np.asarray(self._k.data)

    def products(self, z: FloatArray, duals: FloatArray) -> Products:
        """All products at a point: z (n,), duals (p + m,) nu followed by y."""
        return Products(self._q @ z, self._k @ z, self._k_transposed @ duals)

    def q_times(self, z: FloatArray) -> FloatArray:
        """(n,) Q z with the full symmetric Q."""
        return np.asarray(self._q @ z)

    def constraints_times(self, z: FloatArray) -> FloatArray:
        """(p + m,) [A; G] z."""
        return np.asarray(self._k @ z)

    def constraints_transposed_times(self, dual: FloatArray) -> FloatArray:
        """(n,) [A; G]' dual."""
        return np.asarray(self._k_transposed @ dual)


def residuals(
    pattern: ConePattern,
    values: ConeValues,
    products: Products,
    z: FloatArray,
    duals: FloatArray,
    slack: FloatArray,
) -> Residuals:
    """Relative residuals of the optimality conditions.

    Args:
        pattern: Structure of the program.
        values: Data of the program.
        products: At z and duals.
        z: (n,) primal point.
        duals: (p + m,) nu followed by y.
        slack: (m,) s.
    """
    p = pattern.n_equalities
    q_z, k_z, k_duals = products.q_z, products.k_z, products.k_duals
    right = np.concatenate((values.b, values.h))
    defect = k_z - right
    defect[p:] += slack
    primal_scale = max(1.0, largest_entry(right, k_z, slack))
    dual_scale = max(1.0, largest_entry(q_z, values.c, k_duals))
    stationarity = q_z + values.c + k_duals
    primal = max(largest_entry(defect), cone_violation(pattern, slack)) / primal_scale
    dual = max(largest_entry(stationarity), cone_violation(pattern, duals[p:])) / dual_scale
    quadratic = float(z @ q_z)
    linear = float(values.c @ z)
    support = float(right @ duals)
    objectives = max(1.0, abs(0.5 * quadratic + linear), abs(0.5 * quadratic + support))
    gap = abs(quadratic + linear + support) / objectives
    if not np.isfinite(primal + dual + gap):
        return Residuals(np.inf, np.inf, np.inf)
    return Residuals(primal, dual, gap)


def infeasibility_certificate(
    pattern: ConePattern, matrices: BoundMatrices, values: ConeValues, duals: FloatArray
) -> float:
    """Quality of (nu, y) as a Farkas certificate: any feasible z has |z|_1 >= 1 / result.

    With b'nu + h'y = -1 and y in K, a feasible z satisfies z'(A'nu + G'y) <= -1; the result is
    the largest entry of |A'nu + G'y|, infinite if (nu, y) is no certificate at all.
    """
    p = pattern.n_equalities
    value = -float(values.b @ duals[:p] + values.h @ duals[p:])
    if not (np.isfinite(duals).all() and value > 0.0):
        return np.inf
    ray = duals / value
    if cone_violation(pattern, ray[p:]) > 1e-9 * largest_entry(ray[p:]):
        return np.inf
    return largest_entry(matrices.constraints_transposed_times(ray))


def unboundedness_certificate(
    pattern: ConePattern, matrices: BoundMatrices, values: ConeValues, z: FloatArray
) -> float:
    """Quality of z as a direction of unbounded descent with c'z = -1.

    The result is the largest violation of Qz = 0, Az = 0, -Gz in K, relative to the largest
    entry of z; infinite if c'z >= 0.
    """
    value = -float(values.c @ z)
    if not (np.isfinite(z).all() and value > 0.0):
        return np.inf
    ray = z / value
    k_ray = matrices.constraints_times(ray)
    p = pattern.n_equalities
    violation = max(
        largest_entry(matrices.q_times(ray), k_ray[:p]), cone_violation(pattern, -k_ray[p:])
    )
    return violation / max(1.0, largest_entry(ray))


def largest_entry(*arrays: FloatArray) -> float:
    """Largest absolute entry of all arrays together, zero if they are empty."""
    joined = arrays[0] if len(arrays) == 1 else np.concatenate(arrays)
    return float(np.abs(joined).max(initial=0.0))

"""Derivatives of a cone program's solution with respect to all of its data.

The optimality conditions of the active set are differentiated (eq. KKT1): with H the KKT matrix
and F the conditions, H dx = -dF for a change of data (tangent), and for a loss L(z) one solve
H w = (dL/dz, 0, 0) gives dL = -w'dF for every change of data at once (adjoint, eq. KKT2).

In the rows of G and h everything collapses to four outer products.  With y the cone dual, and t
the vector with w_eta in active nonnegative rows, w_lambda (1, -u) + (0, lambda_0 (I - u u')
G1 w_z / |g1|) in the rows of a cone on its boundary, w_eta in those of a cone at its apex,

    dL/dQ = -w_z z'   dL/dc = -w_z   dL/dA = -(nu w_z' + w_nu z')   dL/db = w_nu
    dL/dG = -(y w_z' + t z')         dL/dh = t

(the signs of dL/dG_0+ and dL/da_i printed in eq. d2 differ from this and are misprints).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dscp_core.cone.derivative.active_set import ConeRows, IndexArray
from dscp_core.cone.derivative.kkt import KktMatrix
from dscp_core.cone.derivative.polish import KktPoint
from dscp_core.cone.derivative.verdict import GradientVerdict, Margins
from dscp_core.cone.program import ConePattern, ConeSolution, ConeValues, FloatArray
from dscp_core.cone.residuals import BoundMatrices
from dscp_core.errors import InvalidInputError


class EntryIndex:
    """Rows and columns of the stored entries of Q, A and G, ready for indexing."""

    def __init__(self, pattern: ConePattern) -> None:
        self.q_rows: IndexArray = pattern.q.indices.astype(np.intp)
        self.q_columns: IndexArray = pattern.q.columns.astype(np.intp)
        self.q_off_diagonal: IndexArray = np.flatnonzero(self.q_rows != self.q_columns)
        self.a_rows: IndexArray = pattern.a.indices.astype(np.intp)
        self.a_columns: IndexArray = pattern.a.columns.astype(np.intp)
        self.g_rows: IndexArray = pattern.g.indices.astype(np.intp)
        self.g_columns: IndexArray = pattern.g.columns.astype(np.intp)


class KktWorkspace:
    """Matrices of one pattern that all linearisations of a system share.

    Args:
        pattern: Structure of the programs.
        regularisation: See `KktMatrix`.
        max_refinements: See `KktMatrix`.
    """

    def __init__(self, pattern: ConePattern, regularisation: float, max_refinements: int) -> None:
        self.pattern = pattern
        self.rows = ConeRows(pattern)
        self.index = EntryIndex(pattern)
        self.matrices = BoundMatrices(pattern)
        self.matrix = KktMatrix(pattern, self.rows, regularisation, max_refinements)
        self._owner: KktPoint | None = None

    def bind(self, values: ConeValues) -> None:
        """Take the data of another program; the factorisation is nobody's from now on."""
        self._owner = None
        self.matrices.bind(values)

    def use(self, values: ConeValues, point: KktPoint) -> None:
        """Make matrices and factorisation those of this point, unless they are already."""
        if self._owner is point:
            return
        self.bind(values)
        self.matrix.update(values, point.active, point.frame, point.eta)
        self._owner = point


class Linearisation:
    """Derivatives of a program's solution at one point, forward and reverse.

    Attributes:
        solution: The point: polished if the polish succeeded, else the solver's.
        margins: Distance of every constraint from changing sides.
    """

    def __init__(
        self,
        workspace: KktWorkspace,
        values: ConeValues,
        point: KktPoint,
        solution: ConeSolution,
        verdict: GradientVerdict,
        found: Margins,
        *,
        refinement_tolerance: float,
        solve_limit: float,
    ) -> None:
        self._workspace = workspace
        self._refinement_tolerance = refinement_tolerance
        self._solve_limit = solve_limit
        self._values = values
        self._point = point
        self._verdict = verdict
        self.solution = solution
        self.margins = found

    @property
    def z(self) -> FloatArray:
        """(n,) primal point."""
        return self.solution.z

    @property
    def equality_dual(self) -> FloatArray:
        """(p,) nu."""
        return self.solution.equality_dual

    @property
    def cone_dual(self) -> FloatArray:
        """(m,) y."""
        return self.solution.cone_dual

    @property
    def verdict(self) -> GradientVerdict:
        """How far the derivatives can be trusted; read it after `adjoint` or `tangent`.

        A solve of theirs that does not reach its accuracy adds a reason.
        """
        return self._verdict

    def adjoint(self, dz: FloatArray) -> ConeValues:
        """Reverse mode: dL/d(every value) from dL/dz (eq. KKT2).

        Args:
            dz: (n,) derivative of a scalar L with respect to z.

        Returns:
            dL/d(value) for every value; an upper-triangle entry of Q stands for both halves.

        Raises:
            InvalidInputError: If dz has the wrong size or is not finite.
        """
        pattern, rows, point = self._workspace.pattern, self._workspace.rows, self._point
        if dz.shape != (pattern.n,):
            raise InvalidInputError("dz.shape", dz.shape, f"({pattern.n},)")
        if not np.isfinite(dz).all():
            raise InvalidInputError("dz", dz, "finite numbers")
        right = np.zeros(self._workspace.matrix.size)
        right[: pattern.n] = dz
        w_z, w_nu, t = self._solve(right)
        g_w = self._workspace.matrices.constraints_times(w_z)[pattern.n_equalities + rows.tails]
        t[rows.tails] += self._turning(g_w) - self._normal_tail(t[rows.starts])
        z, nu, y = point.z, point.nu, point.y
        index = self._workspace.index
        q = -w_z[index.q_rows] * z[index.q_columns]
        off = index.q_off_diagonal
        q[off] -= z[index.q_rows[off]] * w_z[index.q_columns[off]]
        a_rows, a_columns = index.a_rows, index.a_columns
        g_rows, g_columns = index.g_rows, index.g_columns
        return ConeValues(
            q=q,
            c=-w_z,
            a=-(nu[a_rows] * w_z[a_columns] + w_nu[a_rows] * z[a_columns]),
            b=w_nu,
            g=-(y[g_rows] * w_z[g_columns] + t[g_rows] * z[g_columns]),
            h=t,
        )

    def tangent(self, dvalues: ConeValues) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Forward mode: change of the solution for a change of the data (eq. KKT1).

        Args:
            dvalues: Change of every value; an upper-triangle entry of Q stands for both halves.

        Returns:
            dz (n,), dnu (p,), dy (m,).

        Raises:
            InvalidInputError: If dvalues do not fit the pattern or are not finite.
        """
        return self._tangent(dvalues)[:3]

    def active_set_radius(self, dvalues: ConeValues) -> float:
        """Largest step along a change of data that keeps the active set, to first order.

        Args:
            dvalues: Direction, as in `tangent`.

        Returns:
            The smallest t > 0 at which a multiplier, a slack or the distance of a cone from its
            apex reaches zero; zero if one already has the wrong sign; inf if none ever does.
        """
        _, _, dy, dslack = self._tangent(dvalues)
        rows, point = self._workspace.rows, self._point
        active, frame, n = point.active, point.frame, self._workspace.rows.n_nonnegative
        boundary, apex = active.boundary, active.apex
        inactive = ~(boundary | apex)
        heads, tails = rows.starts, rows.tails
        d_norm = rows.tail_sums(frame.direction * dslack[tails])
        y_norm = rows.tail_norms(point.y)
        safe = np.where(y_norm > 0.0, y_norm, 1.0)
        d_y_norm = rows.tail_sums(point.y[tails] * dy[tails]) / safe
        levels = np.concatenate(
            (
                np.where(active.linear, point.eta[:n], frame.slack[:n]),
                point.eta[heads][boundary],
                frame.tail_norm[boundary],
                frame.margin[inactive],
                (point.y[heads] - y_norm)[apex],
            )
        )
        slopes = np.concatenate(
            (
                np.where(active.linear, dy[:n], dslack[:n]),
                dy[heads][boundary],
                d_norm[boundary],
                (dslack[heads] - d_norm)[inactive],
                (dy[heads] - d_y_norm)[apex],
            )
        )
        falling = slopes < 0.0
        steps = np.maximum(levels[falling], 0.0) / -slopes[falling]
        return float(steps.min(initial=np.inf))

    def _tangent(
        self, dvalues: ConeValues
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """dz, dnu, dy and the change of the slack h - Gz."""
        pattern, rows, point = self._workspace.pattern, self._workspace.rows, self._point
        dvalues.check(pattern)
        n, p, m = pattern.n, pattern.n_equalities, pattern.n_cone_rows
        index, z, nu, y = self._workspace.index, point.z, point.nu, point.y
        dg_z = np.bincount(index.g_rows, dvalues.g * z[index.g_columns], minlength=m) - dvalues.h
        da_z = np.bincount(index.a_rows, dvalues.a * z[index.a_columns], minlength=p) - dvalues.b
        off = index.q_off_diagonal
        q_rows, q_columns = index.q_rows, index.q_columns
        stationarity = (
            np.bincount(q_rows, dvalues.q * z[q_columns], minlength=n)
            + np.bincount(q_columns[off], dvalues.q[off] * z[q_rows[off]], minlength=n)
            + dvalues.c
            + np.bincount(index.a_columns, dvalues.a * nu[index.a_rows], minlength=n)
            + np.bincount(index.g_columns, dvalues.g * y[index.g_rows], minlength=n)
        )
        turn = np.zeros(p + m)
        turn[p + rows.tails] = self._turning(dg_z[rows.tails])
        self._workspace.use(self._values, point)
        stationarity += self._workspace.matrices.constraints_transposed_times(turn)
        active_change = np.where(point.active.rows(rows), dg_z, 0.0)
        normal = rows.tail_sums(point.frame.direction * dg_z[rows.tails])
        active_change[rows.starts] -= np.where(point.active.boundary, normal, 0.0)
        dz, dnu, deta = self._solve(-np.concatenate((stationarity, da_z, active_change)))
        dslack = -(dg_z + self._workspace.matrices.constraints_times(dz)[p:])
        dy = deta
        dy[rows.tails] -= self._normal_tail(dy[rows.starts]) + self._turning(dslack[rows.tails])
        return dz, dnu, dy, dslack

    def _turning(self, tail_change: FloatArray) -> FloatArray:
        """(n_tail,) lambda_0 (I - u u') x / |g1| for cones on their boundary, else zero."""
        rows, point = self._workspace.rows, self._point
        boundary = point.active.boundary
        safe = np.where(boundary, point.frame.tail_norm, 1.0)
        factor = np.where(boundary, point.eta[rows.starts] / safe, 0.0)
        return factor[rows.tail_cone] * point.frame.tangential(tail_change)

    def _normal_tail(self, head_values: FloatArray) -> FloatArray:
        """(n_tail,) u times the (n_soc,) values for cones on their boundary, else zero."""
        rows, point = self._workspace.rows, self._point
        heads = np.where(point.active.boundary, head_values, 0.0)
        return point.frame.direction * heads[rows.tail_cone]

    def _solve(self, right: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Parts (n,), (p,), (m,) of the solution with the KKT matrix; may add to the verdict."""
        self._workspace.use(self._values, self._point)
        x, residual = self._workspace.matrix.solve(right, self._refinement_tolerance)
        limit = self._solve_limit
        if not residual <= limit:
            reason = (
                f"derivative solve leaves a relative residual {residual:.1e}, above {limit:.1e}"
            )
            self._verdict = replace(
                self._verdict, trusted=False, reasons=(*self._verdict.reasons, reason)
            )
        n, p = self._workspace.pattern.n, self._workspace.pattern.n_equalities
        return x[:n], x[n : n + p], x[n + p :]

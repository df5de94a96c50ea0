"""Which constraints of a cone program hold with equality, and the geometry of its cones there.

A nonnegative row is active or not.  A second-order cone has three regular states: inactive
(its slack is strictly inside, its dual zero), on the boundary (slack and dual both on the
boundary, neither zero) and at its apex (slack zero, dual strictly inside).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dscp_core.cone.program import ConePattern, ConeValues, FloatArray
from dscp_core.cone.residuals import Products

BoolArray = NDArray[np.bool_]
IndexArray = NDArray[np.intp]


class ConeRows:
    """Index maps of the rows of G of one pattern.

    Attributes:
        n_rows: Number m of rows of G.
        n_nonnegative: Number of leading nonnegative rows.
        starts: (n_soc,) first row of each second-order cone.
        tails: (n_tail,) all other rows of the second-order cones, in order.
        tail_cone: (n_tail,) number of the cone of each of those rows.
        n_constraints: Number of nonnegative rows and cones.
        constraint: (m,) number of the constraint of each row: rows first, then cones.
    """

    def __init__(self, pattern: ConePattern) -> None:
        self.n_rows = pattern.n_cone_rows
        self.n_nonnegative = pattern.n_nonnegative
        self.starts = pattern.soc_starts
        is_tail = np.ones(self.n_rows, dtype=bool)
        is_tail[: self.n_nonnegative] = False
        is_tail[self.starts] = False
        self.tails: IndexArray = np.flatnonzero(is_tail)
        sizes = np.array(pattern.soc_dims, dtype=np.intp) - 1
        self.tail_cone: IndexArray = np.repeat(np.arange(sizes.size), sizes)
        self.n_constraints = self.n_nonnegative + sizes.size
        self.constraint: IndexArray = np.arange(self.n_rows)
        self.constraint[self.n_nonnegative :] = self.n_nonnegative + np.repeat(
            np.arange(sizes.size), sizes + 1
        )
        self._entry_constraint = self.constraint[pattern.g.indices]
        self._segments = np.cumsum(sizes) - sizes

    def entry_sums(self, entry_values: FloatArray) -> FloatArray:
        """(n_constraints,) sum of one value per stored entry of G over each constraint."""
        return np.bincount(
            self._entry_constraint, entry_values, minlength=self.n_constraints
        ).astype(np.float64, copy=False)

    def tail_sums(self, tail_values: FloatArray) -> FloatArray:
        """(n_soc,) sum of (n_tail,) values over each cone."""
        if not self._segments.size:
            return np.zeros(0)
        return np.asarray(np.add.reduceat(tail_values, self._segments))

    def tail_norms(self, row_values: FloatArray) -> FloatArray:
        """(n_soc,) norm of the tail of each cone's block of (m,) values."""
        tail = row_values[self.tails]
        return np.asarray(np.sqrt(self.tail_sums(tail * tail)))


@dataclass
class ActiveSet:
    """State of every constraint.

    Attributes:
        linear: (n_nonnegative,) nonnegative rows that hold with equality.
        boundary: (n_soc,) second-order cones whose slack is on the boundary, not at the apex.
        apex: (n_soc,) second-order cones whose slack is zero.
    """

    linear: BoolArray
    boundary: BoolArray
    apex: BoolArray

    def key(self) -> bytes:
        """Equal for equal active sets."""
        return self.linear.tobytes() + self.boundary.tobytes() + self.apex.tobytes()

    def rows(self, rows: ConeRows) -> BoolArray:
        """(m,) whether a row carries an unknown multiplier.

        A cone on its boundary has one, kept in its first row; one at its apex has them all.
        """
        carries = np.zeros(rows.n_rows, dtype=bool)
        carries[: rows.n_nonnegative] = self.linear
        carries[rows.starts] = self.boundary | self.apex
        carries[rows.tails] = self.apex[rows.tail_cone]
        return carries


@dataclass
class ConeFrame:
    """Geometry of the slack g = h - Gz of one point.

    Attributes:
        slack: (m,) g.
        tail_norm: (n_soc,) |g1|.
        direction: (n_tail,) g1 / |g1|, zero where |g1| is.
        margin: (n_soc,) g0 - |g1|, the distance of the slack from the boundary times sqrt(2).
    """

    rows: ConeRows
    slack: FloatArray
    tail_norm: FloatArray = field(init=False)
    direction: FloatArray = field(init=False)
    margin: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        rows = self.rows
        tail = self.slack[rows.tails]
        self.tail_norm = np.sqrt(rows.tail_sums(tail * tail))
        safe = np.maximum(self.tail_norm, np.finfo(np.float64).tiny)
        self.direction = tail / safe[rows.tail_cone]
        self.margin = self.slack[rows.starts] - self.tail_norm

    def tangential(self, tail_values: FloatArray) -> FloatArray:
        """(n_tail,) (I - u u') x for each cone, u its direction."""
        along = self.rows.tail_sums(self.direction * tail_values)
        return tail_values - self.direction * along[self.rows.tail_cone]


@dataclass(frozen=True)
class ConstraintScales:
    """Natural sizes of slack and multiplier of each constraint, so that thresholds have no units.

    All arrays are (n_nonnegative + n_soc,): rows first, then cones.

    Attributes:
        slack: |h| + |G||z| of the row, or summed over the rows of the cone; at least 1e-6 of the
            largest one and of 1.
        dual: Multiplier that would balance the largest gradient term of the program.
        local_dual: Multiplier that would balance the gradient terms of the constraint's own
            variables.
    """

    slack: FloatArray
    dual: FloatArray
    local_dual: FloatArray


def constraint_scales(
    pattern: ConePattern,
    rows: ConeRows,
    values: ConeValues,
    products: Products,
    z: FloatArray,
    equality_dual: FloatArray,
    cone_dual: FloatArray,
) -> ConstraintScales:
    """Natural sizes at a point.

    Args:
        pattern: Structure of the program.
        rows: Index maps.
        values: Data of the program.
        products: At z and the duals.
        z: (n,) primal point.
        equality_dual: (p,) nu.
        cone_dual: (m,) y.
    """
    g_columns = pattern.g.columns
    # Terms one by one: what cancels in their sum still limits how small a multiplier can be told.
    # A state without a cost feels its dynamics alone, which cancel where no limit is active.
    force = np.abs(products.q_z) + np.abs(values.c)
    for matrix, entries, dual in (
        (pattern.a, values.a, equality_dual),
        (pattern.g, values.g, cone_dual),
    ):
        terms = np.abs(entries * dual[matrix.indices])
        force += np.bincount(matrix.columns, terms, minlength=pattern.n)
    largest = float(force.max()) or 1.0
    force += 1e-10 * largest  # where nothing acts, any multiplier is large
    size = np.abs(values.g)
    squares = rows.entry_sums(size * size)
    # A constraint without entries can balance nothing: any tiny number keeps it inactive.
    empty = squares == 0.0
    squares[empty] = np.finfo(np.float64).tiny
    slack = rows.entry_sums(size * np.abs(z)[g_columns])
    slack += np.bincount(rows.constraint, np.abs(values.h), minlength=rows.n_constraints)
    # Where h and z are zero the slack has no size of its own.
    floor = 1e-6 * max(1.0, float(slack.max(initial=0.0)))
    dual = largest / np.sqrt(squares)
    local = rows.entry_sums(size * force[g_columns]) / squares
    return ConstraintScales(
        slack=np.maximum(slack, floor), dual=dual, local_dual=np.where(empty, dual, local)
    )


def identify(
    rows: ConeRows, scales: ConstraintScales, slack: FloatArray, dual: FloatArray
) -> ActiveSet:
    """Active set of an interior-point answer: a constraint is active if dual > slack, scaled.

    The paper's thresholds (eq. active1) are absolute; here each constraint is compared with its
    own natural size, which is the same rule for every choice of units.

    Args:
        rows: Index maps.
        scales: Natural sizes.
        slack: (m,) s, inside the cone.
        dual: (m,) y, inside the cone.
    """
    n = rows.n_nonnegative
    linear = dual[:n] * scales.slack[:n] > slack[:n] * scales.local_dual[:n]
    slack_tail, dual_tail = rows.tail_norms(slack), rows.tail_norms(dual)
    slack_head, dual_head = slack[rows.starts], dual[rows.starts]
    slack_scale, dual_scale = scales.slack[n:], scales.local_dual[n:]
    # Complementary pairs of eigenvalues: (g0 - |g1|, y0 + |y1|) and (g0 + |g1|, y0 - |y1|).
    active = (dual_head + dual_tail) * slack_scale > (slack_head - slack_tail) * dual_scale
    apex = active & ((dual_head - dual_tail) * slack_scale > (slack_head + slack_tail) * dual_scale)
    return ActiveSet(linear, active & ~apex, apex)

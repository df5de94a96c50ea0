"""Interior-point steps that tell active from inactive constraints where a solver did not.

A solver stops when products of slack and multiplier reach its tolerance; a constraint whose slack
and multiplier are both small is then still undecided.  A few more steps, with the accurate linear
algebra of `kkt`, decide it.  Every undecided constraint phi(z) <= 0 has a slack s > 0 and a
multiplier eta > 0; Newton's method on phi + s = 0 and s eta = tau couples its row of the KKT
matrix with the diagonal entry -s / eta.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dscp_core.cone.derivative.active_set import ActiveSet, ConeRows, ConstraintScales, IndexArray
from dscp_core.cone.derivative.kkt import KktMatrix
from dscp_core.cone.derivative.polish import KktEvaluator, KktPoint
from dscp_core.cone.program import ConePattern, ConeSolution, ConeValues, FloatArray

# A constraint is decided when scaled multiplier and scaled slack differ by this factor.
_DECIDED = 1e6
_MAX_STEPS = 12
# Relative residual of the linear system of a step.
_STEP_ACCURACY = 1e-10
# Part of the way to the boundary that a step goes.
_FRACTION = 0.995
# Smallest slack and multiplier to start from, relative to the natural size.
_FLOOR = 1e-16


@dataclass
class _Undecided:
    """Undecided constraints.

    Attributes:
        constraints: (k,) their numbers, rows first, then cones.
        rows: (k,) row of G that carries each one's multiplier.
        slack: (k,) s.
        dual: (k,) eta.
        scale: (k,) natural size of the slack over that of the multiplier.
    """

    constraints: IndexArray
    rows: IndexArray
    slack: FloatArray
    dual: FloatArray
    scale: FloatArray

    def ratio(self) -> FloatArray:
        """(k,) scaled multiplier over scaled slack: large when active, small when not."""
        return self.dual / self.slack * self.scale

    @property
    def any_left(self) -> bool:
        ratio = self.ratio()
        return bool(((ratio > 1.0 / _DECIDED) & (ratio < _DECIDED)).any())


class InteriorPhase:
    """Runs interior-point steps; bound to one pattern."""

    def __init__(
        self, pattern: ConePattern, rows: ConeRows, evaluator: KktEvaluator, matrix: KktMatrix
    ) -> None:
        self._pattern = pattern
        self._rows = rows
        self._evaluator = evaluator
        self._matrix = matrix

    def run(
        self,
        values: ConeValues,
        start: KktPoint,
        solution: ConeSolution,
        scales: ConstraintScales,
    ) -> KktPoint:
        """Point with a clearer active set than `start`.

        Args:
            values: Data of the program.
            start: At the solver's point; cones that it puts at their apex stay there.
            solution: Of the solver.
            scales: Natural sizes of the constraints.
        """
        pairs = self._undecided(start, solution, scales)
        eta = start.eta.copy()
        eta[pairs.rows] = pairs.dual
        included = self._active_set(start, pairs.constraints)
        point = self._evaluator.point(values, included, start.z, start.nu, eta, start.products)
        for _ in range(_MAX_STEPS):
            if not pairs.any_left:
                break
            moved = self._step(values, point, pairs)
            if not np.isfinite(moved.defect).all():
                break
            point = moved
        active = self._active_set(start, pairs.constraints[pairs.ratio() > 1.0])
        return self._evaluator.point(values, active, point.z, point.nu, point.eta, point.products)

    def _undecided(
        self, start: KktPoint, solution: ConeSolution, scales: ConstraintScales
    ) -> _Undecided:
        rows, n = self._rows, self._rows.n_nonnegative
        carriers = np.concatenate((np.arange(n), rows.starts))
        slack = solution.slack[carriers]
        slack[n:] -= rows.tail_norms(solution.slack)
        slack = np.maximum(slack, _FLOOR * scales.slack)
        dual = np.maximum(solution.cone_dual[carriers], _FLOOR * scales.local_dual)
        scale = scales.slack / scales.local_dual
        # A clearly inactive cone may have no direction that its normal could follow.
        kept = dual / slack * scale > 1.0 / _DECIDED
        kept[n:] &= ~start.active.apex
        chosen = np.flatnonzero(kept)
        return _Undecided(chosen, carriers[chosen], slack[chosen], dual[chosen], scale[chosen])

    def _active_set(self, start: KktPoint, constraints: IndexArray) -> ActiveSet:
        active = np.zeros(self._rows.n_constraints, dtype=bool)
        active[constraints] = True
        n = self._rows.n_nonnegative
        return ActiveSet(active[:n], active[n:], start.active.apex)

    def _step(self, values: ConeValues, point: KktPoint, pairs: _Undecided) -> KktPoint:
        """One predictor-corrector step; updates the pairs, returns the new point."""
        n, p = self._pattern.n, self._pattern.n_equalities
        diagonal = np.zeros(self._rows.n_rows)
        diagonal[pairs.rows] = -pairs.slack / pairs.dual
        self._matrix.update(values, point.active, point.frame, point.eta, diagonal)
        step, d_slack, d_dual, length = self._direction(point, pairs, 0.0)
        if length < 0.9:
            tau = (1.0 - length) ** 3 * float(pairs.slack @ pairs.dual) / pairs.slack.size
            step, d_slack, d_dual, length = self._direction(point, pairs, tau)
        pairs.slack = pairs.slack + length * d_slack
        pairs.dual = pairs.dual + length * d_dual
        step = length * step
        eta = point.eta + step[n + p :]
        eta[pairs.rows] = pairs.dual
        return self._evaluator.point(
            values, point.active, point.z + step[:n], point.nu + step[n : n + p], eta
        )

    def _direction(
        self, point: KktPoint, pairs: _Undecided, tau: float
    ) -> tuple[FloatArray, FloatArray, FloatArray, float]:
        """Newton direction towards products tau, of the slacks, of the duals; step length."""
        first = self._pattern.n + self._pattern.n_equalities
        right = -point.defect
        right[first + pairs.rows] -= tau / pairs.dual
        step, _ = self._matrix.solve(right, _STEP_ACCURACY)
        d_dual = step[first + pairs.rows]
        d_slack = (tau - pairs.slack * d_dual) / pairs.dual - pairs.slack
        level = np.concatenate((pairs.slack, pairs.dual))
        change = np.concatenate((d_slack, d_dual))
        falling = change < 0.0
        boundary = float((level[falling] / -change[falling]).min(initial=np.inf))
        return step, d_slack, d_dual, min(1.0, _FRACTION * boundary)

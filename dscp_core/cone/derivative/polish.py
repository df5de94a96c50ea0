"""Newton's method on the optimality conditions of an active set, with repair of that set."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dscp_core.cone.derivative.active_set import ActiveSet, ConeFrame, ConeRows, ConstraintScales
from dscp_core.cone.derivative.kkt import KktMatrix
from dscp_core.cone.program import ConePattern, ConeValues, FloatArray
from dscp_core.cone.residuals import BoundMatrices, Products, Residuals, largest_entry, residuals

# Relative residual of the linear system of a step: the next step removes what this one leaves.
_STEP_ACCURACY = 1e-8
# Relative defect at which nothing is left of a good starting point.
_LOST_SIZE = 10.0
# Relative defect that counts as rounding level when the steps gain no more.
_ROUNDING_SIZE = 1e-11
# Relative defect below which a Newton step changes the matrix only to second order of small.
_CHORD_SIZE = 1e-7


@dataclass
class KktPoint:
    """A point with an active set, and what follows from the two.

    Attributes:
        active: State of every constraint.
        z: (n,) primal point.
        nu: (p,) equality multipliers.
        eta: (m,) unknown multipliers (see `kkt`), zero where there is none.
        frame: Geometry of the slack at z.
        y: (m,) cone dual that eta stands for: lambda_0 (1, -u) on a cone's boundary.
        products: Matrix products at z, nu, y.
        defect: (n + p + m,) of stationarity, equalities, active constraints.
    """

    active: ActiveSet
    z: FloatArray
    nu: FloatArray
    eta: FloatArray
    frame: ConeFrame
    y: FloatArray
    products: Products
    defect: FloatArray


class KktEvaluator:
    """Evaluates the optimality conditions of active sets; bound to one pattern."""

    def __init__(self, pattern: ConePattern, rows: ConeRows, matrices: BoundMatrices) -> None:
        self._pattern = pattern
        self._rows = rows
        self._matrices = matrices

    def point(
        self,
        values: ConeValues,
        active: ActiveSet,
        z: FloatArray,
        nu: FloatArray,
        eta: FloatArray,
        at_z: Products | None = None,
    ) -> KktPoint:
        """Evaluate at z (n,), nu (p,), eta (m,); eta is cleared where it has no meaning.

        Products that are already known at the same z can be passed on.
        """
        rows, p = self._rows, self._pattern.n_equalities
        carries = active.rows(rows)
        eta = eta * carries
        k_z = self._matrices.constraints_times(z) if at_z is None else at_z.k_z
        frame = ConeFrame(rows, values.h - k_z[p:])
        y = eta.copy()
        y[rows.tails] -= frame.direction * (eta[rows.starts] * active.boundary)[rows.tail_cone]
        products = Products(
            self._matrices.q_times(z) if at_z is None else at_z.q_z,
            k_z,
            self._matrices.constraints_transposed_times(np.concatenate((nu, y))),
        )
        active_slack = frame.slack * carries
        active_slack[rows.starts] = np.where(
            active.boundary, frame.margin, active_slack[rows.starts]
        )
        defect = np.concatenate(
            (products.q_z + values.c + products.k_duals, k_z[:p] - values.b, -active_slack)
        )
        return KktPoint(active, z, nu, eta, frame, y, products, defect)

    def residuals(self, values: ConeValues, point: KktPoint) -> Residuals:
        """Residuals of all optimality conditions, inactive constraints included."""
        return residuals(
            self._pattern,
            values,
            point.products,
            point.z,
            np.concatenate((point.nu, point.y)),
            point.frame.slack,
        )


@dataclass(frozen=True)
class PolishOptions:
    """Limits of the polish.

    Attributes:
        max_steps: Newton steps, those after a repair included.
        tolerance: Relative defect at which a point counts as exact.
        sign_tolerance: Multiplier or slack below minus this, relative to the natural size,
            makes the constraint leave or enter the active set.
    """

    max_steps: int = 12
    tolerance: float = 1e-14
    sign_tolerance: float = 1e-12


@dataclass(frozen=True)
class PolishResult:
    """Outcome of a polish.

    Attributes:
        point: The last point.
        problem: Why it is no solution, in words; empty on success.
        steps: Newton steps taken.
        repairs: How often the active set changed.
    """

    point: KktPoint
    problem: str
    steps: int
    repairs: int


class Polisher:
    """Runs Newton's method with repair; bound to one pattern."""

    def __init__(
        self,
        pattern: ConePattern,
        rows: ConeRows,
        evaluator: KktEvaluator,
        matrix: KktMatrix,
        options: PolishOptions,
    ) -> None:
        self._pattern = pattern
        self._rows = rows
        self._evaluator = evaluator
        self._matrix = matrix
        self._options = options

    def run(self, values: ConeValues, start: KktPoint, scales: ConstraintScales) -> PolishResult:
        """Newton steps from `start` until the defect is at rounding level and all signs agree."""
        options = self._options
        sizes = self._defect_sizes(values, start)
        point, size = start, largest_entry(start.defect / sizes)
        seen = {point.active.key()}
        steps = repairs = 0
        factored = False
        if size <= options.tolerance and self._repair(point, scales) is None:
            return PolishResult(point, "", 0, 0)
        while steps < options.max_steps and (steps == 0 or size > options.tolerance):
            if not factored:
                self._matrix.update(values, point.active, point.frame, point.eta)
            step, _ = self._matrix.solve(-point.defect, _STEP_ACCURACY)
            steps += 1
            before, point = size, self._moved(values, point, step)
            size = largest_entry(point.defect / sizes)
            if not size <= _LOST_SIZE:
                problem = f"Newton's method diverged: relative defect {size:.1e}"
                return PolishResult(point, problem, steps, repairs)
            # After a small step the matrix of the previous point is as good as the next one's.
            factored = size <= _CHORD_SIZE
            repaired = self._repair(point, scales)
            if repaired is not None:
                if repaired.key() in seen:
                    return PolishResult(point, "the active set cycles", steps, repairs)
                seen.add(repaired.key())
                repairs += 1
                point = self._evaluator.point(
                    values, repaired, point.z, point.nu, point.eta, point.products
                )
                size, factored = largest_entry(point.defect / sizes), False
            elif factored and size > 0.5 * before:
                break  # rounding level
        if self._repair(point, scales) is not None or size > _ROUNDING_SIZE:
            problem = f"relative defect {size:.1e} after {steps} Newton steps"
            return PolishResult(point, problem, steps, repairs)
        return PolishResult(point, "", steps, repairs)

    def _moved(self, values: ConeValues, point: KktPoint, step: FloatArray) -> KktPoint:
        n, p = self._pattern.n, self._pattern.n_equalities
        return self._evaluator.point(
            values,
            point.active,
            point.z + step[:n],
            point.nu + step[n : n + p],
            point.eta + step[n + p :],
        )

    def _defect_sizes(self, values: ConeValues, start: KktPoint) -> FloatArray:
        """(n + p + m,) natural size of each defect."""
        pattern, products = self._pattern, start.products
        dual = max(1.0, largest_entry(values.c, products.q_z, products.k_duals))
        primal = max(1.0, largest_entry(products.k_z, values.b, values.h))
        sizes = np.full(pattern.n + pattern.n_equalities + pattern.n_cone_rows, primal)
        sizes[: pattern.n] = dual
        return sizes

    def _repair(self, point: KktPoint, scales: ConstraintScales) -> ActiveSet | None:
        """The active set with its wrong members exchanged; None if there are none."""
        rows, active, frame = self._rows, point.active, point.frame
        n = rows.n_nonnegative
        dual = -self._options.sign_tolerance * scales.dual
        slack = -self._options.sign_tolerance * scales.slack
        linear = np.where(active.linear, point.eta[:n] < dual[:n], frame.slack[:n] < slack[:n])
        inactive = ~(active.boundary | active.apex)
        cones = (active.boundary & (point.eta[rows.starts] < dual[n:])) | (
            inactive & (frame.margin < slack[n:])
        )
        if not (linear.any() or cones.any()):
            return None
        return ActiveSet(active.linear ^ linear, active.boundary ^ cones, active.apex)

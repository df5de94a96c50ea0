"""Linearises solutions of cone programs: active set, polish, verdict (section 3.1, eq. active)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from dscp_core.cone.derivative.active_set import ConstraintScales, constraint_scales, identify
from dscp_core.cone.derivative.interior import InteriorPhase
from dscp_core.cone.derivative.linearisation import KktWorkspace, Linearisation
from dscp_core.cone.derivative.polish import KktEvaluator, KktPoint, Polisher, PolishOptions
from dscp_core.cone.derivative.verdict import TrustLimits, judge, margins
from dscp_core.cone.program import ConePattern, ConeSolution, ConeValues, SolveStatus
from dscp_core.cone.residuals import Residuals
from dscp_core.errors import InvalidInputError

__all__ = ["KktSystem", "Linearisation", "SensitivityOptions"]

# A polished point is kept although the solver claims a smaller residual when both are at the
# level of rounding. Its gap follows from the other two, times the sizes of z and the duals.
_ROUNDING_RESIDUAL = 1e-12


@dataclass(frozen=True)
class SensitivityOptions:
    """Numerical settings of `KktSystem`.

    Attributes:
        regularisation: Added to the diagonal of the factored KKT matrix, positive in the rows of
            z, negative elsewhere; refinement removes its effect.
        max_refinements: Refinement steps of one solve.
        refinement_tolerance: Relative residual at which refinement stops.
        polish: Limits of the Newton polish.
        trust: Limits of the verdict.

    Raises:
        InvalidInputError: On construction, for a value out of range.
    """

    regularisation: float = 1e-9
    max_refinements: int = 5
    refinement_tolerance: float = 1e-14
    polish: PolishOptions = field(default_factory=PolishOptions)
    trust: TrustLimits = field(default_factory=TrustLimits)

    def __post_init__(self) -> None:
        if not 0.0 < self.regularisation < 1.0:
            raise InvalidInputError("regularisation", self.regularisation, "(0, 1)")
        if self.max_refinements < 0:
            raise InvalidInputError("max_refinements", self.max_refinements, "[0, inf)")


@dataclass
class _Outcome:
    """What is known of the point to linearise at.

    Attributes:
        point: The solver's, until a polish succeeds.
        residual: Of the polished point; None while there is none.
        steps: Newton steps of the last attempt.
        repairs: Changes of the active set among them.
        problems: Reasons against trusting the derivatives.
    """

    point: KktPoint
    residual: Residuals | None = None
    steps: int = 0
    repairs: int = 0
    problems: list[str] = field(default_factory=list)

    @property
    def polished(self) -> bool:
        return self.residual is not None


class KktSystem:
    """Linearises solutions of all programs of one pattern; symbolic work is done once.

    Linearisations of one system share its factorisation: using one after another has been made
    costs a new numeric factorisation, and they must not be used from several threads at once.

    Args:
        pattern: Structure of the programs.
        options: Numerical settings; the defaults if None.
    """

    def __init__(self, pattern: ConePattern, options: SensitivityOptions | None = None) -> None:
        self.pattern = pattern
        self.options = SensitivityOptions() if options is None else options
        self._workspace = KktWorkspace(
            pattern, self.options.regularisation, self.options.max_refinements
        )
        rows, matrix = self._workspace.rows, self._workspace.matrix
        self._rows = rows
        self._evaluator = KktEvaluator(pattern, rows, self._workspace.matrices)
        self._polisher = Polisher(pattern, rows, self._evaluator, matrix, self.options.polish)
        self._interior = InteriorPhase(pattern, rows, self._evaluator, matrix)

    def linearise(
        self, values: ConeValues, solution: ConeSolution, *, polish: bool = True
    ) -> Linearisation:
        """Identify the active set, polish the point, and prepare derivatives.

        Args:
            values: Data of the program.
            solution: Of a solver for the same data. A point that a solver gave up on is
                linearised too; the verdict then says so.
            polish: Whether to take Newton steps on the active set. Without them, derivatives
                are as accurate as the solver's point.

        Raises:
            InvalidInputError: Sizes do not fit, or data or point are not finite.
        """
        self._check(values, solution)
        values = values.copy()
        self._workspace.bind(values)
        z, nu, y = solution.z, solution.equality_dual, solution.cone_dual
        products = self._workspace.matrices.products(z, np.concatenate((nu, y)))
        scales = constraint_scales(self.pattern, self._rows, values, products, z, nu, y)
        active = identify(self._rows, scales, solution.slack, y)
        start = self._evaluator.point(values, active, z, nu, y, products)
        outcome = _Outcome(start)
        if solution.status is not SolveStatus.SOLVED:
            outcome.problems.append(f"solver status is {solution.status.value!r}")
        if polish:
            self._polish(values, start, solution, scales, outcome)
        point = outcome.point
        residual = outcome.residual or self._evaluator.residuals(values, point)
        self._workspace.use(values, point)
        found = margins(self._rows, scales, point)
        verdict = judge(
            self.options.trust,
            point,
            found,
            self._workspace.matrix.probe(),
            kkt_residual=residual.worst,
            problems=tuple(outcome.problems),
            polished=outcome.polished,
            newton_steps=outcome.steps,
            repairs=outcome.repairs,
        )
        return Linearisation(
            self._workspace,
            values,
            point,
            self._polished_solution(solution, point, residual) if outcome.polished else solution,
            verdict,
            found,
            refinement_tolerance=self.options.refinement_tolerance,
            solve_limit=self.options.trust.solve_residual,
        )

    def _polish(
        self,
        values: ConeValues,
        start: KktPoint,
        solution: ConeSolution,
        scales: ConstraintScales,
        outcome: _Outcome,
    ) -> None:
        """Newton steps from the solver's point; if they fail, from a better centred one."""
        result = self._polisher.run(values, start, scales)
        if result.problem:
            clearer = self._interior.run(values, start, solution, scales)
            result = self._polisher.run(values, clearer, scales)
        outcome.steps, outcome.repairs = result.steps, result.repairs
        problem = result.problem
        if not problem:
            residual = self._evaluator.residuals(values, result.point)
            claimed = max(solution.primal_residual, solution.dual_residual, solution.gap)
            rounding = max(residual.primal, residual.dual) <= _ROUNDING_RESIDUAL
            if rounding or residual.worst <= claimed:
                outcome.point, outcome.residual = result.point, residual
                return
            problem = f"residual {residual.worst:.1e} above the solver's {claimed:.1e}"
        outcome.problems.append(f"polish failed, the solver's point is used: {problem}")

    def _check(self, values: ConeValues, solution: ConeSolution) -> None:
        values.check(self.pattern)
        sizes = {
            "z": self.pattern.n,
            "equality_dual": self.pattern.n_equalities,
            "cone_dual": self.pattern.n_cone_rows,
            "slack": self.pattern.n_cone_rows,
        }
        for name, size in sizes.items():
            array = getattr(solution, name)
            if array.shape != (size,):
                raise InvalidInputError(f"solution.{name}.shape", array.shape, f"({size},)")
            if not np.isfinite(array).all():
                answer = f"{solution.status.value} answer of {solution.solver}"
                raise InvalidInputError(f"solution.{name}", answer, "finite numbers")

    def _polished_solution(
        self, solution: ConeSolution, point: KktPoint, residual: Residuals
    ) -> ConeSolution:
        rows, active, frame = self._rows, point.active, point.frame
        slack = np.where(active.rows(rows), 0.0, frame.slack)
        slack[rows.starts] = np.where(active.boundary, frame.tail_norm, slack[rows.starts])
        return replace(
            solution,
            z=point.z,
            equality_dual=point.nu,
            cone_dual=point.y,
            slack=slack,
            primal_residual=residual.primal,
            dual_residual=residual.dual,
            gap=residual.gap,
        )

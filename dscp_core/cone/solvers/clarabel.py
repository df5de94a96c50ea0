"""Clarabel: homogeneous embedding, native quadratic term, certifies infeasibility."""

from __future__ import annotations

import time
from array import array
from typing import Any

import numpy as np

from dscp_core.cone.program import ConePattern, ConeSolution, ConeValues, FloatArray, SolveStatus
from dscp_core.cone.solvers.base import AnswerChecker, RawAnswer, SolverSettings, import_backend

_CLAIMS = {
    "Solved": SolveStatus.SOLVED,
    "PrimalInfeasible": SolveStatus.INFEASIBLE,
    "DualInfeasible": SolveStatus.UNBOUNDED,
    "MaxIterations": SolveStatus.ITERATION_LIMIT,
    "MaxTime": SolveStatus.TIME_LIMIT,
}


class ClarabelSolver:
    """Backend for https://clarabel.org; the time limit is enforced between iterations.

    Clarabel's iterative refinement is off: on the powered-descent subproblems it doubles the time
    and changes neither status nor iterations. A program that fails without it is solved once more,
    with refinement and a fresh set-up.
    """

    name = "clarabel"

    def __init__(self, pattern: ConePattern, settings: SolverSettings) -> None:
        self._package = import_backend("clarabel")
        self._pattern = pattern
        self._checker = AnswerChecker(self.name, pattern, settings)
        self._settings = self._package.DefaultSettings()
        self._settings.verbose = False
        self._settings.presolve_enable = False  # presolve forbids data updates
        self._settings.input_sparse_dropzeros = False
        self._settings.max_threads = 1
        self._settings.iterative_refinement_enable = False
        self._settings.max_iter = settings.max_iterations
        self._settings.tol_feas = settings.tolerance
        self._settings.tol_gap_abs = settings.tolerance
        self._settings.tol_gap_rel = settings.tolerance
        self._solver: Any = None

    def solve(self, values: ConeValues, *, time_limit_s: float | None = None) -> ConeSolution:
        """See `ConeSolver.solve`."""
        if time_limit_s is not None and time_limit_s <= 0.0:
            return self._checker.not_attempted(time_limit_s)
        stacked = self._checker.bind(values)
        right = np.concatenate((values.b, values.h))
        start = time.perf_counter()
        setup_seconds = 0.0
        self._settings.time_limit = np.inf if time_limit_s is None else time_limit_s
        if self._solver is None:
            self._solver = self._set_up(values, stacked, right)
            setup_seconds = time.perf_counter() - start
        else:
            self._solver.update(settings=self._settings)
            # Clarabel reads a buffer of Python floats 3 times faster than a NumPy array.
            self._solver.update(
                P=_buffer(values.q), q=_buffer(values.c), A=_buffer(stacked), b=_buffer(right)
            )
        solution = self._answer(values, self._solver, start, setup_seconds)
        if solution.status not in (SolveStatus.NUMERICAL_FAILURE, SolveStatus.ITERATION_LIMIT):
            return solution
        if time_limit_s is not None:
            self._settings.time_limit = time_limit_s - (time.perf_counter() - start)
            if self._settings.time_limit <= 0.0:
                return solution
        self._settings.iterative_refinement_enable = True
        try:
            careful = self._set_up(values, stacked, right)
        finally:
            self._settings.iterative_refinement_enable = False
        return self._answer(values, careful, start, setup_seconds)

    def _answer(
        self, values: ConeValues, solver: Any, start: float, setup_seconds: float
    ) -> ConeSolution:
        answer = solver.solve()
        z, duals, slack = answer.x, answer.z, answer.s
        word = str(answer.status)
        raw = RawAnswer(
            z=_to_array(z),
            duals=_to_array(duals),
            slack=_to_array(slack)[self._pattern.n_equalities :],
            claim=_CLAIMS.get(word, SolveStatus.NUMERICAL_FAILURE),
            iterations=answer.iterations,
            seconds=time.perf_counter() - start - setup_seconds,
            setup_seconds=setup_seconds,
            message=f"clarabel: {word}",
        )
        return self._checker.check(values, raw)

    def _set_up(self, values: ConeValues, stacked: FloatArray, right: FloatArray) -> Any:
        package, pattern = self._package, self._pattern
        cones = [package.SecondOrderConeT(dim) for dim in pattern.soc_dims]
        if pattern.n_nonnegative:
            cones.insert(0, package.NonnegativeConeT(pattern.n_nonnegative))
        if pattern.n_equalities:
            cones.insert(0, package.ZeroConeT(pattern.n_equalities))
        return package.DefaultSolver(
            pattern.q.matrix(values.q),
            values.c,
            pattern.stacked.matrix(stacked),
            right,
            cones,
            self._settings,
        )


def _buffer(values: FloatArray) -> array[float]:
    return array("d", values.tobytes())


def _to_array(numbers: list[float]) -> FloatArray:
    return np.fromiter(numbers, np.float64, len(numbers))

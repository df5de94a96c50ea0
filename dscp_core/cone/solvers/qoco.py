"""QOCO: primal-dual interior point with native quadratic term; fast, detects no infeasibility."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import scipy.sparse as sp

from dscp_core.cone.program import ConePattern, ConeSolution, ConeValues, SolveStatus
from dscp_core.cone.solvers.base import AnswerChecker, RawAnswer, SolverSettings, import_backend

_CLAIMS = {
    "QOCO_SOLVED": SolveStatus.SOLVED,
    "QOCO_MAX_ITER": SolveStatus.ITERATION_LIMIT,
}


class QocoSolver:
    """Backend for QOCO.

    QOCO has no time limit: `time_limit_s` only prevents a call with no time left. After data
    updates it can return an answer to earlier data; an answer that fails the residual check is
    therefore recomputed once with a fresh set-up. An infeasible or unbounded program is
    reported as such when QOCO's diverging last iterate proves it.
    """

    name = "qoco"

    def __init__(self, pattern: ConePattern, settings: SolverSettings) -> None:
        self._package = import_backend("qoco")
        self._pattern = pattern
        self._settings = settings
        self._checker = AnswerChecker(self.name, pattern, settings)
        self._solver: Any = None

    def solve(self, values: ConeValues, *, time_limit_s: float | None = None) -> ConeSolution:
        """See `ConeSolver.solve`."""
        if time_limit_s is not None and time_limit_s <= 0.0:
            return self._checker.not_attempted(time_limit_s)
        self._checker.bind(values)
        fresh = self._solver is None
        solution = self._attempt(values, 0.0)
        if not fresh and solution.status is not SolveStatus.SOLVED:
            self._solver = None
            solution = self._attempt(values, solution.seconds)
        return solution

    def _attempt(self, values: ConeValues, seconds_before: float) -> ConeSolution:
        pattern = self._pattern
        start = time.perf_counter()
        setup_seconds = 0.0
        if self._solver is None:
            self._solver = self._set_up(values)
            setup_seconds = time.perf_counter() - start
        else:
            self._solver.update_matrix_data(
                P=values.q if pattern.q.nnz else None,
                A=values.a if pattern.n_equalities else None,
                G=values.g if pattern.n_cone_rows else None,
            )
            self._solver.update_vector_data(
                c=values.c,
                b=values.b if pattern.n_equalities else None,
                h=values.h if pattern.n_cone_rows else None,
            )
        answer = self._solver.solve()
        seconds = time.perf_counter() - start - setup_seconds
        raw = RawAnswer(
            z=answer.x,
            duals=np.concatenate((answer.y, answer.z)),
            slack=answer.s,
            claim=_CLAIMS.get(answer.status, SolveStatus.NUMERICAL_FAILURE),
            iterations=answer.iters,
            seconds=seconds + seconds_before,
            setup_seconds=setup_seconds,
            message=f"qoco: {answer.status}",
        )
        return self._checker.check(values, raw)

    def _set_up(self, values: ConeValues) -> Any:
        pattern, tolerance = self._pattern, self._settings.tolerance
        solver = self._package.QOCO()
        p, m = pattern.n_equalities, pattern.n_cone_rows
        solver.setup(
            pattern.n,
            m,
            p,
            sp.csc_matrix(pattern.q.matrix(values.q)) if pattern.q.nnz else None,
            values.c,
            sp.csc_matrix(pattern.a.matrix(values.a)) if p else None,
            values.b if p else None,
            sp.csc_matrix(pattern.g.matrix(values.g)) if m else None,
            values.h if m else None,
            pattern.n_nonnegative,
            len(pattern.soc_dims),
            np.array(pattern.soc_dims, dtype=np.int32) if pattern.soc_dims else None,
            abstol=tolerance,
            reltol=tolerance,
            max_iters=self._settings.max_iterations,
            verbose=False,
        )
        return solver

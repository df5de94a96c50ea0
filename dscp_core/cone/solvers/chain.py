"""Several solvers in a stated order: the next one is asked only when the one before fails."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

from dscp_core.cone.program import ConeSolution, ConeValues, SolveStatus
from dscp_core.cone.solvers.base import ConeSolver
from dscp_core.errors import InvalidInputError

# These answers are final: another solver could only contradict a checked result.
_DEFINITE = (SolveStatus.SOLVED, SolveStatus.INFEASIBLE, SolveStatus.UNBOUNDED)


class ChainSolver:
    """Asks its solvers in order; every failed attempt is kept in `ConeSolution.attempts`.

    A time limit covers the whole chain. The answer is that of the last solver asked.
    """

    def __init__(self, solvers: Sequence[ConeSolver]) -> None:
        if not solvers:
            raise InvalidInputError("solvers", solvers, "at least one solver")
        self._solvers = tuple(solvers)

    @property
    def name(self) -> str:
        """The names in order, separated by commas."""
        return ",".join(solver.name for solver in self._solvers)

    def solve(self, values: ConeValues, *, time_limit_s: float | None = None) -> ConeSolution:
        """See `ConeSolver.solve`."""
        start = time.perf_counter()
        attempts: list[ConeSolution] = []
        for solver in self._solvers:
            remaining = time_limit_s
            if time_limit_s is not None:
                remaining = time_limit_s - (time.perf_counter() - start)
            solution = solver.solve(values, time_limit_s=remaining)
            if solution.status in _DEFINITE:
                break
            attempts.append(solution)
        else:
            solution = attempts.pop()
        return replace(solution, attempts=tuple(attempts))

"""Cone solvers behind one protocol: `make_solver("qoco,clarabel", pattern)`."""

from __future__ import annotations

from collections.abc import Callable

from dscp_core.cone.program import ConePattern
from dscp_core.cone.solvers.base import ConeSolver, SolverSettings, SolverUnavailableError
from dscp_core.cone.solvers.chain import ChainSolver
from dscp_core.cone.solvers.clarabel import ClarabelSolver
from dscp_core.cone.solvers.ecos import EcosSolver
from dscp_core.cone.solvers.qoco import QocoSolver
from dscp_core.errors import InvalidInputError

__all__ = [
    "SOLVER_NAMES",
    "ConeSolver",
    "SolverSettings",
    "SolverUnavailableError",
    "make_solver",
]

_BACKENDS: dict[str, Callable[[ConePattern, SolverSettings], ConeSolver]] = {
    "clarabel": ClarabelSolver,
    "ecos": EcosSolver,
    "qoco": QocoSolver,
}

SOLVER_NAMES = tuple(_BACKENDS)


def make_solver(
    name: str, pattern: ConePattern, settings: SolverSettings | None = None
) -> ConeSolver:
    """Solver bound to a pattern.

    Args:
        name: One of `SOLVER_NAMES`, or several separated by commas: a chain, tried in order
            until one solves the program or proves that it has no solution.
        pattern: Structure of every program that it will solve.
        settings: Accuracy and limits; the defaults if None.

    Raises:
        InvalidInputError: For an unknown or repeated name.
        SolverUnavailableError: If the package of a named backend is not installed.
    """
    chosen = SolverSettings() if settings is None else settings
    names = [part.strip() for part in name.split(",")]
    for part in names:
        if part not in _BACKENDS:
            raise InvalidInputError("solver", part, f"one of {', '.join(SOLVER_NAMES)}")
    if len(set(names)) != len(names):
        raise InvalidInputError("solver", name, "each name at most once")
    solvers = [_BACKENDS[part](pattern, chosen) for part in names]
    return solvers[0] if len(solvers) == 1 else ChainSolver(solvers)

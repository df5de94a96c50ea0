"""What every cone solver backend shares: settings, the protocol, the check of its answer."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from types import ModuleType
from typing import Protocol

import numpy as np

from dscp_core.cone.convexity import ConvexityCheck
from dscp_core.cone.program import ConePattern, ConeSolution, ConeValues, FloatArray, SolveStatus
from dscp_core.cone.residuals import (
    BoundMatrices,
    infeasibility_certificate,
    residuals,
    unboundedness_certificate,
)
from dscp_core.errors import DscpError, InvalidInputError

# A certificate this good excludes every feasible point with |z|_1 < 1e7.
CERTIFICATE_TOLERANCE = 1e-7


class SolverUnavailableError(DscpError, ImportError):
    """The package of a solver backend is not installed."""


@dataclass(frozen=True)
class SolverSettings:
    """Accuracy and limits, the same for every backend.

    Attributes:
        tolerance: Asked of the backend for residuals and gap, absolute and relative.
        acceptable_tolerance: A point with relative residuals up to this counts as SOLVED even if
            the backend stopped early for numerical reasons; the message then says so.
        max_iterations: Interior-point iterations.

    Raises:
        InvalidInputError: On construction, for a value out of range.
    """

    tolerance: float = 1e-9
    acceptable_tolerance: float = 1e-5
    max_iterations: int = 100

    def __post_init__(self) -> None:
        if not 0.0 < self.tolerance < 1.0:
            raise InvalidInputError("tolerance", self.tolerance, "(0, 1)")
        if not self.tolerance <= self.acceptable_tolerance < 1.0:
            raise InvalidInputError(
                "acceptable_tolerance", self.acceptable_tolerance, f"[{self.tolerance}, 1)"
            )
        if self.max_iterations < 1:
            raise InvalidInputError("max_iterations", self.max_iterations, "[1, inf)")


class ConeSolver(Protocol):
    """A backend bound to one pattern; keeps its symbolic work from call to call."""

    @property
    def name(self) -> str:
        """Name as given to `make_solver`."""
        ...

    def solve(self, values: ConeValues, *, time_limit_s: float | None = None) -> ConeSolution:
        """Solve the program with these values.

        Args:
            values: Finite data that fit the pattern.
            time_limit_s: Wall time allowed [s]; nothing is tried when it is not positive.

        Raises:
            InvalidInputError: If the data do not fit the pattern, are not finite, or Q is not
                positive semidefinite.
        """
        ...


@dataclass(frozen=True)
class RawAnswer:
    """What a backend returned, in the project's sign convention, before it is checked.

    Attributes:
        z: (n,) primal point.
        duals: (p + m,) nu followed by y.
        slack: (m,) s.
        claim: The backend's own verdict.
        iterations: Interior-point iterations.
        seconds: Wall time of data update and solve [s].
        setup_seconds: Wall time of a set-up done for this call [s].
        message: The backend's own word for its verdict.
    """

    z: FloatArray
    duals: FloatArray
    slack: FloatArray
    claim: SolveStatus
    iterations: int
    seconds: float
    setup_seconds: float
    message: str


class AnswerChecker:
    """Computes residuals of a backend's answer and decides what status it deserves."""

    def __init__(self, name: str, pattern: ConePattern, settings: SolverSettings) -> None:
        self._name = name
        self._pattern = pattern
        self._settings = settings
        self._matrices = BoundMatrices(pattern)
        self._convexity = ConvexityCheck(pattern)

    def bind(self, values: ConeValues) -> FloatArray:
        """Take the data of the next solve; returns the values of [A; G] stacked."""
        values.check(self._pattern)
        self._convexity.check(values)
        self._matrices.bind(values)
        return self._matrices.stacked_values

    def check(self, values: ConeValues, raw: RawAnswer) -> ConeSolution:
        """Turn a backend's answer to the bound values into a solution with a checked status."""
        pattern, matrices = self._pattern, self._matrices
        products = matrices.products(raw.z, raw.duals)
        found = residuals(pattern, values, products, raw.z, raw.duals, raw.slack)
        status, message = raw.claim, raw.message
        numbers = f"residuals primal {found.primal:.1e}, dual {found.dual:.1e}, gap {found.gap:.1e}"
        acceptable = found.worst <= self._settings.acceptable_tolerance
        if status is SolveStatus.SOLVED:
            if acceptable:
                message = ""
            else:
                status = SolveStatus.NUMERICAL_FAILURE
                message = f"{message}, but {numbers}"
        elif status is SolveStatus.NUMERICAL_FAILURE and acceptable:
            status = SolveStatus.SOLVED
            message = f"{message}; accepted with reduced accuracy: {numbers}"
        if status in (SolveStatus.NUMERICAL_FAILURE, SolveStatus.ITERATION_LIMIT):
            status, message = self._look_for_certificate(values, raw, status, message)
        return ConeSolution(
            z=raw.z,
            equality_dual=raw.duals[: pattern.n_equalities],
            cone_dual=raw.duals[pattern.n_equalities :],
            slack=raw.slack,
            status=status,
            solver=self._name,
            iterations=raw.iterations,
            seconds=raw.seconds,
            setup_seconds=raw.setup_seconds,
            primal_residual=found.primal,
            dual_residual=found.dual,
            gap=found.gap,
            message=message,
        )

    def not_attempted(self, time_limit_s: float) -> ConeSolution:
        """Answer to a call whose time limit leaves no time at all; the point is NaN."""
        pattern = self._pattern
        return ConeSolution(
            z=np.full(pattern.n, np.nan),
            equality_dual=np.full(pattern.n_equalities, np.nan),
            cone_dual=np.full(pattern.n_cone_rows, np.nan),
            slack=np.full(pattern.n_cone_rows, np.nan),
            status=SolveStatus.TIME_LIMIT,
            solver=self._name,
            iterations=0,
            seconds=0.0,
            primal_residual=np.inf,
            dual_residual=np.inf,
            gap=np.inf,
            message=f"not attempted: time limit {time_limit_s:.3g} s",
        )

    def _look_for_certificate(
        self, values: ConeValues, raw: RawAnswer, status: SolveStatus, message: str
    ) -> tuple[SolveStatus, str]:
        """A diverging iterate often proves why the program has no solution."""
        farkas = infeasibility_certificate(self._pattern, self._matrices, values, raw.duals)
        if farkas <= CERTIFICATE_TOLERANCE:
            return (
                SolveStatus.INFEASIBLE,
                f"{message}; the last duals prove that no feasible z has |z|_1 < {1 / farkas:.1e}",
            )
        descent = unboundedness_certificate(self._pattern, self._matrices, values, raw.z)
        if descent <= CERTIFICATE_TOLERANCE:
            return (
                SolveStatus.UNBOUNDED,
                f"{message}; the last z is a direction of unbounded descent "
                f"(violation {descent:.1e})",
            )
        return status, message


def import_backend(package: str) -> ModuleType:
    """Import a solver package on demand.

    Raises:
        SolverUnavailableError: If it is not installed.
    """
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise SolverUnavailableError(
            f"solver {package!r} was asked for, but the Python package {package!r} cannot be "
            f"imported ({error}); install it or choose another solver"
        ) from error

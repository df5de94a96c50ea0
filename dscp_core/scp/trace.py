"""What an SCP run leaves behind: every iteration, and why it stopped."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from dscp_core.cone.derivative.sensitivity import Linearisation
from dscp_core.cone.program import ConeSolution, ConeValues

Array = NDArray[np.float64]


class ScpStatus(Enum):
    """Why the iterations stopped."""

    CONVERGED = "converged"
    FIXED_ITERATIONS = "fixed number of iterations done"
    INFEASIBLE = "no feasible trajectory, virtual control is left"
    ITERATION_LIMIT = "iteration limit"
    DEADLINE = "deadline"
    SUBPROBLEM_INFEASIBLE = "subproblem infeasible"
    SOLVER_FAILURE = "solver failure"
    DIVERGED = "diverged"


@dataclass(frozen=True)
class Iteration:
    """One iteration k of the trace.

    Attributes:
        reference: Scaled reference vector that the subproblem was built about.
        values: The subproblem's values.
        solution: Its solution, polished when `ScpOptions.polish` is set.
        linearisation: Derivatives at that solution, made by the polish; None without it.
        cost: True cost J of the solution's trajectory, in its own units.
        penalised_cost: J plus the virtual-control penalty, scaled.
        predicted_change: Change of the subproblem's objective from reference to solution, scaled.
        defects: (N, nx) residual of the discrete dynamics at the solution, SI.
        virtual_control: (N, nx), SI.
        assembly_seconds: Time spent on values and evaluation.
        solve_seconds: The solver's own time, set-up included.
        polish_seconds: Time of the refinement.
    """

    reference: Array
    values: ConeValues
    solution: ConeSolution
    linearisation: Linearisation | None
    cost: float
    penalised_cost: float
    predicted_change: float
    defects: Array
    virtual_control: Array
    assembly_seconds: float
    solve_seconds: float
    polish_seconds: float


@dataclass(frozen=True)
class ScpResult:
    """Full trace of a run.

    Attributes:
        status: Why it stopped.
        message: In words, with the numbers.
        iterations: Completed iterations, in order.
        parameters: Packed parameters of the run, SI.
        initial_reference: Scaled reference vector of the first iteration.
        warm_started: Whether the caller gave that reference.
        seconds: Wall time of the run.
        failed: Answer of the solver in the iteration that failed, or None.
    """

    status: ScpStatus
    message: str
    iterations: tuple[Iteration, ...]
    parameters: Array
    initial_reference: Array
    warm_started: bool
    seconds: float
    failed: ConeSolution | None = None

    @property
    def final_reference(self) -> Array:
        """Reference vector after the last iteration."""
        if not self.iterations:
            return self.initial_reference
        size = self.initial_reference.size
        return self.iterations[-1].solution.z[:size]

    @property
    def succeeded(self) -> bool:
        """Whether the trace ended as asked."""
        return self.status in (ScpStatus.CONVERGED, ScpStatus.FIXED_ITERATIONS)

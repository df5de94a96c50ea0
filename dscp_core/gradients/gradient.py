"""A gradient by parameter name, of what, of which run, and whether it can be trusted."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from dscp_core.cone.derivative.verdict import GradientVerdict
from dscp_core.gradients.quantities import Quantity
from dscp_core.problem.declaration import OptimalControlProblem
from dscp_core.scp.trace import ScpStatus

Array = NDArray[np.float64]

INITIAL_STATE = "initial_state"
"""Stands for the parameters that hold the initial state, one after the other."""


class Method(Enum):
    """How a gradient was computed.

    Example:
        >>> from dscp_core import Method, Planner, problems
        >>> planner = Planner(problems.get("powered_descent"))
        >>> gradient = planner.gradient("cost", method=Method.UNROLLED)
        >>> gradient.method.value, gradient.iterations
        ('unrolled', 7)
    """

    UNROLLED = "unrolled"
    IMPLICIT = "implicit"


def parts(problem: OptimalControlProblem, name: str) -> tuple[str, ...]:
    """Names of the parameters that a name stands for.

    Args:
        problem: The declaration.
        name: Name of a parameter, or ``"initial_state"``.

    Raises:
        InvalidInputError: Unknown name.
    """
    if name == INITIAL_STATE and name not in problem.table.names:
        return problem.initial_state_parameters or (problem.table[name].name,)
    return (problem.table[name].name,)


def positions(problem: OptimalControlProblem, name: str) -> NDArray[np.intp]:
    """Positions of what a name stands for in the packed vector; arguments as for `parts`."""
    every = np.arange(problem.table.size)
    return np.concatenate([every[problem.table.slice(part)] for part in parts(problem, name)])


@dataclass(frozen=True)
class Gradient:
    """Gradient of a loss with respect to every parameter, by name: ``gradient["initial_mass"]``.

    Attributes:
        value: The loss.
        parameters: (P,) gradient with respect to the packed parameters, per SI unit.
        initial_reference: Gradient with respect to the scaled reference vector that the run
            started from; zero for the implicit method. When the problem's own guess was the
            start, its dependence on the parameters is already in ``parameters``.
        trusted: Whether the gradient can be relied upon.
        reasons: Why not, in words with numbers.
        verdicts: Verdict of every differentiated iteration, first iteration first.
        method: How it was computed.
        of: What was differentiated.
        iterations: Number K of iterations of the run.
        stopped: Why they stopped.
        feasible: Whether the run ended at a trajectory that satisfies the dynamics, without
            virtual control.
        settled: Whether another iteration would not move it; None where that was not tried.
        terminal_time_s: Flight time there.
        free_terminal_time: Whether that is a decision; the gradient with respect to the parameter
            ``terminal_time`` is then that of a first guess.
        problem: The declaration.

    Example:
        >>> from dscp_core import Planner, problems
        >>> planner = Planner(problems.get("powered_descent"))
        >>> gradient = planner.gradient("mass")
        >>> gradient["initial_velocity"].shape, gradient.trusted
        ((3,), True)
        >>> round(gradient["specific_impulse"], 2)  # kg per s
        19.72
    """

    value: float
    parameters: Array
    initial_reference: Array
    trusted: bool
    reasons: tuple[str, ...]
    verdicts: tuple[GradientVerdict, ...]
    method: Method
    of: Quantity
    iterations: int
    stopped: ScpStatus
    feasible: bool
    settled: bool | None
    terminal_time_s: float
    free_terminal_time: bool
    problem: OptimalControlProblem = field(repr=False)

    def __getitem__(self, name: str) -> float | Array:
        """Derivative by a parameter, per SI unit: a float for a scalar, (size,) for a vector.

        Args:
            name: Name of a parameter, or ``"initial_state"`` for (nx,) in the order of the states.

        Raises:
            InvalidInputError: Unknown name; the message has those that are near.
        """
        picked = self.parameters[positions(self.problem, name)]
        known = self.problem.table
        vector = name not in known.names or known[name].is_vector
        return picked if vector else float(picked[0])

    def __iter__(self) -> Iterator[str]:
        return iter(self.keys())

    def keys(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.problem.table.names

    def as_dict(self) -> dict[str, float | Array]:
        """Every derivative by name."""
        return self.problem.table.unpack(self.parameters)

    @property
    def converged(self) -> bool:
        """Whether the run ended at a feasible trajectory that stands still."""
        if not self.feasible:
            return False
        return self.stopped is ScpStatus.CONVERGED if self.settled is None else self.settled

    @property
    def headline(self) -> str:
        """What this is the gradient of, of which run, and whether it can be trusted."""
        unit = f" [{self.of.unit}]" if self.of.unit not in ("", "1") else ""
        time = f"{'free, ' if self.free_terminal_time else 'fixed at '}{self.terminal_time_s:.4g} s"
        run = "feasible, " if self.feasible else "NOT FEASIBLE, "
        if self.converged:
            run += "converged"
        elif self.settled is None and self.stopped is ScpStatus.FIXED_ITERATIONS:
            run += "convergence not tested"
        else:
            run += "NOT CONVERGED"
        return (
            f"gradient of {self.of.name}, {self.of.symbol}{unit}; {self.method.value}, "
            f"{self.iterations} iterations, terminal time {time}; run {run}: "
            f"{'trusted' if self.trusted else 'NOT TRUSTED'}"
        )

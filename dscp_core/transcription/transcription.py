"""Midpoint-trapezoid transcription of an optimal control problem to a cone program.

One compiled function maps (reference, parameters) to every value of the subproblem, and its
reverse-mode derivative is the vector-Jacobian product of eq. d3, second derivatives included.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dscp_core.cone.program import ConePattern, ConeValues
from dscp_core.errors import InvalidInputError
from dscp_core.problem.declaration import TERMINAL_TIME, OptimalControlProblem
from dscp_core.problem.parameters import ParameterTable
from dscp_core.transcription.compiled import CompiledFunction
from dscp_core.transcription.layout import TrajectoryLayout
from dscp_core.transcription.scatter import ValueScatter
from dscp_core.transcription.stages import StageFunctions, build_stages

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Evaluation:
    """True (nonlinear) measures of a trajectory.

    Attributes:
        cost: Cost J of eq. 1, discretised, in its own units.
        defects: Residual of the discrete dynamics, eq. ch2-disdy, (N, nx), SI.
    """

    cost: float
    defects: Array


class Transcription:
    """An optimal control problem on N intervals, as a family of cone programs.

    Attributes:
        problem: The declaration.
        layout: Where quantities stand in the decision vector.
        pattern: Fixed sparsity of every subproblem.
        table: Parameters, in the packing order of every ``parameters`` argument.
    """

    def __init__(
        self,
        problem: OptimalControlProblem,
        intervals: int,
        *,
        free_terminal_time: bool | None = None,
    ) -> None:
        """Compile the problem's functions.

        Args:
            problem: The declaration.
            intervals: Number N of intervals.
            free_terminal_time: Make the terminal time a decision; the parameter
                ``terminal_time`` is then its first guess only. None for the problem's default.

        Raises:
            InvalidInputError: ``intervals`` below 2.
        """
        if intervals < 2:
            raise InvalidInputError("intervals", intervals, ">= 2")
        self.problem = problem
        self.table: ParameterTable = problem.table
        time_scale = float(np.ravel(self.table[TERMINAL_TIME].default)[0])
        self.layout = TrajectoryLayout(
            state_scale=np.array([s.scale for s in problem.states]),
            control_scale=np.array([c.scale for c in problem.controls]),
            time_scale=time_scale,
            intervals=intervals,
            free_terminal_time=(
                problem.free_terminal_time if free_terminal_time is None else free_terminal_time
            ),
            virtual_scale=np.array(problem.virtual_control_scale or (0.0,) * len(problem.states)),
        )
        stages = build_stages(problem, self.layout)
        scatter = ValueScatter(problem, self.layout, stages)
        self.pattern: ConePattern = scatter.pattern
        self._compile(stages, scatter)

    def _compile(self, stages: StageFunctions, scatter: ValueScatter) -> None:
        layout = self.layout
        reference = ca.MX.sym("reference", layout.reference_size)
        parameters = ca.MX.sym("parameters", self.table.size)
        seed = ca.MX.sym("seed", scatter.n_values)
        values = ca.mtimes(scatter.matrix, stages.sources(reference, parameters))
        self._values = CompiledFunction("values", [reference, parameters], [values])
        both = ca.vertcat(reference, parameters)
        pullback = ca.jtimes(values, both, seed, True)
        self._pullback = CompiledFunction(
            "values_pullback",
            [reference, parameters, seed],
            [pullback[: layout.reference_size], pullback[layout.reference_size :]],
        )
        direction = ca.MX.sym("direction", both.numel())
        self._pushforward = CompiledFunction(
            "values_pushforward",
            [reference, parameters, direction],
            [ca.jtimes(values, both, direction)],
        )
        cost, defects = stages.evaluation(reference, parameters)
        self._evaluation = CompiledFunction("evaluation", [reference, parameters], [cost, defects])
        cost_gradient = ca.gradient(cost, both)
        self._cost_gradient = CompiledFunction(
            "cost_gradient",
            [reference, parameters],
            [cost_gradient[: layout.reference_size], cost_gradient[layout.reference_size :]],
        )
        guess = stages.initial_guess(parameters)
        guess_seed = ca.MX.sym("guess_seed", layout.reference_size)
        guess_direction = ca.MX.sym("guess_direction", self.table.size)
        self._guess = CompiledFunction("initial_guess", [parameters], [guess])
        self._guess_pullback = CompiledFunction(
            "initial_guess_pullback",
            [parameters, guess_seed],
            [ca.jtimes(guess, parameters, guess_seed, True)],
        )
        self._guess_pushforward = CompiledFunction(
            "initial_guess_pushforward",
            [parameters, guess_direction],
            [ca.jtimes(guess, parameters, guess_direction)],
        )

    def values(self, reference: Array, parameters: Array) -> ConeValues:
        """Values of the subproblem at a reference (the set B of section 3.2.1)."""
        return ConeValues.from_flat(self.pattern, self._values(reference, parameters)[0])

    def values_pullback(
        self, reference: Array, parameters: Array, cotangent: ConeValues
    ) -> tuple[Array, Array]:
        """Eq. d3: gradient with respect to (reference, parameters) from that of the values."""
        pulled = self._pullback(reference, parameters, cotangent.to_flat())
        return pulled[0], pulled[1]

    def values_pushforward(
        self, reference: Array, parameters: Array, d_reference: Array, d_parameters: Array
    ) -> ConeValues:
        """Change of the values along a direction of (reference, parameters)."""
        direction = np.concatenate([d_reference, d_parameters])
        pushed = self._pushforward(reference, parameters, direction)[0]
        return ConeValues.from_flat(self.pattern, pushed)

    def evaluate(self, reference: Array, parameters: Array) -> Evaluation:
        """True cost and defects of a trajectory."""
        cost, defects = self._evaluation(reference, parameters)
        return Evaluation(float(cost[0]), defects.reshape(self.layout.intervals, self.layout.nx))

    def cost_gradient(self, reference: Array, parameters: Array) -> tuple[Array, Array]:
        """Gradient of the true cost with respect to (scaled reference, parameters)."""
        gradient = self._cost_gradient(reference, parameters)
        return gradient[0], gradient[1]

    def initial_guess(self, parameters: Array) -> Array:
        """Reference vector of the first iteration."""
        return self._guess(parameters)[0]

    def initial_guess_pullback(self, parameters: Array, seed: Array) -> Array:
        """Gradient with respect to the parameters through the initial guess."""
        return self._guess_pullback(parameters, seed)[0]

    def initial_guess_pushforward(self, parameters: Array, direction: Array) -> Array:
        """Change of the initial guess along a direction of the parameters."""
        return self._guess_pushforward(parameters, direction)[0]

    def terminal_time(self, reference: Array, parameters: Array) -> float:
        """Terminal time of a trajectory in seconds, decided or given."""
        decided = self.layout.terminal_time(reference)
        if decided is not None:
            return decided
        return float(parameters[self.table.slice(TERMINAL_TIME)][0])

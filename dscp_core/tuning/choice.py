"""Losses by name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dscp_core.errors import InvalidInputError
from dscp_core.gradients.losses import CostLoss, FinalStateLoss, LogConvergenceLoss, Loss
from dscp_core.planning.planner import PlannerSettings
from dscp_core.problem.declaration import OptimalControlProblem, named
from dscp_core.transcription.transcription import Transcription
from dscp_core.tuning.rollout import MissLoss
from dscp_core.tuning.user_function import UserFunction

Array = NDArray[np.float64]

FUEL, COST, CONVERGENCE, ITERATIONS, MISS = "fuel", "cost", "convergence", "iterations", "miss"
LOSSES = (FUEL, COST, CONVERGENCE, ITERATIONS, MISS)

_MASS = "mass"


@dataclass(frozen=True)
class LossChoice:
    """What is minimised; picklable.

    Attributes:
        name: One of `LOSSES`, or as the user's function was given.
        function: The user's, or None.
    """

    name: str
    function: UserFunction | None = None

    @staticmethod
    def parse(text: str) -> LossChoice:
        """A loss by name, or ``FILE.py:FUNCTION``.

        Raises:
            InvalidInputError: Unknown name, or a function that cannot be read.
        """
        if text in LOSSES:
            return LossChoice(text)
        if ".py:" in text:
            return LossChoice(text, UserFunction.read(text))
        raise InvalidInputError("loss", text, f"one of {', '.join(LOSSES)} or FILE.py:FUNCTION")

    @property
    def of_the_path(self) -> bool:
        """Whether it looks at how the iterations went, and not at where they led."""
        return self.name in (CONVERGENCE, ITERATIONS)

    @property
    def counts_iterations(self) -> bool:
        """Whether it is judged by the number of iterations, which has no derivative."""
        return self.name == ITERATIONS

    def is_fuel(self, problem: OptimalControlProblem) -> bool:
        """Whether it is minus the final mass."""
        return self.name == FUEL and _MASS in [s.name for s in problem.states]

    def is_cost(self, problem: OptimalControlProblem) -> bool:
        """Whether it is the problem's cost; fuel is, where there is no mass."""
        return self.name == COST or (self.name == FUEL and not self.is_fuel(problem))

    def make(self, transcription: Transcription, planner: PlannerSettings) -> Loss:
        """The differentiable loss.

        Args:
            transcription: Of the problem.
            planner: How it is planned and flown.

        Raises:
            InvalidInputError: The problem has no such loss.
        """
        problem = transcription.problem
        if self.function is not None:
            from dscp_core.tuning.user_loss import UserLoss  # needs PyTorch

            return UserLoss(self.function)
        if self.of_the_path:
            tolerance = planner.options.cost_tolerance or problem.cost_tolerance
            return LogConvergenceLoss(problem.cost_magnitude or problem.cost_scale, tolerance)
        if self.name == MISS:
            return MissLoss(transcription, planner.hold)
        if self.is_fuel(problem):
            return FinalStateLoss(_MASS, -1.0)
        return CostLoss()


def cost_is_minus_mass(
    problem: OptimalControlProblem, parameters: Array, tuned: Sequence[int]
) -> bool:
    """Whether the cost is minus the final mass, whatever the tuned parameters are.

    Args:
        problem: The declaration.
        parameters: (P,) packed, SI.
        tuned: Indices of those that may change.
    """
    names = [s.name for s in problem.states]
    if _MASS not in names or problem.running_cost is not None or problem.terminal_cost is None:
        return False
    x, time = ca.SX.sym("x", len(names)), ca.SX.sym("t")
    packed = ca.SX.sym("p", problem.table.size)
    cost = problem.terminal_cost(x, time, named(problem, packed))
    rest = cost + x[names.index(_MASS)]
    changing = ca.vertcat(x, time, *(packed[index] for index in tuned))
    slopes = ca.Function("slopes", [x, time, packed], [ca.jacobian(rest, changing)])
    random = np.random.default_rng(0)
    scale = np.array([s.scale for s in problem.states])
    return all(
        np.all(np.array(slopes(scale * random.normal(size=scale.size), 10.0, parameters)) == 0.0)
        for _ in range(3)
    )

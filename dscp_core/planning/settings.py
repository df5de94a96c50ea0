"""How to plan: settings of a planner, and where a terminal time may come from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from dscp_core.planning.plan import TerminalTime
from dscp_core.problem import checks
from dscp_core.problem.declaration import OptimalControlProblem
from dscp_core.problem.flight import ControlHold, Discretisation
from dscp_core.problem.parameters import Value
from dscp_core.scp.scp import ScpOptions

Array = NDArray[np.float64]


class TerminalTimePredictor(Protocol):
    """Predicts the optimal terminal time of a state."""

    def predict(self, state: Array) -> float:
        """Terminal time in seconds for a state (nx,), SI.

        Raises:
            InvalidInputError: It does not know this state.
        """
        ...


@dataclass(frozen=True)
class PlannerSettings:
    """How to plan, and with which parameters; `suited` has what suits a problem.

    The terminal time, the hold and the discretisation may be given by their values too, such as
    ``"free"``.

    Attributes:
        parameters: Vehicle, mission and algorithm parameters that differ from the defaults, SI.
        intervals: Number N of intervals.
        terminal_time: Where the terminal time comes from.
        hold: How the controls are flown between the nodes.
        discretisation: Dynamics of the intervals: those that are flown, or the paper's.
        best_effort: Whether to make the plan of least violation where no feasible one is found.
        options: How to iterate; its deadline is set for every plan.

    Example:
        >>> from dscp_core import PlannerSettings, problems
        >>> settings = PlannerSettings.suited(problems.get("entry"), intervals=60)
        >>> settings.intervals, settings.terminal_time.value
        (60, 'free')
    """

    parameters: Mapping[str, Value] = field(default_factory=dict)
    intervals: int = 50
    terminal_time: TerminalTime = TerminalTime.FIXED
    hold: ControlHold = ControlHold.MEAN
    discretisation: Discretisation = Discretisation.PROPAGATED
    options: ScpOptions = field(default_factory=ScpOptions)
    best_effort: bool = False

    def __post_init__(self) -> None:
        for name, kind in (
            ("terminal_time", TerminalTime),
            ("hold", ControlHold),
            ("discretisation", Discretisation),
        ):
            chosen: Enum = checks.choice(name, getattr(self, name), kind)
            object.__setattr__(self, name, chosen)
        checks.mapping("parameters", self.parameters)
        checks.plain("", self, ScpOptions=ScpOptions)

    @staticmethod
    def suited(problem: OptimalControlProblem, **changes: Any) -> PlannerSettings:
        """Settings with the number of intervals and the terminal time that suit a problem.

        Args:
            problem: The declaration.
            **changes: Other attributes.
        """
        own: dict[str, Any] = {
            "intervals": problem.default_intervals,
            "terminal_time": TerminalTime.FREE
            if problem.free_terminal_time
            else TerminalTime.FIXED,
        }
        return PlannerSettings(**{**own, **changes})

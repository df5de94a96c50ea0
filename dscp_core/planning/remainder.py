"""What is left of a plan that is being flown, to start the next one from."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dscp_core.errors import InvalidInputError
from dscp_core.planning.plan import TerminalTime
from dscp_core.problem.trajectory import Plan
from dscp_core.transcription.layout import TrajectoryLayout

Array = NDArray[np.float64]

# Of a plan's flight time; with less than this left, its grid is too coarse to start from.
_LEAST_REMAINING = 0.05

# Greatest distance of a state from a plan to start from that, in units of the states' scales.
# Farther away, iterations take longer than from none, with a predicted terminal time sooner: in a
# box about the paper's case, 6.2 against 6.2 at 0.05 and 6.5 against 5.0 at 0.1; with a free one,
# 4.9 against 5.2 at 0.1 and 5.7 against 5.5 at 0.2. A fixed one stays that of the plan anyway.
_NEAR = {TerminalTime.PREDICTED: 0.05, TerminalTime.FREE: 0.2, TerminalTime.FIXED: math.inf}


@dataclass(frozen=True)
class Remainder:
    """What is left of a plan: from ``elapsed_s`` on, for ``seconds``.

    Attributes:
        plan: The plan.
        elapsed_s: From its start.
        seconds: To its end.
        distance: Of the state to plan from, in units of the states' scales.
    """

    plan: Plan
    elapsed_s: float
    seconds: float
    distance: float

    @staticmethod
    def of(
        plan: Plan | None, problem: str, elapsed_s: float, state: Array, layout: TrajectoryLayout
    ) -> Remainder | None:
        """What is left of a plan of this problem, where that is enough to start from.

        Raises:
            InvalidInputError: It is no plan.
        """
        given: object = plan
        if given is not None and not isinstance(given, Plan):
            kind = f"a {type(given).__name__}"
            raise InvalidInputError("warm_start", kind, "a Plan, such as outcome.plan")
        if plan is None or plan.problem != problem or not elapsed_s >= 0.0:
            return None
        seconds = plan.terminal_time_s - elapsed_s
        if seconds <= _LEAST_REMAINING * plan.terminal_time_s:
            return None
        planned = np.array([np.interp(elapsed_s, plan.times_s, x) for x in plan.states.T])
        return Remainder(plan, elapsed_s, seconds, layout.relative(state - planned))

    def helps(self, source: TerminalTime) -> bool:
        """Whether it is a start, with a terminal time from this source."""
        return self.distance <= _NEAR[source]

    def reference(self, state: Array, layout: TrajectoryLayout, seconds: float) -> Array:
        """Scaled reference vector from a state on, stretched to a terminal time."""
        plan = self.plan
        moments = np.linspace(self.elapsed_s, plan.terminal_time_s, layout.intervals + 1)
        states, controls = (
            np.column_stack([np.interp(moments, plan.times_s, column) for column in table.T])
            for table in (plan.states, plan.controls)
        )
        states[0] = state
        return layout.reference(states, controls, seconds)

"""When the iterations have converged, and when they will not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

from dscp_core.scp.trace import Iteration
from dscp_core.transcription.layout import TrajectoryLayout

_SETTLED_ITERATIONS = 3
_SETTLED_CHANGE = 1e-3
_SETTLED_DEFECT = 0.05  # of the virtual control


class StoppingRule(Enum):
    """When the iterations have converged.

    GUARDED: the change of the cost, the change that the subproblem predicted, and the defects are
    all small. COST_CHANGE: the paper's rule for reproduction, the change of the true cost alone,
    which may be small for one iteration on the way, at a trajectory that cannot be flown.
    """

    GUARDED = "guarded"
    COST_CHANGE = "cost_change"


@dataclass(frozen=True)
class StoppingTest:
    """Judges the iterations of one run.

    Attributes:
        rule: Which tests count.
        layout: Whose scales residuals are relative to.
        cost_tolerance: Bound on the relative change of the cost.
        defect_tolerance: Bound on the defects, relative to the states' scales.
        virtual_control_tolerance: Bound on the virtual control, likewise.
        least_cost: Scaled cost below which its changes are judged in units of this.
        warm: Whether the run started from a trajectory; then one iteration may be enough.
    """

    rule: StoppingRule
    layout: TrajectoryLayout
    cost_tolerance: float
    defect_tolerance: float
    virtual_control_tolerance: float
    least_cost: float
    warm: bool

    def stationary(self, iterations: Sequence[Iteration], first_cost: float) -> bool:
        """Whether the last iteration changed nothing that matters, feasible or not.

        Args:
            iterations: One or more.
            first_cost: True cost of the reference that the first one started from.
        """
        last = iterations[-1]
        before = iterations[-2] if len(iterations) > 1 else None
        if self.rule is StoppingRule.COST_CHANGE:
            cost = first_cost if before is None else before.cost
            return abs(last.cost - cost) < self.cost_tolerance * abs(cost)
        if before is None and not self.warm:
            return False
        allowed = self.cost_tolerance * max(self.least_cost, abs(last.penalised_cost))
        if abs(last.predicted_change) > allowed:
            return False
        if before is not None and abs(last.penalised_cost - before.penalised_cost) > allowed:
            return False
        return self.layout.relative(last.defects - last.virtual_control) <= self.defect_tolerance

    def infeasible(self, iterations: Sequence[Iteration]) -> bool:
        """Whether the virtual control has stopped at a size that is no rounding.

        Where no trajectory is feasible, the penalty dwarfs the cost and the solver's noise in it
        hides convergence from the tests of the cost.
        """
        last = iterations[-1]
        recent = iterations[-_SETTLED_ITERATIONS:]
        sizes = [self.layout.relative(iteration.virtual_control) for iteration in recent]
        residual = self.layout.relative(last.defects - last.virtual_control)
        return (
            len(sizes) == _SETTLED_ITERATIONS
            and residual <= _SETTLED_DEFECT * min(sizes)
            and min(sizes) > self.virtual_control_tolerance
            and max(sizes) - min(sizes) <= _SETTLED_CHANGE * max(sizes)
        )

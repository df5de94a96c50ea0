"""The entry trajectories of sections 4.2 and 4.3: the paper's four cases, and how they are run."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dscp_core import problems
from dscp_core.scp.scp import Scp, ScpOptions, StoppingRule
from dscp_core.scp.trace import Iteration, ScpResult
from dscp_core.transcription.transcription import Transcription

Array = NDArray[np.float64]

PAPER_INTERVALS = 100
MOST_ITERATIONS = 20
COST_TOLERANCE = 1e-3
"""The paper's epsilon: the iterations stop when J1 changes by less, relative to itself."""
FALSE_STOP_DEFECT = 1e-3
"""Scaled defect above which such a stop is a false one.

It is 100 m of altitude, 10 m/s, or 0.06 deg of flight-path angle in one interval.
"""


@dataclass(frozen=True)
class Case:
    """One of the paper's four choices of trust-region weights.

    Attributes:
        name: ``case1`` to ``case4``.
        log_weights: log10 of w_gamma and w_u.
        paper_iterations: Until convergence; None for not within 20.
    """

    name: str
    log_weights: tuple[float, float]
    paper_iterations: int | None


CASES = (
    Case("case1", (1.429, 1.536), None),
    Case("case2", (1.333, 0.388), 9),
    Case("case3", (1.344, -0.199), 6),
    Case("case4", (1.346, -0.635), 4),
)


class EntryRuns:
    """Runs of the printed formulation with the paper's rule of when to stop."""

    def __init__(self, intervals: int) -> None:
        """Compile the problem.

        Args:
            intervals: Number of intervals N.
        """
        self.transcription = Transcription(problems.get("entry", "printed"), intervals)

    def scp(self, fixed_iterations: int | None = None) -> Scp:
        """A fresh loop: what a solver keeps between runs would make results depend on their order.

        Args:
            fixed_iterations: Run exactly this many; None for the paper's rule.
        """
        options = ScpOptions.for_gradients(
            stopping=StoppingRule.COST_CHANGE,
            cost_tolerance=COST_TOLERANCE,
            max_iterations=MOST_ITERATIONS,
            fixed_iterations=fixed_iterations,
        )
        return Scp(self.transcription, options)

    def parameters(self, log_weights: tuple[float, float], ratio: float = 1.0) -> Array:
        """Packed parameters.

        Args:
            log_weights: log10 of w_gamma and w_u.
            ratio: Surface-to-mass ratio over the nominal one, w_S/m.
        """
        problem = self.transcription.problem
        gamma, control = (10.0**exponent for exponent in log_weights)
        weights = [gamma if state.name == "flight_path_angle" else 0.0 for state in problem.states]
        return problem.pack(
            {
                "trust_region_state": weights,
                "trust_region_control": (control, control),
                "surface_to_mass_ratio": ratio,
            }
        )

    def weight_gradient(self, gradient: Array, log_weights: tuple[float, float]) -> Array:
        """Derivatives by log10 w_gamma and log10 w_u, (2,), from one by all parameters (P,)."""
        table = self.transcription.table
        names = [state.name for state in self.transcription.problem.states]
        by_state = gradient[table.slice("trust_region_state")]
        by_weight = (
            by_state[names.index("flight_path_angle")],
            np.sum(gradient[table.slice("trust_region_control")]),
        )
        return np.array(by_weight) * 10.0 ** np.array(log_weights) * math.log(10.0)

    def largest_defect(self, iteration: Iteration) -> float:
        """Largest residual of the discrete dynamics, relative to the states' scales."""
        return self.transcription.layout.relative(iteration.defects)

    def iterations_needed(self, trace: ScpResult, *, flyable: bool) -> int | None:
        """How many iterations of a longer run the paper's rule would have done.

        Args:
            trace: With a fixed number of iterations.
            flyable: Whether a stop with a large defect does not count.
        """
        costs = [iteration.cost for iteration in trace.iterations]
        for k in range(1, len(costs)):
            settled = abs(costs[k] - costs[k - 1]) < COST_TOLERANCE * abs(costs[k])
            defect = self.largest_defect(trace.iterations[k])
            if settled and not (flyable and defect > FALSE_STOP_DEFECT):
                return k + 1
        return None

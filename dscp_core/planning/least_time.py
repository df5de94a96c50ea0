"""How to look for the least feasible terminal time: by the plan whose cost is the time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from dscp_core.planning.plan import TerminalTime
from dscp_core.planning.settings import PlannerSettings


def fastest(settings: PlannerSettings, parameters: Mapping[str, float]) -> PlannerSettings:
    """Settings whose plan takes the least time.

    Args:
        settings: Of the plans asked about.
        parameters: Values that make the terminal time the cost.
    """
    return replace(
        settings,
        terminal_time=TerminalTime.FREE,
        parameters={**settings.parameters, **parameters},
        best_effort=False,
        # The fastest descent converges slowly; 1e-4 s is enough.
        options=replace(
            settings.options, max_iterations=50, fixed_iterations=None, cost_tolerance=3e-6
        ),
    )

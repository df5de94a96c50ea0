"""What a planner node has to be told before it plans for somebody else."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from dscp_core.problem.declaration import TERMINAL_TIME, OptimalControlProblem
from dscp_core.problem.trajectory import Plan
from dscp_ros.planner.declaration import VEHICLE_PREFIX
from msg_adapters.layout import StateLayout
from msg_adapters.parameters import parameter_to_message_axes


def told_parameters(
    problem: OptimalControlProblem,
    layout: StateLayout,
    values: Mapping[str, Any],
    warm_start: Plan | None,
    elapsed_s: float,
) -> dict[str, Any]:
    """The node's parameters that hold a problem's.

    A changed parameter makes the node forget its warm start; what is left of the time is told.

    Args:
        problem: What is planned.
        layout: Its layout in messages.
        values: Vehicle and mission by name, SI, in the core's axes.
        warm_start: The plan that is flown, or None.
        elapsed_s: Time between its beginning and that of the plan to be made.
    """
    values = dict(values)
    if warm_start is not None:
        declared = problem.table[TERMINAL_TIME]
        left_s = warm_start.terminal_time_s - elapsed_s
        values[TERMINAL_TIME] = float(np.clip(left_s, declared.lower, declared.upper))
    return {
        VEHICLE_PREFIX + name: (
            value
            if isinstance(value, float)
            else parameter_to_message_axes(layout, np.asarray(value).tolist())
        )
        for name, value in values.items()
        if name not in problem.initial_state_parameters  # every state sets those
    }


def differing(wanted: Mapping[str, Any], told: Mapping[str, Any]) -> dict[str, Any]:
    """What is wanted, but was not told."""
    return {
        name: value
        for name, value in wanted.items()
        if name not in told or not np.array_equal(value, told[name])
    }

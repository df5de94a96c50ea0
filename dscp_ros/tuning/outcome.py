"""From a tuning's result to the parameters of a set."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from dscp_core.problem.parameters import Value
from dscp_ros.parameter_set.values import CheckedValues, chosen_names
from dscp_ros.planner.declaration import VEHICLE_PREFIX
from dscp_ros.planner.parameters import NETWORK, PROBLEM
from msg_adapters.layout import problem_layout
from msg_adapters.parameters import parameter_to_message_axes

_PLANNING = (
    "terminal_time_source",
    "intervals",
    "solver",
    "max_iterations",
    "cost_tolerance",
    "defect_tolerance",
    "virtual_control_tolerance",
    "control_hold",
    "discretisation",
)


def set_values(start: CheckedValues, tuned: Mapping[str, Value]) -> dict[str, Any]:
    """Node parameters of a set: those that were started from, with what was tuned.

    Everything that decides about plans is in it, so that a set means the same on every node,
    whatever the defaults are there.

    Args:
        start: What the tuning started from.
        tuned: Parameters that it changed, SI, in the core's axes.

    Raises:
        InvalidInputError: A value is out of bounds.
    """
    problem = start.problem
    layout = problem_layout(problem)
    parameters = problem.table.unpack(problem.pack({**start.planner.parameters, **tuned}))
    vehicle: dict[str, Any] = {}
    for name, value in parameters.items():
        if name in problem.initial_state_parameters:
            continue
        vehicle[VEHICLE_PREFIX + name] = (
            parameter_to_message_axes(layout, value.tolist())
            if isinstance(value, np.ndarray)
            else float(value)
        )
    given = {k: v for k, v in start.given.items() if k not in (NETWORK, PROBLEM.name)}
    planning = {name: start.values[name] for name in _PLANNING}
    return {
        **chosen_names(start.choice, start.formulation),
        **given,
        **planning,
        **vehicle,
    }

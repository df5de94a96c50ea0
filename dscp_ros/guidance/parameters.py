"""The guidance node's own parameters; all others are the planner node's, with the same names."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from dscp_core.errors import InvalidInputError
from dscp_core.problem.declaration import OptimalControlProblem
from dscp_ros.planner.declaration import NodeParameter
from dscp_ros.planner.interface import node_parameter

GUIDANCE_PREFIX = "guidance."
"""What the names of a guidance's settings begin with."""

PLANNER = NodeParameter("planner", "/planner", "Name of the planner node.", read_only=True)


def guidance_parameters(problem: OptimalControlProblem) -> Sequence[NodeParameter]:
    """The node's own parameters.

    Raises:
        InvalidInputError: The problem brings no guidance.
    """
    guided = problem.extras.guidance
    if guided is None:
        raise InvalidInputError("problem", problem.name, "one that brings guidance along")
    settings = [node_parameter(setting) for setting in guided.settings]
    return PLANNER, *(
        replace(
            setting,
            name=GUIDANCE_PREFIX + setting.name,
            description=setting.description + " NaN: what suits the vehicle." * setting.suited,
        )
        for setting in settings
    )


def chosen_settings(values: Mapping[str, Any]) -> dict[str, float]:
    """Settings of guidance by name, without those that are to suit the vehicle."""
    return {
        name.removeprefix(GUIDANCE_PREFIX): value
        for name, value in values.items()
        if name.startswith(GUIDANCE_PREFIX) and not math.isnan(value)
    }

"""What a problem brings to the node besides planning: frame, settings, limits, drawings."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from dscp_core.errors import InvalidInputError
from dscp_core.problem.declaration import OptimalControlProblem
from dscp_core.problem.parameters import Parameter
from dscp_ros.planner.declaration import NodeParameter
from dscp_ros.planner.input_checks import InputSettings
from msg_adapters.drawing import Drawing
from msg_adapters.limits import state_limits

_INPUTS = InputSettings()

_MASS = (
    NodeParameter(
        "mass_max_age_s",
        _INPUTS.mass_max_age_s,
        "Largest age of a mass message, at its arrival and against the state that it completes.",
        "s",
        0.0,
        1e9,
    ),
    NodeParameter(
        "mass_fallback_kg",
        _INPUTS.mass_fallback_kg,
        "Mass for states without a fresh mass message; 0 to refuse such states.",
        "kg",
        0.0,
        1e7,
    ),
)


def check_plannable(problem: OptimalControlProblem) -> None:
    """Refuse a problem that cannot be planned from a state.

    Raises:
        InvalidInputError: Its parameters do not hold the initial state.
    """
    names = problem.initial_state_parameters
    size = sum(problem.table[name].size for name in names)
    if size != len(problem.states):
        raise InvalidInputError(
            f"initial_state_parameters of {problem.name}",
            names,
            f"parameters that hold its {len(problem.states)} states: a node plans from states",
        )


def interface_parameters(problem: OptimalControlProblem) -> tuple[NodeParameter, ...]:
    """Parameters that only this problem has, its frame the first."""
    messages = problem.extras.messages
    frame = NodeParameter(
        messages.frame_parameter, messages.frame, messages.frame_description, read_only=True
    )
    has_mass = messages.odometry is not None and messages.odometry.mass is not None
    settings = (node_parameter(setting) for setting in messages.settings)
    return (frame, *(_MASS if has_mass else ()), *settings)


def node_parameter(declared: Parameter) -> NodeParameter:
    """A problem's setting as a node parameter."""
    default = declared.default
    return NodeParameter(
        declared.name,
        [float(part) for part in default] if isinstance(default, tuple) else float(default),
        declared.description,
        declared.unit,
        declared.lower,
        declared.upper,
        infinite=declared.infinite,
        suited=isinstance(default, float) and math.isnan(default),
    )


def input_settings(
    problem: OptimalControlProblem, values: Mapping[str, Any], parameters: Mapping[str, Any]
) -> InputSettings:
    """What inputs have to satisfy.

    Args:
        problem: The declaration.
        values: Node parameters.
        parameters: The problem's parameters by name, SI, in the core's axes.
    """
    return InputSettings(
        frame=values[problem.extras.messages.frame_parameter],
        state_max_age_s=values["state_max_age_s"],
        mass_max_age_s=values.get("mass_max_age_s", _INPUTS.mass_max_age_s),
        future_tolerance_s=values["future_tolerance_s"],
        mass_fallback_kg=values.get("mass_fallback_kg", _INPUTS.mass_fallback_kg),
        limits=state_limits(problem, parameters, _settings(problem, values)),
    )


def drawing(
    problem: OptimalControlProblem, values: Mapping[str, Any], parameters: Mapping[str, Any]
) -> Drawing | None:
    """How plans are drawn, or None where the problem brings no scene.

    Args:
        problem: The declaration.
        values: Node parameters.
        parameters: The problem's parameters by name, SI, in the core's axes.
    """
    scene = problem.extras.scene
    return None if scene is None else Drawing(scene, parameters, _settings(problem, values))


def _settings(problem: OptimalControlProblem, values: Mapping[str, Any]) -> dict[str, Any]:
    return {s.name: values[s.name] for s in problem.extras.messages.settings}

"""The part of the node that depends on the problem, as data."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from dscp_ros.planner.declaration import NodeParameter, Value
from dscp_ros.planner.input_checks import InputSettings
from msg_adapters.drawing import Drawing

VEHICLE_PREFIX = "parameters."
"""What the names of a problem's own parameters begin with."""


@dataclass(frozen=True)
class ProblemInterface:
    """What the node offers for one problem.

    Attributes:
        parameters: Parameters that only this problem has, its frame among them.
        inputs: Makes of the parameters' values what inputs have to satisfy.
        drawing: Makes of them how plans are drawn.
        odometry: Whether ``~/state`` and ``~/mass`` tell the whole state.
        defaults: Defaults of the other parameters by name, where the problem needs its own.
    """

    parameters: tuple[NodeParameter, ...]
    inputs: Callable[[Mapping[str, Any]], InputSettings]
    drawing: Callable[[Mapping[str, Any]], Drawing]
    odometry: bool
    defaults: Mapping[str, Value] = field(default_factory=dict)

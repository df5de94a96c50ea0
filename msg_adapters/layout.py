"""How a problem's states and controls are named, ordered and limited in messages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property
from typing import Any

import numpy as np

from dscp_core.errors import InvalidInputError
from dscp_core.problem.declaration import OptimalControlProblem
from dscp_core.problem.messages import Odometry
from msg_adapters.frames import Array
from msg_adapters.limits import StateLimits, state_limits, unlimited


class ControlForm(Enum):
    """Where a trajectory point holds the controls."""

    EFFORT = "effort"
    """In ``effort``, at the states that they act on; zero elsewhere."""
    VELOCITIES = "velocities"
    """In ``velocities``: they are the rates of their states; ``effort`` stays empty."""
    NAMED = "positions"
    """In ``positions``, under names of their own after those of the states; their ``velocities``
    are zero, ``effort`` stays empty."""


@dataclass(frozen=True)
class StateLayout:
    """How a problem's state vector is named and ordered in messages.

    Attributes:
        problem: Name of the problem.
        message_names: Names of the state's entries in messages, in message order.
        core_names: Names of the same quantities in the core, in message order.
        state_names: Names of the core's state vector, in the core's order.
        control_names: Names of the core's controls.
        control_states: Index of the core state that each control acts on; may be empty.
        control_form: Where trajectories hold the controls.
        axes: The core's axis that each axis of messages is, or None; of vectors in space.
        frame: Frame of states and plans where nobody names another.
        odometry: Whether position, velocity and mass are the state, and their names in messages.
        limits: Range limits where nobody sets others.
    """

    problem: str
    message_names: tuple[str, ...]
    core_names: tuple[str, ...]
    state_names: tuple[str, ...]
    control_names: tuple[str, ...] = ()
    control_states: tuple[int, ...] = ()
    control_form: ControlForm = ControlForm.NAMED
    axes: tuple[int, int, int] | None = None
    frame: str = "world"
    odometry: Odometry | None = None
    limits: StateLimits = field(default=unlimited)

    def __post_init__(self) -> None:
        if sorted(self.core_names) != sorted(self.state_names):
            raise InvalidInputError(
                f"state of {self.problem}", self.state_names, f"names {self.core_names}"
            )
        names = self.joint_names
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise InvalidInputError(f"names in messages of {self.problem}", twice, "each name once")
        if self.odometry is not None and sorted(self.odometry.names) != sorted(self.message_names):
            raise InvalidInputError(
                f"odometry of {self.problem}", self.odometry.names, f"names {self.message_names}"
            )

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of a trajectory: the states', and the controls' where they have their own."""
        if self.control_form is ControlForm.NAMED:
            return (*self.message_names, *self.control_names)
        return self.message_names

    @cached_property
    def _core_index(self) -> list[int]:
        return [self.state_names.index(name) for name in self.core_names]

    @cached_property
    def _message_index(self) -> list[int]:
        return [self.core_names.index(name) for name in self.state_names]

    def to_message_order(self, values: Array) -> Array:
        """Values (..., nx) from the core's order to message order."""
        return np.asarray(values, dtype=np.float64)[..., self._core_index]

    def to_core_order(self, values: Array) -> Array:
        """Values (..., nx) from message order to the core's order."""
        return np.asarray(values, dtype=np.float64)[..., self._message_index]

    def to_message_axes(self, vectors: Array) -> Array:
        """Vectors (..., 3) in space from the core's axes to those of messages."""
        axes = (0, 1, 2) if self.axes is None else self.axes
        return np.asarray(vectors, dtype=np.float64)[..., axes]

    def to_core_axes(self, vectors: Array) -> Array:
        """Vectors (..., 3) in space from the axes of messages to the core's."""
        axes = (0, 1, 2) if self.axes is None else self.axes
        return np.asarray(vectors, dtype=np.float64)[..., np.argsort(axes)]


def problem_layout(
    problem: OptimalControlProblem,
    parameters: Mapping[str, Any] | None = None,
    settings: Mapping[str, Any] | None = None,
) -> StateLayout:
    """Layout of a problem.

    Args:
        problem: The declaration.
        parameters: Every parameter by name, SI, for the limits; None for the defaults.
        settings: Settings that the problem brings, by name; None for the defaults.

    Raises:
        InvalidInputError: What the problem says of messages does not fit its declaration.
    """
    messages = problem.extras.messages
    names = tuple(state.name for state in problem.states)
    pairs = messages.states or tuple(zip(names, names, strict=True))
    if parameters is None:
        parameters = problem.table.unpack(problem.table.pack())
    if settings is None:
        settings = {setting.name: setting.default for setting in messages.settings}
    return StateLayout(
        problem=problem.name,
        message_names=tuple(message_name for message_name, _ in pairs),
        core_names=tuple(core_name for _, core_name in pairs),
        state_names=names,
        control_names=tuple(control.name for control in problem.controls),
        control_states=tuple(problem.control_states),
        control_form=_control_form(problem.control_states, rates=messages.controls_are_rates),
        axes=messages.axes,
        frame=messages.frame,
        odometry=messages.odometry,
        limits=state_limits(problem, parameters, settings),
    )


def _control_form(control_states: Sequence[int], *, rates: bool) -> ControlForm:
    if not control_states or len(set(control_states)) != len(control_states):
        return ControlForm.NAMED
    return ControlForm.VELOCITIES if rates else ControlForm.EFFORT

"""How a problem is told of in messages, as plain data: names, axes, limits. Knows no ROS.

A problem that says nothing has the generic form: its states as named scalars in their own order,
bounds from its declaration, no odometry.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from dscp_core.errors import InvalidInputError
from dscp_core.problem.parameters import Parameter


class StateLimit(Enum):
    """Which kind of limit a state breaks; each has a number of its own in reports."""

    OUT_OF_RANGE = "out of range"
    BELOW_GROUND = "below ground"
    MASS_NOT_POSITIVE = "mass not positive"


class StateLimitError(InvalidInputError):
    """A state that is taken for an error.

    Attributes:
        kind: What is wrong with it.
    """

    def __init__(self, kind: StateLimit, field: str, value: Any, bound: str) -> None:
        super().__init__(field, value, bound)
        self.kind = kind

    def __reduce__(self) -> tuple[Any, ...]:
        """Rebuild from the parts; see `InvalidInputError`."""
        return type(self), (self.kind, self.field, self.value, self.bound)


Admit = Callable[[Mapping[str, float], Mapping[str, Any], Mapping[str, Any]], Mapping[str, float]]
"""Scalars by the names of messages, parameters by name (SI), settings by name; to the scalars as
they are planned from, for example with angles turned to one branch. Raises `StateLimitError`, or
`InvalidInputError`, which means out of range. Odometry brings positions and velocities alone first,
then the whole state."""


@dataclass(frozen=True)
class Odometry:
    """Which scalars are a position and a velocity in right-handed axes, z up.

    Attributes:
        position: Names, in messages, of the position along x, y and z, m.
        velocity: Those of the velocity, m/s.
        mass: That of the mass, kg, or None. With the others, these are all states.

    Example:
        >>> from dscp_core import Odometry
        >>> Odometry(mass="mass").names
        ('x', 'y', 'z', 'vx', 'vy', 'vz', 'mass')
    """

    position: tuple[str, str, str] = ("x", "y", "z")
    velocity: tuple[str, str, str] = ("vx", "vy", "vz")
    mass: str | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """All of them."""
        return (*self.position, *self.velocity, *(() if self.mass is None else (self.mass,)))


@dataclass(frozen=True)
class Messages:
    """What messages say of a problem.

    Attributes:
        states: Pairs of the name in messages and the state's name, in the order of messages; empty
            for the states as they are.
        axes: The core's axis that each axis of messages is, for vector parameters of length 3, or
            None if they are no vectors in space. Vector parameters as long as the state follow
            `states`.
        controls_are_rates: Whether each control is the rate of its state in ``control_states``,
            and not an effort on it.
        frame: Frame of states and plans.
        frame_parameter: Name of the setting that renames the frame.
        frame_description: What that frame is.
        odometry: Whether position, velocity and mass are the state, or None if not.
        settings: Further settings, for `admit` and the scene; in the axes of messages.
        defaults: Defaults of a planner's other settings that suit the problem, by name.
        admit: Checks a state's scalars; None for the bounds of the initial state's parameters and
            the problem's ``check_state``.

    Example:
        >>> from dscp_core import Extras, Messages, Odometry
        >>> Extras(messages=Messages(frame="station", odometry=Odometry())).messages.frame
        'station'
    """

    states: tuple[tuple[str, str], ...] = ()
    axes: tuple[int, int, int] | None = None
    controls_are_rates: bool = False
    frame: str = "world"
    frame_parameter: str = "frame"
    frame_description: str = "Frame of states and plans."
    odometry: Odometry | None = None
    settings: tuple[Parameter, ...] = ()
    defaults: Mapping[str, bool | int | float | str | Sequence[float]] = field(default_factory=dict)
    admit: Admit | None = None

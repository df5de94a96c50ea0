"""Guidance of a problem, as a node runs it: states and plans in, commands and plan requests out."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from dscp_core.problem.parameters import Parameter
from dscp_core.problem.trajectory import Plan

Array = NDArray[np.float64]


class Request(Protocol):
    """What guidance asks a planner for."""

    @property
    def start_s(self) -> float:
        """When the plan is to begin, in flight time."""
        ...

    @property
    def state(self) -> Array:
        """(nx,) that is expected then, SI, in the problem's order."""
        ...

    @property
    def parameters(self) -> Mapping[str, Any]:
        """Those of the planner that differ from the mission's, by name, SI."""
        ...

    @property
    def warm_start(self) -> Plan | None:
        """The plan that is flown, or None."""
        ...

    @property
    def elapsed_s(self) -> float:
        """Time between that plan's beginning and this one's."""
        ...


class Answer(Protocol):
    """What a planner answers; a `dscp_core.planning.plan.PlanOutcome` is one."""

    @property
    def certified(self) -> bool:
        """Whether the plan passed its certificate; no other is flown."""
        ...

    @property
    def plan(self) -> Plan | None:
        """The plan, if there is one."""
        ...


class Guidance(Protocol):
    """Guides one flight. It has no clock: flight time is told, and never goes back.

    At each tick: `measure` and `take_plan` for what came, `command`, `plan_request`.
    """

    @property
    def tick_s(self) -> float:
        """From one command to the next."""
        ...

    @property
    def phase(self) -> Enum:
        """What it does; the value is a word for people."""
        ...

    @property
    def follows_plan(self) -> bool:
        """Whether it flies a plan now; a revoked one is worth a warning only then."""
        ...

    @property
    def waits(self) -> bool:
        """Whether it has no plan yet, and commands nothing; else None commands an engine off."""
        ...

    def measure(self, time_s: float, state: Array) -> None:
        """Take a state (nx,), SI; with no known delay, true at that time."""
        ...

    def take_plan(self, request: Any, outcome: Answer, now_s: float) -> bool:
        """Take the answer to a request, however late; whether its plan is flown."""
        ...

    def plan_request(self, time_s: float) -> Request | None:
        """What the planner is to plan now, or None. To be asked after this tick's command."""
        ...

    def command(self, time_s: float) -> Array | None:
        """Force (3,) in N to be commanded now, in the core's axes; None for no force."""
        ...


class Guided(Protocol):
    """Makes the guidance of a problem."""

    @property
    def settings(self) -> tuple[Parameter, ...]:
        """What can be chosen of it; a default of NaN stands for what suits the vehicle."""
        ...

    def __call__(self, planner: Any, state: Array, settings: Mapping[str, float]) -> Guidance:
        """Guidance of a flight that begins now.

        Args:
            planner: A `dscp_core.planning.planner.Planner`: vehicle, mission and how to plan. It
                plans once, for what suits the vehicle.
            state: (nx,) where the vehicle is, SI.
            settings: By name, SI; without those that are to suit the vehicle.

        Raises:
            InvalidInputError: An unknown setting or a bad value.
            DscpError: No plan leads from this state to the target.
        """
        ...

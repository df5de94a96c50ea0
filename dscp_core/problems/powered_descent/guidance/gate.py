"""Plans to the gate: when to ask for one, with which limits, and which one to keep."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from dscp_core.problem.flight import ControlHold
from dscp_core.problem.guidance import Answer
from dscp_core.problem.trajectory import Plan
from dscp_core.problems.powered_descent.guidance.reference import Reference
from dscp_core.problems.powered_descent.guidance.settings import GuidanceSettings
from dscp_core.problems.powered_descent.guidance.vehicle import Array, Motion, Vehicle

_RELEASED = (1.0, 0.8, 0.5, 0.0)
"""Part of the reserve that a plan keeps, after so many refusals in a row."""
_RECOVERED = 0.05
"""Part of the reserve that the next plan keeps again."""

_ANGLE_MARGIN_RAD = 2e-3
"""By which the cone of a plan is wider than the line of sight that it begins on."""


_SOON_S = 1e-9
"""Rounding of times."""
_SAME = 1e-3
"""In m, m/s and kg: what solvers and messages leave of a start."""


@dataclass(frozen=True)
class PlanRequest:
    """What guidance asks a planner for.

    Attributes:
        made_at_s: When it is asked.
        start_s: When the plan is to begin.
        state: (7,) expected then, SI, core axes.
        parameters: Those of the planner that differ from the mission's, by name, SI.
        warm_start: The plan that is flown, to start from, or None.
        elapsed_s: Time between that plan's beginning and this one's.
        reserve: Part of the greatest thrust that the plan leaves.
    """

    made_at_s: float
    start_s: float
    state: Array
    parameters: Mapping[str, Any]
    warm_start: Plan | None
    elapsed_s: float
    reserve: float


class GatePlanning:
    """Asks for plans, and keeps the one that is flown.

    Attributes:
        kept: The plan that is flown; None before the first.
    """

    def __init__(
        self,
        settings: GuidanceSettings,
        vehicle: Vehicle,
        values: Mapping[str, Any],
        hold: ControlHold,
    ) -> None:
        self._settings, self._vehicle, self._hold = settings, vehicle, hold
        self._pad = np.asarray(values["final_position"], dtype=np.float64)
        self._glideslope_rad = float(values["glideslope_angle_max"])
        self.kept: Reference | None = None
        self._coming: list[Reference] = []
        self._first_start_s = 0.0
        self._asked: PlanRequest | None = None
        self._next_s = -math.inf
        self._refused = 0
        self._level = 1.0

    def due(self, time_s: float) -> bool:
        """Whether a plan should be asked for now."""
        asked = self._asked
        settings = self._settings
        patience_s = max(settings.answer_timeout_s, 2.0 * settings.known_planning_latency_s)
        if asked is not None and time_s < asked.made_at_s + patience_s:
            return False
        if time_s < self._next_s - 1e-9:
            return False
        return self.kept is None or self.kept.end_s - time_s >= settings.last_replan_s

    def start_s(self, time_s: float) -> float:
        """When a plan that is asked for now can come into effect: at the tick after it came."""
        settings = self._settings
        ticks = math.ceil(settings.known_planning_latency_s / settings.tick_s - 1e-9)
        return time_s + ticks * settings.tick_s + settings.known_command_latency_s

    def request(self, time_s: float, expected: Motion) -> PlanRequest:
        """Ask for a plan from what is expected at its start."""
        reserve = self._reserve(expected.time_s) * self._level * self._released
        vehicle, kept = self._vehicle, self.kept
        least = vehicle.thrust_min_n * (1.0 + self._settings.floor_reserve)
        descent = [-self._settings.gate_descent_m_s, 0.0, 0.0]
        self._asked = PlanRequest(
            made_at_s=time_s,
            start_s=expected.time_s,
            state=np.array([*expected.position, *expected.velocity, expected.mass]),
            parameters={
                "thrust_max": max((1.0 - reserve) * vehicle.thrust_max_n, least),
                "thrust_min": least,
                "gate_height": self._settings.gate_altitude_m,
                "final_velocity": descent,
                "glideslope_angle_max": self._approach_angle_rad(expected),
            },
            warm_start=None if kept is None else kept.plan,
            elapsed_s=0.0 if kept is None else expected.time_s - kept.start_s,
            reserve=reserve,
        )
        self._next_s = time_s + self._settings.replan_s
        return self._asked

    def take(self, request: PlanRequest, outcome: Answer, now_s: float) -> bool:
        """Take an answer, however late; whether its plan is kept.

        A plan is flown on from where it would be by now. It is refused if it is not certified, does
        not begin where it was asked for, is over, or began before the one that is flown. After a
        refusal the next plan is asked for at once, with less and less of the reserve, at last with
        none; the old one is flown on meanwhile. What was released comes back little by little. An
        early plan is flown from its start on.
        """
        if self._asked is request:
            self._asked = None
        if not outcome.certified or outcome.plan is None or not _begins(outcome.plan, request):
            self._refused += 1
            if self._refused < len(_RELEASED):
                self._next_s = now_s
            return False
        self._level = min(self._level * self._released + _RECOVERED, 1.0)
        self._refused = 0
        reference = Reference(outcome.plan, request.start_s, self._hold)
        newest = self._coming[-1] if self._coming else self.kept
        if reference.end_s <= now_s or (newest is not None and newest.start_s >= reference.start_s):
            return False
        if newest is None:
            self._first_start_s = reference.start_s
        self._coming.append(reference)
        self.switch(now_s + self._settings.known_command_latency_s)
        return True

    def flown_at(self, time_s: float) -> Reference | None:
        """The plan that will be flown then, as far as is known."""
        begun = [plan for plan in self._coming if plan.start_s <= time_s + _SOON_S]
        return begun[-1] if begun else self.kept

    def switch(self, time_s: float) -> None:
        """From now on fly what is to be flown then, when a command comes into effect."""
        self.kept = self.flown_at(time_s)
        self._coming = [plan for plan in self._coming if plan.start_s > time_s + _SOON_S]

    def _approach_angle_rad(self, expected: Motion) -> float:
        """Of the cone of the next plan: narrow where possible; after refusals the mission's."""
        if self._refused >= len(_RELEASED) - 1:
            return self._glideslope_rad
        up, *across = np.asarray(expected.position) - self._pad
        seen_rad = math.atan2(math.hypot(*across), max(float(up), 0.0))
        wanted_rad = max(self._settings.approach_angle_max_rad, seen_rad + _ANGLE_MARGIN_RAD)
        return min(self._glideslope_rad, wanted_rad)

    @property
    def _released(self) -> float:
        return _RELEASED[min(self._refused, len(_RELEASED) - 1)]

    def _reserve(self, start_s: float) -> float:
        early = self._settings.early_reserve
        if self.kept is not None:
            to_go_s = max(self.kept.end_s - start_s, 0.0)
            early *= math.sqrt(to_go_s / max(self.kept.end_s - self._first_start_s, 1e-9))
        return self._settings.reserve + early


def _begins(plan: Plan, request: PlanRequest) -> bool:
    """Whether a plan begins where it was asked for: another vehicle's does not."""
    start = plan.states[0]
    return start.shape == request.state.shape and np.allclose(start, request.state, 1e-6, _SAME)

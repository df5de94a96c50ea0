"""The guidance of one landing: measurements and plans in, thrust commands and plan requests out."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from typing import Any

import numpy as np

from dscp_core.problem.flight import ControlHold
from dscp_core.problem.guidance import Answer
from dscp_core.problems.powered_descent.guidance.gate import GatePlanning, PlanRequest
from dscp_core.problems.powered_descent.guidance.laws import (
    contact_speed_m_s,
    profile_thrust,
    tracking_thrust,
)
from dscp_core.problems.powered_descent.guidance.observer import Observer
from dscp_core.problems.powered_descent.guidance.settings import GuidanceSettings
from dscp_core.problems.powered_descent.guidance.vehicle import Array, Engine, Motion, Vehicle


class Phase(Enum):
    """What guidance does.

    WAITING: there is no plan yet, the engine is off. TRACKING: follows the plan to the gate.
    PROFILE: follows the altitude-speed profile to the ground. CUT_OFF: the engine is off for good.
    """

    WAITING = "waiting"
    TRACKING = "tracking"
    PROFILE = "profile"
    CUT_OFF = "cut off"


class LandingGuidance:
    """Lands one vehicle once.

    It has no clock: every call says when it is, in one flight time that never goes back. At each
    tick: `measure`, `take_plan` for whatever came, `command`, `plan_request`.
    """

    def __init__(
        self, values: Mapping[str, Any], settings: GuidanceSettings, hold: ControlHold
    ) -> None:
        """Before the first measurement.

        Args:
            values: Parameters of powered descent by name, SI: vehicle and mission as assumed.
            settings: How to guide; `GuidanceSettings.suited` has what suits the vehicle.
            hold: How planned thrust is held between nodes: `PlannerSettings.hold`.
        """
        self.settings, self.vehicle = settings, Vehicle.of(values)
        self._engine = Engine(
            self.vehicle,
            lag_s=settings.known_lag_s,
            attitude_response_s=settings.known_attitude_response_s,
            throttle_rate_n_s=settings.known_throttle_rate_n_s,
            latency_s=settings.known_command_latency_s,
        )
        self.observer = Observer(settings, self._engine)
        self.planning = GatePlanning(settings, self.vehicle, values, hold)
        self.phase = Phase.WAITING

    @property
    def tick_s(self) -> float:
        """From one command to the next."""
        return self.settings.tick_s

    @property
    def waits(self) -> bool:
        """Whether there is no plan yet, and nothing to command."""
        return self.phase is Phase.WAITING

    @property
    def follows_plan(self) -> bool:
        """Whether it flies a plan now, and not the profile."""
        return self.phase is Phase.TRACKING

    def measure(self, time_s: float, state: Array) -> None:
        """Take what navigation tells (7,), SI, core axes, of the declared delay ago.

        Raises:
            InvalidInputError: It is not finite, without mass, or not after the one before.
        """
        self.observer.measure(time_s, state)

    def take_plan(self, request: PlanRequest, outcome: Answer, now_s: float) -> bool:
        """Take the answer to a request, however late; whether its plan is flown."""
        return self.planning.take(request, outcome, now_s)

    def plan_request(self, time_s: float) -> PlanRequest | None:
        """What the planner is to plan now, or None. To be asked after this tick's command."""
        if self.phase in (Phase.PROFILE, Phase.CUT_OFF) or not self.observer.started:
            return None
        if not self.planning.due(time_s):
            return None
        return self.planning.request(time_s, self._expected(time_s))

    def command(self, time_s: float) -> Array | None:
        """Thrust (3,) in N to be commanded now, or None while the engine is to be off.

        Raises:
            InvalidInputError: There was no measurement yet, none for very long, or a later command.
        """
        now = self.observer.at(time_s + self.settings.known_command_latency_s)
        self.planning.switch(now.time_s)
        self.phase = self._next_phase(now)
        if self.phase is Phase.WAITING:
            return None
        force = self._thrust(now)
        if self.phase is Phase.PROFILE and self._is_time_to_cut_off(now, force):
            self.phase, force = Phase.CUT_OFF, np.zeros(3)
        self._engine.command(time_s, force)
        return force if self.phase is not Phase.CUT_OFF else None

    def _next_phase(self, now: Motion) -> Phase:
        kept, settings = self.planning.kept, self.settings
        if self.phase is Phase.WAITING and kept is not None:
            return Phase.TRACKING
        if self.phase is Phase.TRACKING:
            assert kept is not None
            # The command is felt one lag later.
            altitude = now.position[0] + now.velocity[0] * settings.known_lag_s
            low = altitude <= self.vehicle.pad_m[0] + settings.gate_altitude_m
            if low or now.time_s + settings.known_lag_s >= kept.end_s:
                return Phase.PROFILE
        return self.phase

    def _is_time_to_cut_off(self, now: Motion, force: Array) -> bool:
        """Whether another tick of thrust would end harder than none."""
        settings, pad_m = self.settings, float(self.vehicle.pad_m[0])
        braking = now.thrust_n / now.mass * (settings.known_lag_s + 2.0 * settings.tick_s)
        if not settings.cut_off or -now.velocity[0] > braking + settings.contact_descent_m_s:
            return False
        at_once, later = (
            contact_speed_m_s(self._engine, pad_m, now, force, held_s, self.observer.bias)
            for held_s in (0.0, settings.tick_s)
        )
        return at_once <= later

    def _thrust(self, now: Motion) -> Array:
        if self.phase is Phase.CUT_OFF:
            return np.zeros(3)
        bias = self.observer.bias
        if self.phase is Phase.PROFILE:
            return profile_thrust(self.settings, self.vehicle, now, bias)
        assert self.planning.kept is not None
        return tracking_thrust(self.settings, self.vehicle, self.planning.kept, now, bias)

    def _expected(self, time_s: float) -> Motion:
        """The motion when a plan asked for now will start, on what will be commanded until then."""
        settings, latency_s = self.settings, self.settings.known_command_latency_s
        start_s = self.planning.start_s(time_s)
        more: list[tuple[float, Array]] = []
        tick = 1
        while (effect_s := time_s + tick * settings.tick_s + latency_s) < start_s - 1e-9:
            plan = self.planning.flown_at(effect_s)
            if plan is not None:
                _, _, mass = plan.state(effect_s)
                thrust = plan.thrust(effect_s + settings.known_lag_s, settings.tick_s)
                scale = self.observer.at(time_s).mass / mass
                more.append((effect_s, thrust * scale))
            tick += 1
        return self.observer.at(start_s, tuple(more))

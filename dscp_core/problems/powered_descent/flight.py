"""One closed-loop landing, tick by tick: truth on one side, guidance on the other."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from dscp_core.planning.plan import PlanOutcome
from dscp_core.planning.planner import Planner
from dscp_core.problems.powered_descent.guidance.gate import PlanRequest
from dscp_core.problems.powered_descent.guidance.landing import LandingGuidance, Phase
from dscp_core.problems.powered_descent.guidance.settings import GuidanceSettings
from dscp_core.problems.powered_descent.motion import Array, Event, TrueMotion
from dscp_core.problems.powered_descent.truth import TruthSettings, World

_SOON_S = 1e-9
"""Rounding of times."""


@dataclass
class Replan:
    """One planning attempt in flight.

    Attributes:
        tick: Index of the tick at which it was asked for.
        outcome: What came of it; None where the planner did not answer.
        thrust_max_n: Greatest thrust that it was allowed to plan with.
        answered_s: When its answer came; infinite without one.
        flown: Whether its plan was flown.
    """

    tick: int
    outcome: PlanOutcome | None
    thrust_max_n: float
    answered_s: float = math.inf
    flown: bool = False


class Flight:
    """Flies one landing to the ground."""

    def __init__(
        self,
        planner: Planner,
        motion: TrueMotion,
        values: Mapping[str, Any],
        guidance: GuidanceSettings,
        truth: TruthSettings,
        seed: int,
    ) -> None:
        self.world = World(motion, values, truth, seed)
        self.guidance = LandingGuidance(values, guidance, planner.settings.hold)
        self.replans: list[Replan] = []
        self.times: list[float] = []
        self.states: list[Array] = []
        self.measured: list[Array] = []
        self.commanded: list[Array] = []
        self.thrusts: list[Array] = []
        self.phases: list[str] = []
        self.events: list[tuple[float, str]] = [(0.0, f"start, seed {seed}")]
        self._planner, self._values, self._truth = planner, values, truth
        self._tick_s = guidance.tick_s
        self._nominal = planner.parameters
        self._sent: list[tuple[float, Array | None]] = []
        self._samples: list[Array] = []
        self._sampled = 0
        self._answer: tuple[PlanRequest, PlanOutcome, Replan] | None = None
        self._busy_until_s = -math.inf

    def fly(self, longest_s: float) -> None:
        """Fly until contact, or for so long."""
        tick = 0
        self._sample_until(0.0)
        while True:
            time_s = tick * self._tick_s
            if self.world.landed or time_s > longest_s:
                break
            self._guide(tick, time_s)
            self.world.blow(self._tick_s)
            tick += 1
            self._fly_to(tick * self._tick_s)
        self._keep(self.world.time_s, self.world.measure(self.world.state[:7]))
        self.commanded.append(self.commanded[-1] if self.commanded else np.zeros(3))
        self.phases.append(self.guidance.phase.value)
        if self.world.dry_s < math.inf:
            self.events.append((self.world.dry_s, Event.DRY.value))
        if self.world.landed:
            self.events.append((self.world.time_s, Event.CONTACT.value))
        self.events.sort(key=lambda event: event[0])

    def _guide(self, tick: int, time_s: float) -> None:
        """What guidance does at one tick."""
        guidance, before = self.guidance, self.guidance.phase
        measured = self.world.measure(self._samples.pop(0))
        guidance.measure(time_s, measured)
        if self._answer is not None and self._answer[2].answered_s <= time_s + _SOON_S:
            request, outcome, replan = self._answer
            self._answer = None
            replan.flown = guidance.take_plan(request, outcome, time_s)
        force = guidance.command(time_s)
        if guidance.phase is not Phase.WAITING:
            self._sent.append((time_s + self._truth.command_latency_s, force))
        if guidance.phase is not before:
            self.events.append((time_s, guidance.phase.value))
        request_now = guidance.plan_request(time_s)
        if request_now is not None:
            self._plan(tick, time_s, request_now)
        self._keep(time_s, measured)
        self.commanded.append(np.zeros(3) if force is None else force)
        self.phases.append(guidance.phase.value)

    def _keep(self, time_s: float, measured: Array) -> None:
        self.times.append(time_s)
        self.states.append(self.world.state[:7].copy())
        self.measured.append(measured)
        self.thrusts.append(self.world.thrust)

    def _plan(self, tick: int, time_s: float, request: PlanRequest) -> None:
        truth = self._truth
        replan = Replan(tick, None, float(request.parameters["thrust_max"]))
        self.replans.append(replan)
        out = truth.outage_start_s <= time_s + _SOON_S < truth.outage_start_s + truth.outage_s
        if out or time_s < self._busy_until_s - _SOON_S:
            self.events.append((time_s, "the planner does not answer"))
            return
        table = self._planner.problem.table
        try:
            self._planner.parameters = table.pack(request.parameters, self._nominal)
            outcome = self._planner.plan(
                request.state, warm_start=request.warm_start, elapsed_s=request.elapsed_s
            )
        finally:
            self._planner.parameters = self._nominal
        takes_s = truth.planning_latency_s
        if takes_s < 0.0:
            takes_s = outcome.solve_time_s
        if self.world.planner.random() < truth.late_plans:
            takes_s += truth.late_plan_s
        replan.outcome, replan.answered_s = outcome, time_s + takes_s
        self._busy_until_s = replan.answered_s
        self._answer = (request, outcome, replan)
        self.events.append((time_s, f"plan {outcome.status.name}: {outcome.message}"))

    def _fly_to(self, time_s: float) -> None:
        """Fly to a time, with what happens on the way: commands arrive, navigation samples."""
        while self._sent and self._sent[0][0] <= time_s + _SOON_S:
            switch_s, force = self._sent.pop(0)
            self._sample_until(switch_s)
            if not self.world.fly(switch_s):
                return
            self.world.set_command(force)
        self._sample_until(time_s)
        self.world.fly(time_s)

    def _sample_until(self, time_s: float) -> None:
        """Let navigation sample the state, for measurements that come a delay later."""
        while (at_s := self._sampled * self._tick_s - self._truth.delay_s) <= time_s + _SOON_S:
            if at_s <= 0.0:
                self._samples.append(self.world.before_start(-at_s))
            elif self.world.fly(at_s):
                self._samples.append(self.world.state[:7].copy())
            else:
                return
            self._sampled += 1

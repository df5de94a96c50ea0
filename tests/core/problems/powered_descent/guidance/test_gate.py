from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dscp_core import problems
from dscp_core.planning.plan import PlanOutcome, PlanStatus, TerminalTime
from dscp_core.planning.planner import Planner
from dscp_core.problem.flight import ControlHold
from dscp_core.problems.powered_descent.guidance.gate import GatePlanning, PlanRequest
from dscp_core.problems.powered_descent.guidance.reference import Reference
from dscp_core.problems.powered_descent.guidance.settings import GuidanceSettings
from dscp_core.problems.powered_descent.guidance.vehicle import Motion, Vehicle

SETTINGS = GuidanceSettings()


@pytest.fixture(scope="module")
def planner() -> Planner:
    return Planner(problems.get("powered_descent"), terminal_time=TerminalTime.FREE)


@pytest.fixture(scope="module")
def outcome(planner: Planner) -> PlanOutcome:
    outcome = planner.plan()
    assert outcome.plan is not None
    return outcome


@pytest.fixture
def planning(planner: Planner) -> GatePlanning:
    values = planner.problem.table.unpack(planner.parameters)
    return GatePlanning(SETTINGS, Vehicle.of(values), values, ControlHold.MEAN)


def ask(planning: GatePlanning, time_s: float) -> PlanRequest:
    start_s = planning.start_s(time_s)
    position, velocity = np.array([5000.0, 500.0, 500.0]), np.array([-150.0, 30.0, -30.0])
    return planning.request(time_s, Motion(start_s, position, velocity, 38000.0))


def test_a_plan_is_asked_for_to_the_gate_with_a_reserve(planning: GatePlanning) -> None:
    request = ask(planning, 0.0)
    assert request.start_s == pytest.approx(0.12)  # the tick after it came, and the latency
    assert request.parameters["gate_height"] == pytest.approx(6.0)
    assert request.parameters["final_velocity"] == pytest.approx([-6.86, 0.0, 0.0], abs=0.01)
    assert request.parameters["thrust_max"] == pytest.approx(0.92 * 845.2e3)


def test_plans_leave_air_below_where_the_mission_does_not(
    planner: Planner, outcome: PlanOutcome
) -> None:
    values = planner.problem.table.unpack(planner.parameters) | {"glideslope_angle_max": 1.57}
    planning = GatePlanning(SETTINGS, Vehicle.of(values), values, ControlHold.MEAN)
    assert ask(planning, 0.0).parameters["glideslope_angle_max"] == 1.5
    flat = Motion(1.0, np.array([15e3, 520e3, 0.0]), np.zeros(3), 38000.0)
    seen = np.arctan2(520.0, 15.0)
    asked = planning.request(1.0, flat)
    assert seen < asked.parameters["glideslope_angle_max"] < 1.57
    for _ in range(3):
        planning.take(asked, replace(outcome, status=PlanStatus.INFEASIBLE), 1.1)
        asked = planning.request(1.1, flat)
    assert asked.parameters["glideslope_angle_max"] == 1.57


def test_the_reserve_is_given_back_and_planning_ends(
    planning: GatePlanning, outcome: PlanOutcome
) -> None:
    request = ask(planning, 0.0)
    assert planning.take(request, outcome, 0.1)
    assert not planning.due(0.9)
    assert planning.due(1.0)
    late = ask(planning, 24.5)
    # A quarter of the time is left: half of the early reserve.
    assert late.reserve == pytest.approx(0.03 + 0.025, abs=1e-3)
    assert late.warm_start is outcome.plan
    assert late.elapsed_s == pytest.approx(24.5)
    planning.take(late, replace(outcome, status=PlanStatus.INFEASIBLE), 24.6)
    assert planning.kept is not None
    assert not planning.due(planning.kept.end_s - SETTINGS.last_replan_s + 0.01)


def test_refusals_spend_the_reserve_and_keep_the_old_plan(
    planning: GatePlanning, outcome: PlanOutcome
) -> None:
    assert planning.take(ask(planning, 0.0), outcome, 0.1)
    kept, refusal = planning.kept, replace(outcome, status=PlanStatus.INFEASIBLE)
    reserves = []
    for time_s in (1.0, 1.1, 1.2, 1.3):
        assert planning.due(time_s)
        request = ask(planning, time_s)
        reserves.append(request.reserve)
        assert not planning.take(request, refusal, time_s + 0.02)
        assert planning.kept is kept
    assert reserves[1:3] == pytest.approx([0.8 * reserves[0], 0.5 * reserves[0]], rel=0.02)
    assert reserves[3] == 0.0
    assert not planning.due(1.4)  # everything was tried: the period again
    assert planning.due(2.3)
    assert planning.take(ask(planning, 2.3), outcome, 2.4)
    assert 0.0 < ask(planning, 3.3).reserve < 0.01  # it comes back little by little


def test_a_late_plan_is_flown_from_where_it_would_be(
    planning: GatePlanning, outcome: PlanOutcome
) -> None:
    first, second = ask(planning, 0.0), None
    assert not planning.due(1.9)
    assert planning.due(2.0)  # no answer in time: asked again
    second = ask(planning, 2.0)
    assert planning.take(first, outcome, 5.0)
    assert planning.kept is not None
    assert planning.kept.start_s == first.start_s
    assert planning.take(second, outcome, 5.1)
    assert planning.kept.start_s == second.start_s
    assert not planning.take(first, outcome, 5.2)  # older than what is flown
    over = ask(planning, 6.0)
    assert not planning.take(over, outcome, 100.0)


def test_a_plan_of_another_vehicle_is_no_answer(
    planning: GatePlanning, outcome: PlanOutcome
) -> None:
    assert outcome.plan is not None
    heavier = outcome.plan.states + np.array([0.0] * 6 + [100.0])
    for states in (heavier, outcome.plan.states[:, :5]):
        foreign = replace(outcome, plan=replace(outcome.plan, states=states))
        assert not planning.take(ask(planning, 0.0), foreign, 0.1)
    assert planning.kept is None
    assert planning.take(ask(planning, 0.2), outcome, 0.3)


def test_early_plans_are_flown_from_their_starts_on(planner: Planner, outcome: PlanOutcome) -> None:
    values = planner.problem.table.unpack(planner.parameters)
    slow = replace(SETTINGS, known_planning_latency_s=3.0)
    planning = GatePlanning(slow, Vehicle.of(values), values, ControlHold.MEAN)
    starts_s = []
    for time_s in (0.0, 1.0):
        request = ask(planning, time_s)
        starts_s.append(request.start_s)
        assert planning.take(request, outcome, time_s + 0.1)
        assert planning.kept is None
    assert starts_s == pytest.approx([3.02, 4.02])
    for time_s, expected_s in ((3.0, None), (3.02, 3.02), (4.0, 3.02), (4.02, 4.02)):
        foreseen = planning.flown_at(time_s)
        planning.switch(time_s)
        assert planning.kept is foreseen
        assert (foreseen and foreseen.start_s) == pytest.approx(expected_s)


@pytest.mark.parametrize("hold", list(ControlHold))
def test_a_plan_is_followed_as_it_was_made(outcome: PlanOutcome, hold: ControlHold) -> None:
    assert outcome.plan is not None
    plan, start_s = outcome.plan, 7.0
    reference = Reference(plan, start_s, hold)
    for node in (0, 17, 50):
        position, velocity, mass = reference.state(start_s + plan.times_s[node])
        assert [*position, *velocity, mass] == pytest.approx(plan.states[node], abs=1e-6)
    step = plan.times_s[1]
    middle = reference.thrust(start_s + 10.25 * step, 0.5 * step)
    assert middle == pytest.approx(plan.controls[10:12].mean(axis=0))
    whole = reference.thrust(start_s, plan.terminal_time_s)
    assert whole == pytest.approx(
        np.trapezoid(plan.controls, plan.times_s, axis=0) / plan.terminal_time_s
    )
    # The planned positions are those of the planned velocities.
    moments = start_s + np.linspace(3.0, 4.0, 201)
    path = np.array([np.concatenate(reference.state(t)[:2]) for t in moments])
    travelled = np.trapezoid(path[:, 3:6], moments, axis=0)
    assert travelled == pytest.approx(path[-1, :3] - path[0, :3], abs=1e-3)

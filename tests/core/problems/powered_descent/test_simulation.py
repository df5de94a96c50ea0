from __future__ import annotations

import json
import math
import pickle
from typing import Any

import numpy as np
import pytest

from dscp_core import problems
from dscp_core.errors import InvalidInputError
from dscp_core.planning.plan import PlanStatus, TerminalTime
from dscp_core.planning.planner import Planner
from dscp_core.problems.powered_descent.simulation import (
    DescentRecord,
    DescentSimulation,
    NothingToFlyError,
)

PROBLEM = problems.get("powered_descent")
SIMULATED = PROBLEM.extras.simulation
OPTIONS = (*SIMULATED.truth, *SIMULATED.guidance, *SIMULATED.bounds)
# The landing burn of one engine: 4 m/s^2 of braking with the least thrust.
NO_HOVER = {
    "initial_mass": 29500.0,
    "initial_position": (5000.0, 100.0, 0.0),
    "initial_velocity": (-319.0, -5.0, 0.0),
    "pointing_angle_max": 0.2618,
    "thrust_min": 338080.0,
    "terminal_time": 25.0,
}


def planner(**parameters: Any) -> Planner:
    return Planner(PROBLEM, terminal_time=TerminalTime.FREE, parameters=parameters)


@pytest.fixture(scope="module")
def usual() -> DescentSimulation:
    return DescentSimulation(planner())


@pytest.fixture(scope="module")
def flight(usual: DescentSimulation) -> DescentRecord:
    return usual.record(1)


def test_a_dispersed_flight_lands_softly(usual: DescentSimulation, flight: DescentRecord) -> None:
    summary = flight.summary
    assert summary.success, summary.story
    assert summary.failure == summary.worst == ""
    assert summary.figures.keys() == {figure.name for figure in usual.figures}
    assert summary.figures["contact_speed_m_s"] < 0.5
    assert summary.figures["contact_position_m"] < 1.0
    assert summary.figures["contact_tilt_rad"] < math.radians(5.0)
    assert 0.0 < summary.figures["fuel_over_optimum"] < 0.1
    assert flight.phases[0] == "waiting"
    assert list(dict.fromkeys(flight.phases)) == ["waiting", "tracking", "profile"]


def test_the_flight_ends_on_the_ground_and_every_row_has_its_time(flight: DescentRecord) -> None:
    rows = len(flight.times_s)
    assert flight.states.shape == flight.measured.shape == (rows, 7)
    assert flight.commanded.shape == flight.controls.shape == (rows, 3)
    assert len(flight.phases) == rows
    assert np.allclose(np.diff(flight.times_s)[:-1], 0.1, rtol=0.0, atol=1e-12)
    assert 0.0 < flight.times_s[-1] - flight.times_s[-2] <= 0.1 + 1e-12
    assert abs(flight.states[-1, 0]) < 1e-9
    assert np.all(flight.states[:-1, 0] > 0.0)
    end, figures = flight.states[-1], flight.summary.figures
    assert figures["contact_speed_m_s"] == pytest.approx(np.linalg.norm(end[3:6]))
    assert figures["contact_position_m"] == pytest.approx(np.linalg.norm(end[1:3]), abs=1e-9)
    assert figures["fuel_kg"] == pytest.approx(flight.states[0, 6] - end[6])


def test_navigation_is_late_and_noisy(flight: DescentRecord) -> None:
    """A measurement tells where the vehicle was 0.05 s before."""
    before = 0.5 * (flight.states[:-2, :3] + flight.states[1:-1, :3])
    noise = flight.measured[1:-1, :3] - before
    # 330 rows of three axes; the mean of two ticks is off by a few cm where the vehicle brakes.
    assert np.std(noise) == pytest.approx(0.2, rel=0.1)


def test_the_engine_keeps_its_bounds(flight: DescentRecord) -> None:
    lit = np.array(flight.phases) != "waiting"
    sizes = np.linalg.norm(flight.commanded[lit], axis=1)
    assert sizes.min() >= 169.0e3 * (1.0 - 1e-12)
    assert sizes.max() <= 845.2e3 * (1.0 + 1e-12)
    # The plan keeps the reserve; the tracker spends some of it.
    assert sizes.max() > max(replan.thrust_max_n for replan in flight.replans[:5])


def test_plans_keep_a_reserve_and_give_it_back(flight: DescentRecord) -> None:
    limits = [replan.thrust_max_n for replan in flight.replans]
    assert limits[0] == pytest.approx(0.92 * 845.2e3)
    assert limits[0] < limits[15] < limits[-1] <= 0.97 * 845.2e3
    assert all(replan.flown for replan in flight.replans)


def test_a_flight_is_a_function_of_its_seed_alone(
    usual: DescentSimulation, flight: DescentRecord
) -> None:
    copy = pickle.loads(pickle.dumps(usual))
    copy.fly(2)  # what was flown before leaves no trace
    again = copy.record(1)
    assert again.summary == flight.summary
    for name in ("times_s", "states", "measured", "commanded", "controls"):
        assert np.array_equal(getattr(again, name), getattr(flight, name)), name
    assert not np.array_equal(usual.record(3).states[0], flight.states[0])


def test_settings_tell_everything(usual: DescentSimulation) -> None:
    told = json.loads(json.dumps(usual.settings))
    assert told["guidance"]["replan_s"] == 1.0
    assert told["truth"]["wind_m_s2"] == 0.1
    assert told["vehicle"]["thrust_max"] == 845.2e3
    assert set(told["guidance"]) | set(told["truth"]) | set(told["bounds"]) == {
        option.name for option in OPTIONS
    }


def test_two_seconds_without_a_plan_and_late_plans_are_flown_through() -> None:
    outage = {"outage_start_s": 10.0, "outage_s": 2.0, "replan_s": 2.0}
    record = DescentSimulation(planner(), outage).record(5)
    unanswered = [replan for replan in record.replans if replan.outcome is None]
    assert unanswered
    assert all(10.0 <= record.times_s[replan.tick] < 12.0 for replan in unanswered)
    assert record.summary.success, record.summary.story
    late = DescentSimulation(planner(), {"late_plans": 1.0, "late_plan_s": 1.5}).record(5)
    ages = [replan.answered_s - late.times_s[replan.tick] for replan in late.replans]
    assert min(ages) == pytest.approx(1.52)
    assert late.summary.figures["contact_speed_m_s"] < 1.0


def test_plans_that_come_early_are_flown_in_time() -> None:
    early = {"known_planning_latency_s": 0.5, "planning_latency_s": 0.02}
    summary = DescentSimulation(planner(), early).fly(5)
    assert summary.success, summary.story
    assert summary.figures["refused_replans"] == 0.0


def test_without_any_plan_it_falls_and_says_why() -> None:
    summary = DescentSimulation(planner(), {"outage_s": 1000.0}).fly(1)
    assert summary.failure == "no first plan"
    assert not summary.success
    assert summary.figures["contact_speed_m_s"] > 100.0


def test_propellant_that_runs_out_is_a_failure_of_its_own() -> None:
    """The plan ends with 80 kg left, and guidance burns more than its plan."""
    record = DescentSimulation(planner(dry_mass=31680.0), {"replan_s": 2.0}).record(1)
    assert record.summary.failure == "out of propellant"
    assert record.states[-1, 6] == pytest.approx(31680.0, abs=1e-6)
    dry_s = next(time_s for time_s, text in record.events if text == "out of propellant")
    assert dry_s < record.times_s[-1]
    off = np.linalg.norm(record.controls[record.times_s > dry_s], axis=1)
    assert np.all(off == 0.0)


def test_a_refused_plan_is_flown_through() -> None:
    """An engine weaker than assumed, and plans without a reserve."""
    options = {"thrust_scale": 0.02, "reserve": 0.0, "early_reserve": 0.0, "replan_s": 3.0}
    record = DescentSimulation(planner(), options).record(4)
    assert record.errors.thrust < -0.01
    statuses = {r.outcome.status for r in record.replans if r.outcome is not None}
    assert statuses - {PlanStatus.CERTIFIED}
    assert record.summary.failure == ""
    assert np.all(np.isfinite(record.states))


def test_a_vehicle_that_cannot_hover_stops_at_the_ground_and_cuts_off() -> None:
    bounds = {"contact_speed_most_m_s": 2.0, "replan_s": 2.0}
    record = DescentSimulation(planner(**NO_HOVER), bounds).record(1)
    assert record.summary.success, record.summary.story
    lit = np.linalg.norm(record.commanded, axis=1) > 0.0
    assert "cut off" not in np.array(record.phases)[lit]


def test_a_mission_without_a_glideslope_is_not_flown_along_the_ground() -> None:
    # The optimum from here skims the ground for kilometres: nothing is below to err into.
    mars = {
        "gravity": 3.7114,
        "initial_position": (1500.0, 2000.0, 0.0),
        "initial_velocity": (-75.0, 100.0, 0.0),
        "initial_mass": 1905.0,
        "dry_mass": 0.0,
        "thrust_min": 4971.8,
        "thrust_max": 13258.2,
        "specific_impulse": 200.5,
        "pointing_angle_max": 1.55,
        "glideslope_angle_max": 1.57,
        "terminal_time": 75.0,
    }
    summary = DescentSimulation(planner(**mars), {"replan_s": 5.0}).fly(1000)
    assert summary.success, summary.story


def test_nothing_to_fly_is_told_at_once() -> None:
    doomed = planner(initial_position=(1500.0, 0.0, 0.0), initial_velocity=(-230.0, 0.0, 0.0))
    with pytest.raises(NothingToFlyError, match="INFEASIBLE"):
        DescentSimulation(doomed)


def test_what_cannot_take_off_is_named() -> None:
    with pytest.raises(InvalidInputError, match=r"thrust_max: got 300000.0, expected > 372649 N"):
        DescentSimulation(planner(thrust_max=300e3))
    slow = r"throttle_rate_n_s: got 1000.0, expected >= 9\d\d\d.* N/s, to reach the weight"
    with pytest.raises(InvalidInputError, match=slow):
        DescentSimulation(planner(), {"throttle_rate_n_s": 1e3})


def test_options_are_known_by_name() -> None:
    names = [option.name for option in OPTIONS]
    assert len(set(names)) == len(names)
    assert all(option.description and option.unit for option in OPTIONS)
    with pytest.raises(InvalidInputError, match="replan_s"):
        SIMULATED(planner(), {"replan": 1.0})
    with pytest.raises(InvalidInputError, match="wind_m_s2"):
        SIMULATED(planner(), {"wind_m_s2": "strong"})

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from core.toy_problems import cart
from numpy.typing import NDArray
from oracles.powered_descent_best_effort import LeastErrorDescent
from oracles.powered_descent_physics import PAPER_PARAMETERS, state_rate
from scipy.integrate import solve_ivp

from dscp_core import problems
from dscp_core.errors import InvalidInputError
from dscp_core.planning.plan import BestEffort, PlanOutcome, PlanStatus
from dscp_core.planning.planner import Planner

Array = NDArray[np.float64]

N = 30
SPEED_TOLERANCE, POSITION_TOLERANCE = 1e-3, 1e-2

MARS: dict[str, Any] = {
    "glideslope_angle_max": math.radians(86.0),
    "gravity": 3.7114,
    "initial_mass": 1905.0,
    "initial_position": (1500.0, 0.0, 2000.0),
    "initial_velocity": (-75.0, 40.0, 100.0),
    "pointing_angle_max": 1.55,
    "specific_impulse": 200.476,
    "standard_gravity": 9.807,
    "contact_tilt_max": 1.55,
    "terminal_time": 75.0,
    "thrust_max": 13258.177,
    "thrust_min": 4971.816,
}
HOPPER: dict[str, Any] = {
    "gravity": 9.81,
    "initial_mass": 100.0,
    "initial_position": (20.0, 10.0, -5.0),
    "initial_velocity": (-20.0, 1.0, 0.0),
    "pointing_angle_max": math.radians(20.0),
    "specific_impulse": 180.0,
    "dry_mass": 0.0,
    "terminal_time": 10.0,
    "thrust_max": 1500.0,
    "thrust_min": 400.0,
}
CASES: dict[str, dict[str, Any]] = {
    "too low": {"initial_position": (600.0, 100.0, 500.0)},
    "too fast": {"initial_velocity": (-400.0, 30.0, -30.0)},
    "too weak": {"thrust_max": 460e3, "initial_position": (2500.0, 500.0, 500.0)},
    "too little fuel": {"dry_mass": 33000.0},
    "outside the glideslope": {
        "initial_position": (388.0, 2438.1, 0.0),
        "initial_velocity": (-5.5, -48.7, -4.4),
        "initial_mass": 39319.3,
    },
    "Mars, short of fuel": {**MARS, "dry_mass": 1505.0},
    "hopper, too fast": HOPPER,
}


PROBLEM = problems.get("powered_descent")


def planner_of(changes: Mapping[str, Any], **settings: Any) -> Planner:
    suited = {"terminal_time": "free", "intervals": N, "best_effort": True}
    return Planner(PROBLEM, parameters=changes, **{**suited, **settings})


def effort_of(outcome: PlanOutcome) -> BestEffort:
    assert not outcome.certified, outcome.headline
    assert outcome.best_effort is not None, outcome.message
    return outcome.best_effort


def errors_of(effort: BestEffort, values: Mapping[str, Any]) -> tuple[float, float]:
    """Speed error and distance from the target at the end."""
    end = effort.plan.states[-1]
    speed = np.linalg.norm(end[3:6] - np.asarray(values["final_velocity"]))
    return float(speed), float(np.linalg.norm(end[1:3] - np.asarray(values["final_position"])[1:]))


@pytest.mark.parametrize("name", CASES)
def test_best_effort_is_the_lexicographic_optimum(name: str) -> None:
    planner = planner_of(CASES[name], discretisation="midpoint")
    effort = effort_of(planner.plan())
    values: dict[str, Any] = planner.problem.table.unpack(planner.parameters)
    if name == "outside the glideslope":
        values["glideslope_angle_max"] = math.atan2(2438.1, 388.0) + 0.01
    guess = planner.problem.terminal_time_guess
    assert guess is not None
    seconds = guess(planner.initial_state, values)
    oracle = LeastErrorDescent(values, N)
    found = oracle.solve((seconds, 2.0 * seconds), SPEED_TOLERANCE, POSITION_TOLERANCE)
    assert found is not None
    assert found.solved == 3
    speed, position = errors_of(effort, values)
    # Later steps may add a tolerance to both, here and there.
    assert speed == pytest.approx(found.contact_speed_m_s, rel=2e-3, abs=2 * SPEED_TOLERANCE)
    # IPOPT may end in an optimum nearby that is 1 % worse.
    assert position <= 1.005 * found.contact_position_m + 2 * POSITION_TOLERANCE
    assert position >= 0.98 * found.contact_position_m - 2 * POSITION_TOLERANCE
    assert effort.plan.states[-1, 6] == pytest.approx(found.final_mass_kg, rel=1e-4)
    # What is better is not what violates more.
    plan = effort.plan
    assert oracle.violation(plan.states, plan.controls, plan.terminal_time_s) < 1e-4
    assert effort.plan.states[-1, 0] == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("name", CASES)
def test_best_effort_says_what_it_violates(name: str) -> None:
    outcome = planner_of(CASES[name]).plan()
    effort = effort_of(outcome)
    assert not effort.certificate.passed
    assert set(effort.certificate.reasons) <= set(effort.violations)
    speed, position = errors_of(effort, outcome.parameters)
    found = {"final_speed_error": (speed, "m/s"), "final_position_error": (position, "m")}
    expected = [f"{n} {value:.4g} {unit}" for n, (value, unit) in found.items() if value > 0.03]
    assert list(effort.violations[: len(expected)]) == expected
    assert all(any(letter.isdigit() for letter in line) for line in effort.violations)
    assert [step.split()[0] for step in effort.steps] == [
        "final_speed_error",
        "final_position_error",
        "cost",
    ]
    assert effort.steps[0].startswith(f"final_speed_error {speed:.4g} m/s")
    if "outside" in name:
        assert effort.violations[-1].startswith("glideslope_angle_max 1.396 rad was widened to ")


def test_structure_is_not_burnt() -> None:
    outcome = planner_of(CASES["Mars, short of fuel"]).plan()
    effort = effort_of(outcome)
    assert effort.plan.states[:, 6].min() >= 1505.0 - 1e-3
    assert effort.certificate.states[:, 6].min() >= 1505.0 - 0.1
    speed, position = errors_of(effort, outcome.parameters)
    assert speed < 2 * SPEED_TOLERANCE
    assert 200.0 < position < 260.0  # it lands softly, short of the target


@pytest.mark.parametrize(
    "changes", [{}, {"initial_position": (1500.0, 500.0, 500.0)}, {"dry_mass": 31700.0}]
)
def test_a_feasible_case_needs_none_and_its_best_effort_is_its_plan(
    changes: dict[str, Any],
) -> None:
    planner = planner_of(changes)
    outcome = planner.plan()
    assert outcome.certified
    assert outcome.best_effort is None
    assert planner._fallback is not None
    packed = planner.check_state(planner.initial_state)
    starts = [(outcome.terminal_time_used_s, None)]
    reached = planner._fallback.least.find(packed, starts, lambda: None, lambda _: None)
    assert reached is not None
    assert reached.errors[0] <= SPEED_TOLERANCE * 1.01
    assert reached.errors[1] <= POSITION_TOLERANCE * 1.01
    # Both errors may be what is tolerated, which is worth some grams.
    assert reached.cost == pytest.approx(outcome.cost, rel=1e-5)
    assert reached.terminal_time_s == pytest.approx(outcome.terminal_time_used_s, rel=1e-3)


def test_certified_after_all_is_no_best_effort() -> None:
    # One iteration finds nothing; another from the end of the best effort's steps does.
    options = replace(planner_of({}).settings.options, max_iterations=1)
    outcome = planner_of({}, options=options).plan()
    assert outcome.certified
    assert outcome.best_effort is None
    assert outcome.warm_started
    assert outcome.cost == pytest.approx(-31760.3, abs=5.0)


def test_another_terminal_time_than_the_fixed_one_is_a_violation() -> None:
    outcome = planner_of({"terminal_time": 31.0}, terminal_time="fixed").plan()
    effort = effort_of(outcome)
    assert outcome.status is PlanStatus.INFEASIBLE
    assert effort.plan.terminal_time_s == pytest.approx(32.8, abs=0.1)
    (told,) = (line for line in effort.violations if "asked for" in line)
    assert told == f"terminal_time {effort.plan.terminal_time_s:.5g} s is not the 31 s asked for"


def test_a_terminal_time_out_of_its_bounds_is_a_violation() -> None:
    # Fuel for 33 s at the least thrust and more, and 40 s to be flown: it lands before.
    values = {"terminal_time_min": 40.0, "dry_mass": 31700.0}
    effort = effort_of(planner_of(values).plan())
    seconds = effort.plan.terminal_time_s
    assert seconds < 39.0
    assert f"terminal_time {seconds:.5g} s is not within 40 to 200 s" in effort.violations


def test_a_least_terminal_time_does_not_keep_a_best_effort_from_ending_sooner() -> None:
    # It hits the ground after 6.3 s, whatever it does.
    fast = {"initial_position": (1565.0, 552.0, 585.0), "initial_velocity": (-288.0, 67.0, -31.0)}
    without = effort_of(planner_of(fast).plan())
    effort = effort_of(planner_of({**fast, "terminal_time_min": 43.0}).plan())
    assert effort.violations[0] == without.violations[0]
    assert effort.plan.terminal_time_s == pytest.approx(without.plan.terminal_time_s, rel=1e-3)
    assert effort.plan.terminal_time_s == pytest.approx(6.3, abs=0.2)


def test_more_thrust_never_gives_a_larger_error() -> None:
    speeds = []
    for share in (0.6, 0.7, 0.85, 1.0, 1.15):
        planner = planner_of({**CASES["too low"], "thrust_max": share * 845.2e3})
        outcome = planner.plan()
        speeds.append(errors_of(effort_of(outcome), outcome.parameters)[0])
    assert all(more < less for less, more in pairwise(speeds)), speeds


@pytest.mark.parametrize("seed", range(3))
def test_never_worse_than_the_old_plan_flown_on(seed: int) -> None:
    """From a state that left its plan, the old thrust hits the ground faster."""
    random = np.random.default_rng(seed)
    planner = planner_of({})
    old = planner.plan().plan
    assert old is not None
    n = 22
    state = old.states[n] + np.array([-60.0, *random.normal(0, 5, 2), -25.0, 0.0, 0.0, 0.0])

    def thrust(seconds: float) -> Array:
        moment = old.times_s[n] + seconds
        return np.array([np.interp(moment, old.times_s, column) for column in old.controls.T])

    def ground(_t: float, x: Array) -> float:
        return float(x[0])

    ground.terminal = True  # type: ignore[attr-defined]
    flight = solve_ivp(
        lambda t, x: state_rate(x, thrust(t), PAPER_PARAMETERS),
        (0.0, 100.0),
        state,
        events=ground,
        rtol=1e-9,
        atol=1e-6,
    )
    contact = float(np.linalg.norm(flight.y[3:6, -1]))
    outcome = planner.plan(state)
    speed = errors_of(effort_of(outcome), outcome.parameters)[0]
    assert 0.0 < speed < contact


def test_warm_start_from_an_old_plan_leads_to_the_same() -> None:
    planner = planner_of({})
    old = planner.plan().plan
    assert old is not None
    state = old.states[22] + np.array([-80.0, 0.0, 0.0, -30.0, 0.0, 0.0, 0.0])
    elapsed = float(old.times_s[22])
    cold = effort_of(planner.plan(state))
    warm = effort_of(planner.plan(state, warm_start=old, elapsed_s=elapsed))
    np.testing.assert_allclose(warm.plan.states[-1], cold.plan.states[-1], rtol=2e-3, atol=1.0)


@pytest.mark.parametrize(
    "changes",
    [
        {"initial_position": (0.0, 0.0, 0.0)},
        {"initial_position": (0.0, 0.0, 0.0), "initial_velocity": (0.0, 0.0, 0.0)},
        {"initial_position": (1e-3, 0.0, 0.0), "initial_velocity": (-1.0, 0.0, 0.0)},
        {"initial_position": (50.0, 0.0, 0.0), "initial_velocity": (300.0, 900.0, 0.0)},
        {"dry_mass": 37990.0},
        {"dry_mass": 38000.0},
        {"terminal_time_max": 1.0},
        {"thrust_min": 1e6, "thrust_max": 1e6},
    ],
)
def test_degenerate_cases_end_in_words(changes: dict[str, Any]) -> None:
    outcome = planner_of(changes).plan()
    if outcome.certified or outcome.status is PlanStatus.INVALID_STATE:
        return
    if outcome.best_effort is None:
        assert "no best effort: " in outcome.message
        return
    assert np.all(np.isfinite(outcome.best_effort.plan.states))
    assert outcome.best_effort.violations


def test_figure_draws_the_best_effort_and_says_what_it_is() -> None:
    planner = planner_of(CASES["too low"])
    outcome = planner.plan()
    figure = planner.figure(outcome)
    title = " ".join(text.get_text() for text in figure.texts)
    assert "best effort, NOT CERTIFIED: final_speed_error 8" in " ".join(title.split())
    drawn = [line.get_xdata()[-1] for axes in figure.axes for line in axes.lines]
    assert any(
        end == pytest.approx(effort_of(outcome).plan.terminal_time_s, abs=1e-6) for end in drawn
    )


def test_no_state_no_best_effort() -> None:
    outcome = planner_of({}).plan([math.nan] * 7)
    assert outcome.status is PlanStatus.INVALID_STATE
    assert outcome.best_effort is None


def test_without_being_asked_there_is_none() -> None:
    outcome = planner_of(CASES["too low"], best_effort=False).plan()
    assert outcome.best_effort is None
    assert "best effort" not in outcome.message


def test_deadline_counts_for_it_too() -> None:
    planner = planner_of(CASES["too low"])
    whole = planner.plan()
    hurried = planner.plan(deadline_s=1e-4)
    assert hurried.best_effort is None
    assert hurried.message.endswith("no best effort: deadline")
    assert whole.iterations > hurried.iterations


def test_whatever_the_time_the_steps_that_were_made_come_out() -> None:
    planner = planner_of(CASES["too low"])
    assert planner._fallback is not None
    packed = planner.check_state(planner.initial_state)
    starts = [(5.6, None)]
    made = []
    for calls in range(0, 16, 2):
        left = iter([1.0] * calls)
        reached = planner._fallback.least.find(
            packed, starts, partial(next, left, 0.0), lambda _: None
        )
        made.append(0 if reached is None else len(reached.converged))
    assert made[0] == 0
    assert made == sorted(made)
    assert set(made) == {0, 1, 2, 3}
    cut = planner._fallback._steps(replace(reached, converged=reached.converged[:2]))
    assert cut[-1].endswith("(not made least: no time left, or no convergence)")


def test_a_problem_that_concedes_nothing_refuses() -> None:
    with pytest.raises(InvalidInputError, match="cart declares no concessions"):
        Planner(cart(), best_effort=True)
    printed = problems.get("powered_descent", "printed")
    with pytest.raises(InvalidInputError, match=r"powered_descent \(printed\) declares no"):
        Planner(printed, best_effort=True)

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from core.toy_problems import cart
from numpy.typing import NDArray
from oracles.powered_descent_nlp import Status, solve_free_time, solve_least_time
from oracles.powered_descent_physics import PAPER_INITIAL_STATE, PAPER_PARAMETERS, state_rate

from dscp_core import problems
from dscp_core.cone.solvers import SolverSettings
from dscp_core.errors import InvalidInputError
from dscp_core.planning.plan import PlanOutcome, PlanStatus
from dscp_core.planning.planner import Planner, PlannerSettings, TerminalTime
from dscp_core.problem.flight import ControlHold, Discretisation
from dscp_core.problem.trajectory import Plan
from dscp_core.scp.scp import ScpOptions

Array = NDArray[np.float64]

START = np.array(PAPER_INITIAL_STATE)


@pytest.fixture(scope="module")
def fixed() -> Planner:
    return Planner(problems.get("powered_descent"), PlannerSettings())


@pytest.fixture(scope="module")
def free() -> Planner:
    return Planner(
        problems.get("powered_descent"), PlannerSettings(terminal_time=TerminalTime.FREE)
    )


@pytest.fixture(scope="module")
def first(fixed: Planner) -> Plan:
    return plan_of(fixed.plan(START))


def plan_of(outcome: PlanOutcome) -> Plan:
    assert outcome.plan is not None, outcome.message
    return outcome.plan


def test_nominal_plan_is_certified(fixed: Planner) -> None:
    outcome = fixed.plan(START)
    assert outcome.status is PlanStatus.CERTIFIED
    assert outcome.certificate is not None
    assert outcome.certificate.passed
    assert 2 <= outcome.iterations <= 10
    assert not outcome.warm_started
    assert outcome.terminal_time_used_s == 32.81
    assert outcome.terminal_time_predicted_s is None
    assert outcome.solver in ("clarabel", "qoco", "ecos")
    # IPOPT finds 31760.368442 kg; relative 1e-7 of it.
    assert outcome.cost == pytest.approx(-31760.368442, rel=1e-7)
    assert outcome.virtual_control < 1e-6
    assert outcome.max_defect < 1e-6
    assert 0.0 < outcome.solver_time_s < outcome.solve_time_s


def test_plan_is_in_si_and_complete(fixed: Planner, first: Plan) -> None:
    assert first.problem == "powered_descent"
    assert first.state_names == fixed.state_names == ("x", "y", "z", "vx", "vy", "vz", "mass")
    assert first.control_names == ("thrust_x", "thrust_y", "thrust_z")
    assert first.control_states == (3, 4, 5)
    assert first.terminal_time_s == 32.81
    np.testing.assert_allclose(first.times_s, np.linspace(0.0, 32.81, 51), rtol=1e-14)
    assert first.states.shape == (51, 7)
    assert first.controls.shape == (51, 3)
    np.testing.assert_allclose(first.states[0], START, rtol=1e-9)
    np.testing.assert_allclose(first.states[-1, :6], np.zeros(6), atol=1e-5)
    rates = [
        state_rate(x, u, PAPER_PARAMETERS)
        for x, u in zip(first.states, first.controls, strict=True)
    ]
    np.testing.assert_allclose(first.state_rates, rates, rtol=1e-12)


def test_initial_state_of_the_settings(fixed: Planner) -> None:
    np.testing.assert_array_equal(fixed.initial_state, START)
    other = Planner(
        problems.get("powered_descent"),
        PlannerSettings(parameters={"initial_mass": 36000.0}, intervals=5),
    )
    assert other.initial_state[6] == 36000.0


def test_free_terminal_time(free: Planner) -> None:
    outcome = free.plan(START)
    oracle = solve_free_time(PAPER_INITIAL_STATE)
    assert oracle.status is Status.OPTIMAL
    assert outcome.status is PlanStatus.CERTIFIED
    assert outcome.terminal_time_used_s == pytest.approx(oracle.terminal_time_s, abs=0.005)
    assert plan_of(outcome).terminal_time_s == outcome.terminal_time_used_s


def test_random_states_of_the_box_are_certified(free: Planner) -> None:
    rng = np.random.default_rng(31)
    low = [5000.0, -600.0, -600.0, -150.0, -30.0, -30.0, 38000.0]
    high = [5400.0, 600.0, 600.0, -120.0, 30.0, 30.0, 38000.0]
    for state in rng.uniform(low, high, (25, 7)):
        outcome = free.plan(state)
        assert outcome.status is PlanStatus.CERTIFIED, f"{state}: {outcome.message}"


@pytest.mark.parametrize("time_s", [31.0, 31.9, 32.0, 32.04])
def test_too_little_time_is_infeasible(time_s: float) -> None:
    planner = Planner(
        problems.get("powered_descent"), PlannerSettings(parameters={"terminal_time": time_s})
    )
    outcome = planner.plan(planner.initial_state)
    assert outcome.status is PlanStatus.INFEASIBLE
    assert "no feasible trajectory" in outcome.message
    assert outcome.terminal_time_used_s == time_s
    assert outcome.virtual_control > 1e-6


def test_least_terminal_time(fixed: Planner, free: Planner) -> None:
    oracle = solve_least_time(PAPER_INITIAL_STATE)
    assert oracle.status is Status.OPTIMAL
    for planner in (fixed, free):
        least = planner.least_terminal_time(START)
        # The paper's grid is 0.01 s; local minima differ by 1e-3 s; the search stops at 1e-4 s.
        assert least == pytest.approx(oracle.terminal_time_s, abs=0.005)
    state = np.array([5200.0, 300.0, -400.0, -135.0, -10.0, 20.0, 38000.0])
    other = solve_least_time(state)
    assert other.status is Status.OPTIMAL
    assert fixed.least_terminal_time(state) == pytest.approx(other.terminal_time_s, abs=0.005)


def test_no_least_time_of_a_vehicle_that_cannot_brake() -> None:
    planner = Planner(
        problems.get("powered_descent"),
        PlannerSettings(parameters={"thrust_max": 2.0e5, "initial_mass": 60000.0}),
    )
    assert planner.least_terminal_time(planner.initial_state) is None


def test_least_time_of_a_bad_state(fixed: Planner) -> None:
    with pytest.raises(InvalidInputError, match="mass"):
        fixed.least_terminal_time(np.array([*START[:6], -1.0]))


def test_warm_start_continues_the_plan(fixed: Planner, first: Plan) -> None:
    for node in (0, 1, 8):
        elapsed_s = float(first.times_s[node])
        outcome = fixed.plan(first.states[node], warm_start=first, elapsed_s=elapsed_s)
        assert outcome.status is PlanStatus.CERTIFIED, outcome.message
        assert outcome.warm_started
        # On the way, what is left of the flight time is used, not all of it again.
        assert outcome.terminal_time_used_s == pytest.approx(32.81 - elapsed_s)
        cold = Planner(
            problems.get("powered_descent"),
            PlannerSettings(parameters={"terminal_time": 32.81 - elapsed_s}),
        )
        reference = cold.plan(first.states[node])
        assert outcome.iterations < reference.iterations
        # The cost tolerance of 1e-8 of 32 t.
        assert outcome.cost == pytest.approx(reference.cost, abs=1e-3)


def test_warm_start_of_a_disturbed_state(free: Planner) -> None:
    first = plan_of(free.plan(START))
    state = first.states[3] + np.array([8.0, -5.0, 3.0, 0.5, -0.4, 0.3, -20.0])
    warm = free.plan(state, warm_start=first, elapsed_s=float(first.times_s[3]))
    cold = free.plan(state)
    assert warm.status is cold.status is PlanStatus.CERTIFIED
    assert warm.warm_started
    assert warm.iterations < cold.iterations
    # Flat mass: see test_powered_descent.
    assert warm.terminal_time_used_s == pytest.approx(cold.terminal_time_used_s, abs=0.002)


def test_warm_start_from_a_plan_with_other_nodes(fixed: Planner) -> None:
    coarse = Planner(problems.get("powered_descent"), PlannerSettings(intervals=20))
    outcome = fixed.plan(START, warm_start=plan_of(coarse.plan(START)))
    assert outcome.status is PlanStatus.CERTIFIED
    assert outcome.warm_started
    assert len(plan_of(outcome).times_s) == 51


def test_useless_warm_start_is_followed_by_a_cold_one(fixed: Planner, first: Plan) -> None:
    # Late in the flight of another plan: far too little time from the start.
    outcome = fixed.plan(START, warm_start=first, elapsed_s=5.0)
    assert outcome.status is PlanStatus.INFEASIBLE
    assert not outcome.warm_started
    single = fixed.plan(START)
    assert outcome.iterations > single.iterations  # those of both runs


@pytest.mark.parametrize("elapsed_s", [-0.1, 32.0, 40.0, float("nan")])
def test_stale_warm_start_is_left_alone(fixed: Planner, first: Plan, elapsed_s: float) -> None:
    outcome = fixed.plan(START, warm_start=first, elapsed_s=elapsed_s)
    assert outcome.status is PlanStatus.CERTIFIED
    assert not outcome.warm_started
    assert outcome.terminal_time_used_s == 32.81


def test_warm_start_of_another_problem_is_left_alone(fixed: Planner, first: Plan) -> None:
    outcome = fixed.plan(START, warm_start=replace(first, problem="entry"))
    assert outcome.status is PlanStatus.CERTIFIED
    assert not outcome.warm_started


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({0: np.nan}, "x"),
        ({4: np.inf}, "vy"),
        ({6: -np.inf}, "mass"),
        ({6: 0.0}, "initial_mass"),
        ({6: -5.0}, "initial_mass"),
        ({0: -1.5}, "x"),
        ({1: 2e6}, "initial_position"),
        ({5: 2e4}, "initial_velocity"),
    ],
)
def test_bad_states_are_refused(fixed: Planner, changes: dict[int, float], field: str) -> None:
    state = START.copy()
    for index, value in changes.items():
        state[index] = value
    outcome = fixed.plan(state)
    assert outcome.status is PlanStatus.INVALID_STATE
    assert outcome.message.startswith(f"{field}: ")
    assert outcome.plan is None
    assert outcome.certificate is None
    assert outcome.iterations == 0
    with pytest.raises(InvalidInputError) as caught:
        fixed.check_state(state)
    assert caught.value.field == field
    # The planner lives on.
    assert fixed.plan(START).status is PlanStatus.CERTIFIED


@pytest.mark.parametrize("state", [np.zeros(3), np.zeros((7, 1)), np.zeros(8)])
def test_states_of_wrong_length_are_refused(fixed: Planner, state: Array) -> None:
    outcome = fixed.plan(state)
    assert outcome.status is PlanStatus.INVALID_STATE
    assert "shape (7,)" in outcome.message


@pytest.mark.parametrize("state", ["high", ["1 m"] * 7, [1.0, [2.0]], {"x": 1.0}])
def test_states_that_are_no_numbers_are_refused(fixed: Planner, state: Any) -> None:
    outcome = fixed.plan(state)
    assert outcome.status is PlanStatus.INVALID_STATE
    assert outcome.message.endswith("expected numbers")


def test_ground_is_where_the_landing_site_is() -> None:
    planner = Planner(
        problems.get("powered_descent"),
        PlannerSettings(parameters={"final_position": [100.0, 0.0, 0.0]}),
    )
    state = START.copy()
    # Two centimetres of noise are allowed.
    state[0] = 99.97
    outcome = planner.plan(state)
    assert outcome.status is PlanStatus.INVALID_STATE
    assert ">= 100 m" in outcome.message


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"best_effort": "no"}, "best_effort"),
        ({"options": {"max_iterations": 3}}, "options"),
        ({"parameters": [1.0]}, "parameters"),
        ({"hold": "cubic"}, "hold"),
    ],
)
def test_settings_of_another_kind_are_refused(changes: dict[str, Any], field: str) -> None:
    with pytest.raises(InvalidInputError) as caught:
        PlannerSettings(**changes)
    assert caught.value.field == field


def test_what_is_no_plan_is_no_warm_start(fixed: Planner) -> None:
    with pytest.raises(InvalidInputError, match="warm_start: got 'a PlanOutcome'"):
        fixed.plan(START, warm_start=fixed.plan(START))  # type: ignore[arg-type]


@pytest.mark.parametrize("source", [TerminalTime.FIXED, TerminalTime.FREE])
def test_a_start_outside_the_glideslope_is_told_as_such(
    fixed: Planner, free: Planner, source: TerminalTime
) -> None:
    planner = free if source is TerminalTime.FREE else fixed
    state = START.copy()
    state[:6] = [388.0, 2438.1, 0.0, -5.5, -48.7, -4.4]
    outcome = planner.plan(state)
    assert outcome.status is PlanStatus.INFEASIBLE
    beyond = np.cos(np.radians(80.0)) * state[1] - np.sin(np.radians(80.0)) * state[0]
    told = f"the start is out of bounds: glideslope {beyond:.4g} m exceeds 1"
    assert outcome.message.startswith(told)


def test_hopeless_state_is_no_success(fixed: Planner) -> None:
    # A hundred metres up at 150 m/s.
    state = START.copy()
    state[0] = 100.0
    outcome = fixed.plan(state)
    assert outcome.status in (PlanStatus.INFEASIBLE, PlanStatus.SOLVER_FAILURE)
    assert outcome.message


def test_deadline(fixed: Planner) -> None:
    outcome = fixed.plan(START, deadline_s=1e-9)
    assert outcome.status is PlanStatus.DEADLINE
    assert outcome.plan is None
    assert outcome.iterations == 0
    assert fixed.plan(START, deadline_s=60.0).status is PlanStatus.CERTIFIED


def test_deadline_does_not_stay(fixed: Planner) -> None:
    fixed.plan(START, deadline_s=1e-9)
    assert fixed.scp.options.deadline_s is None
    assert fixed.plan(START).status is PlanStatus.CERTIFIED


def test_iteration_limit_is_certified_by_the_flight_only() -> None:
    # One iteration leaves the dynamics unmet; a certificate decides what such a plan is worth.
    planner = Planner(
        problems.get("powered_descent"), PlannerSettings(options=ScpOptions(max_iterations=1))
    )
    outcome = planner.plan(START)
    assert outcome.iterations == 1
    assert outcome.certificate is not None
    assert outcome.status is (
        PlanStatus.CERTIFIED if outcome.certificate.passed else PlanStatus.ITERATION_LIMIT
    )
    assert outcome.message.startswith("iteration limit")
    if not outcome.certificate.passed:
        assert "; certificate: " in outcome.message


def test_converged_plan_may_fail_the_certificate() -> None:
    # Ten intervals are too coarse for the flight to end where the nodes do.
    settings = PlannerSettings(intervals=10, discretisation=Discretisation.MIDPOINT)
    planner = Planner(problems.get("powered_descent"), settings)
    outcome = planner.plan(START)
    assert outcome.status is PlanStatus.NOT_CERTIFIED
    assert outcome.certificate is not None
    assert not outcome.certificate.passed
    assert "miss_position" in outcome.message
    assert outcome.plan is not None


def test_solver_failure() -> None:
    options = ScpOptions(solver="clarabel", solver_settings=SolverSettings(max_iterations=2))
    outcome = Planner(problems.get("powered_descent"), PlannerSettings(options=options)).plan(START)
    assert outcome.status is PlanStatus.SOLVER_FAILURE
    assert outcome.plan is None
    assert "clarabel" in outcome.message
    assert outcome.cost == np.inf


@pytest.mark.parametrize(
    ("settings", "match"),
    [
        (PlannerSettings(parameters={"thrust": 1.0}), "did you mean"),
        (PlannerSettings(parameters={"thrust_max": -1.0}), "thrust_max"),
        (PlannerSettings(intervals=1), "intervals"),
        (PlannerSettings(options=ScpOptions(solver="mosek")), "mosek"),
    ],
)
def test_bad_settings(settings: PlannerSettings, match: str) -> None:
    with pytest.raises(InvalidInputError, match=match):
        Planner(problems.get("powered_descent"), settings)


def test_status_numbers_are_stable() -> None:
    # They appear in reports and logs.
    assert {status.name: status.value for status in PlanStatus} == {
        "CERTIFIED": 0,
        "NOT_CERTIFIED": 1,
        "INFEASIBLE": 2,
        "ITERATION_LIMIT": 3,
        "DEADLINE": 4,
        "SOLVER_FAILURE": 5,
        "INVALID_STATE": 6,
    }


def test_settings_that_suit_a_problem_are_its_own() -> None:
    entry = PlannerSettings.suited(problems.get("entry"), hold=ControlHold.LINEAR)
    assert (entry.intervals, entry.terminal_time) == (100, TerminalTime.FREE)
    assert entry.hold is ControlHold.LINEAR
    assert PlannerSettings.suited(problems.get("powered_descent")) == PlannerSettings()
    assert PlannerSettings.suited(problems.get("entry"), intervals=60).intervals == 60


def test_a_problem_whose_initial_state_no_parameters_hold_plans_from_it_alone() -> None:
    planner = Planner(cart())
    assert planner.initial_state.tolist() == [0.0, 0.0]
    assert planner.plan().converged
    moved = planner.plan([0.1, 0.0])
    assert moved.status is PlanStatus.INVALID_STATE
    assert "initial_state_parameters" in moved.message


def test_parameters_that_do_not_hold_the_initial_state_are_refused() -> None:
    # Named, but the declaration's initial state is another.
    problem = replace(
        cart(), initial_state_parameters=("start",), initial_state=lambda p: 2.0 * p["start"]
    )
    outcome = Planner(problem, parameters={"start": (0.1, 0.0)}).plan()
    assert outcome.status is PlanStatus.INVALID_STATE


def _fails(*_: Any) -> float:
    raise KeyError("mass")


def test_functions_of_numbers_that_fail_are_named() -> None:
    mend = "expected a function of the parameters' values"
    outcome = Planner(replace(cart(), check_state=_fails)).plan()
    assert outcome.status is PlanStatus.INVALID_STATE
    assert outcome.message.startswith("check_state: got \"KeyError: 'mass' at test_planner.py:")
    assert outcome.message.endswith(mend)
    settings = PlannerSettings(intervals=6, terminal_time=TerminalTime.FREE)
    for guess in (_fails, lambda _x, _p: None):
        hopeless = replace(cart(), final_state={"speed": lambda p: 1e9}, terminal_time_guess=guess)
        with pytest.raises(InvalidInputError, match="terminal_time_guess: got "):
            Planner(hopeless, settings).plan()
    # The bounds are read where the terminal time is fixed as well.
    for bounds in (_fails, lambda _p: 3.0):
        with pytest.raises(InvalidInputError, match="terminal_time_bounds: got "):
            Planner(replace(cart(), terminal_time_bounds=bounds))


def test_only_problems_are_planned() -> None:
    with pytest.raises(InvalidInputError, match=r"problems\.get"):
        Planner("powered_descent")  # type: ignore[arg-type]


def test_values_win_over_the_vehicle_and_both_over_the_settings() -> None:
    vehicle = Path(__file__).parents[3] / "config" / "vehicles" / "mars_lander.yaml"
    settings = PlannerSettings(parameters={"specific_impulse": 1.0, "thrust_prox": 3.0})
    planner = Planner(
        problems.get("powered_descent"), settings, vehicle=vehicle, parameters={"gravity": 3.5}
    )
    read = planner.problem.read_vehicle(vehicle)
    values = planner.problem.table.unpack(planner.parameters)
    assert values["specific_impulse"] == read["specific_impulse"]
    assert values["gravity"] == 3.5 != read["gravity"]
    assert values["thrust_prox"] == 3.0


def test_settings_by_name_win() -> None:
    problem = problems.get("powered_descent")
    given = PlannerSettings(intervals=30, parameters={"terminal_time": 34.0})
    planner = Planner(problem, given, intervals=20, terminal_time="free")
    assert (planner.settings.intervals, planner.settings.terminal_time) == (20, TerminalTime.FREE)
    assert planner.settings.parameters == {"terminal_time": 34.0}
    assert Planner(problems.get("entry"), intervals=20).settings.terminal_time is TerminalTime.FREE


@pytest.mark.parametrize(("name", "value"), [("terminal_time", "sometimes"), ("hold", "none")])
def test_settings_that_do_not_exist(name: str, value: str) -> None:
    with pytest.raises(InvalidInputError, match=rf"{name}: got .{value}."):
        Planner(problems.get("powered_descent"), **{name: value})

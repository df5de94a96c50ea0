from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.optimize import fsolve

from .powered_descent_nlp import (
    DescentOptimum,
    NlpOptions,
    Status,
    solve_fixed_time,
    solve_free_time,
    solve_least_time,
)
from .powered_descent_physics import (
    PAPER_INITIAL_STATE,
    PAPER_PARAMETERS,
    Array,
    DescentParameters,
    ThrustLaw,
    fly,
    state_jacobian,
    state_rate,
    thrust_jacobian,
)

VERTICAL_STATE = (3000.0, 0.0, 0.0, -150.0, 0.0, 0.0, 38000.0)


@pytest.fixture(scope="module")
def optimum() -> DescentOptimum:
    return solve_free_time(PAPER_INITIAL_STATE)


def magnitudes(vectors: Array) -> Array:
    lengths: Array = np.linalg.norm(vectors, axis=1)
    return lengths


def interval_means(nodes: Array) -> Array:
    return (nodes[1:] + nodes[:-1]) / 2.0


def test_jacobians_match_central_differences() -> None:
    state = np.array([4000.0, 300.0, -200.0, -120.0, 15.0, 25.0, 36000.0])
    thrust = np.array([4.0e5, -1.1e5, 0.7e5])

    def rate_of(values: Array) -> Array:
        return state_rate(values[:7], values[7:], PAPER_PARAMETERS)

    point = np.concatenate([state, thrust])
    steps = 1e-4 * np.maximum(np.abs(point), 1.0)
    differences = np.column_stack(
        [
            (rate_of(point + step) - rate_of(point - step)) / (2.0 * step.sum())
            for step in np.diag(steps)
        ]
    )
    exact = np.hstack(
        [state_jacobian(state, thrust), thrust_jacobian(state, thrust, PAPER_PARAMETERS)]
    )
    # Truncation is 1e-8 relative to each column; the smallest nonzero column entry is 1e-5.
    scale = np.abs(exact).max(axis=0)
    scale[scale == 0.0] = 1.0
    assert np.abs((differences - exact) / scale).max() < 1e-7


def test_flight_matches_the_rocket_equation() -> None:
    # Constant thrust along a fixed direction: velocity and position have closed forms.
    parameters = DescentParameters(gravity_m_s2=3.0)
    direction = np.array([0.6, -0.48, 0.64])
    thrust_n, duration_s, mass_kg = 5.0e5, 20.0, 38000.0
    exhaust = parameters.exhaust_speed_m_s
    flow = thrust_n / exhaust
    final_mass = mass_kg - flow * duration_s
    log_ratio = math.log(mass_kg / final_mass)
    gained_speed = exhaust * log_ratio
    gained_distance = exhaust * (duration_s - final_mass / flow * log_ratio)
    start = np.array([100.0, 20.0, -30.0, -10.0, 5.0, 2.0, mass_kg])
    fall = np.array([-parameters.gravity_m_s2, 0.0, 0.0])
    position = start[:3] + start[3:6] * duration_s + fall * duration_s**2 / 2.0
    expected = np.concatenate(
        [
            position + gained_distance * direction,
            start[3:6] + fall * duration_s + gained_speed * direction,
            [final_mass],
        ]
    )
    times = np.linspace(0.0, duration_s, 6)
    controls = np.tile(thrust_n * direction, (6, 1))
    for law in ThrustLaw:
        flight = fly(times, controls, start, parameters, law=law, target_state=expected[:6])
        # The integrator's relative tolerance is 1e-11 per step, on up to 4e4.
        np.testing.assert_allclose(flight.final_state, expected, rtol=1e-9, atol=1e-7)
        assert flight.miss_position_m < 1e-6
        assert flight.miss_speed_m_s < 1e-7


def test_linear_thrust_follows_the_line_between_the_nodes() -> None:
    # A vertical thrust growing from F to 3 F burns exactly 2 F T / exhaust speed.
    times = np.array([0.0, 4.0, 10.0])
    controls = np.array([[2.0e5, 0.0, 0.0], [3.6e5, 0.0, 0.0], [6.0e5, 0.0, 0.0]])
    flight = fly(times, controls, np.array(PAPER_INITIAL_STATE))
    burnt = 4.0e5 * 10.0 / PAPER_PARAMETERS.exhaust_speed_m_s
    assert flight.final_mass_kg == pytest.approx(38000.0 - burnt, abs=1e-6)
    # The held means of a line have the same integral but another path.
    held = fly(times, controls, np.array(PAPER_INITIAL_STATE), law=ThrustLaw.INTERVAL_MEAN)
    assert held.final_mass_kg == pytest.approx(flight.final_mass_kg, abs=1e-6)
    assert np.linalg.norm(held.final_state[:3] - flight.final_state[:3]) > 1.0


def test_paper_optimum(optimum: DescentOptimum) -> None:
    assert optimum.status is Status.OPTIMAL
    # The paper gives two decimals.
    assert optimum.terminal_time_s == pytest.approx(32.81, abs=0.005)


def test_optimum_does_not_depend_on_the_guess(optimum: DescentOptimum) -> None:
    for guess_s in (28.0, 40.0):
        other = solve_free_time(PAPER_INITIAL_STATE, terminal_time_guess_s=guess_s)
        # Mass is flat (67 kg/s^2) around the optimum, so that time is known less well than mass.
        assert other.terminal_time_s == pytest.approx(optimum.terminal_time_s, abs=1e-5)
        assert other.final_mass_kg == pytest.approx(optimum.final_mass_kg, abs=1e-6)


def test_optimum_is_the_same_in_every_vertical_plane() -> None:
    # Lateral velocity along the lateral position: the optimum stays in one plane.
    along_axis = solve_free_time((5200.0, 600.0, 0.0, -135.0, 20.0, 0.0, 38000.0))
    rotated = solve_free_time((5200.0, 360.0, -480.0, -135.0, 12.0, -16.0, 38000.0))
    assert along_axis.status is Status.OPTIMAL
    assert rotated.status is Status.OPTIMAL
    assert rotated.terminal_time_s == pytest.approx(along_axis.terminal_time_s, abs=1e-5)
    assert rotated.final_mass_kg == pytest.approx(along_axis.final_mass_kg, abs=1e-6)


def test_paper_least_terminal_time() -> None:
    least = solve_least_time(PAPER_INITIAL_STATE)
    assert least.status is Status.OPTIMAL
    # The paper's grid of 0.01 s finds no solution up to 32.05 s.
    assert 32.04 < least.terminal_time_s < 32.05
    shortest = solve_fixed_time(PAPER_INITIAL_STATE, least.terminal_time_s + 0.01)
    assert shortest.status is Status.OPTIMAL
    below = solve_fixed_time(PAPER_INITIAL_STATE, least.terminal_time_s - 0.01)
    assert below.status is not Status.OPTIMAL


def test_optimum_satisfies_the_constraints(optimum: DescentOptimum) -> None:
    parameters = PAPER_PARAMETERS
    states, controls = optimum.states, optimum.controls
    step_s = optimum.terminal_time_s / (len(states) - 1)
    rates = np.array(
        [
            state_rate(state, thrust, parameters)
            for state, thrust in zip(interval_means(states), interval_means(controls), strict=True)
        ]
    )
    # IPOPT's 1e-10 refers to units of 5000 m, 150 m/s and 38 t.
    defects = np.diff(states, axis=0) - step_s * rates
    assert np.abs(defects).max() < 1e-5
    np.testing.assert_array_equal(states[0], PAPER_INITIAL_STATE)
    np.testing.assert_array_equal(states[-1, :6], np.zeros(6))
    thrust_n = magnitudes(controls)
    assert thrust_n.min() > parameters.thrust_min_n - 1e-3
    assert thrust_n.max() < parameters.thrust_max_n + 1e-3
    assert magnitudes(interval_means(controls)).min() > parameters.thrust_min_n - 1e-3
    tilt_rad = np.arctan2(magnitudes(controls[:, 1:]), controls[:, 0])
    assert tilt_rad.max() < parameters.pointing_max_rad + 1e-8
    slope_rad = np.arctan2(magnitudes(states[1:-1, 1:3]), states[1:-1, 0])
    assert slope_rad.max() < parameters.glideslope_max_rad


def test_mass_slope_matches_central_differences() -> None:
    step_s = 1e-3
    for time_s in (32.5, 34.0):
        ahead = solve_fixed_time(PAPER_INITIAL_STATE, time_s + step_s)
        behind = solve_fixed_time(PAPER_INITIAL_STATE, time_s - step_s)
        slope = solve_fixed_time(PAPER_INITIAL_STATE, time_s).mass_slope_kg_s
        difference = (ahead.final_mass_kg - behind.final_mass_kg) / (2.0 * step_s)
        # The regularisation shifts the slope by up to 1e-4 kg/s, the truncation by as much.
        assert slope == pytest.approx(difference, abs=1e-3)


def test_flown_optimum_lands(optimum: DescentOptimum) -> None:
    start = np.array(PAPER_INITIAL_STATE)
    held = fly(optimum.times_s, optimum.controls, start, law=ThrustLaw.INTERVAL_MEAN)
    linear = fly(optimum.times_s, optimum.controls, start, law=ThrustLaw.LINEAR)
    # The midpoint rule burns exactly the interval means' mass.
    assert held.final_mass_kg == pytest.approx(optimum.final_mass_kg, abs=1e-5)
    # The rule's error at N = 50 is 0.12 m with the means held and 0.7 m with linear thrust.
    assert held.miss_position_m < 0.3
    assert linear.miss_position_m < 1.5
    assert held.miss_position_m < linear.miss_position_m


def vertical_bang_bang() -> tuple[float, float]:
    """Terminal time and final mass of the continuous vertical optimum: least, then most thrust."""
    parameters = PAPER_PARAMETERS
    exhaust = parameters.exhaust_speed_m_s

    def arc(state: Array, thrust_n: float, duration_s: float) -> Array:
        height, climb, mass = state
        flow = thrust_n / exhaust
        final_mass = mass - flow * duration_s
        log_ratio = math.log(mass / final_mass)
        gravity = parameters.gravity_m_s2
        return np.array(
            [
                height
                + climb * duration_s
                - gravity * duration_s**2 / 2.0
                + exhaust * (duration_s - final_mass / flow * log_ratio),
                climb - gravity * duration_s + exhaust * log_ratio,
                final_mass,
            ]
        )

    def end(durations_s: Array) -> Array:
        start = np.array([VERTICAL_STATE[0], VERTICAL_STATE[3], VERTICAL_STATE[6]])
        coasted = arc(start, parameters.thrust_min_n, float(durations_s[0]))
        return arc(coasted, parameters.thrust_max_n, float(durations_s[1]))

    def miss(durations_s: Array) -> Array:
        return end(durations_s)[:2]

    durations_s = fsolve(miss, np.array([10.0, 12.0]))
    final = end(durations_s)
    assert np.abs(final[:2]).max() < 1e-6
    return float(durations_s.sum()), float(final[2])


def test_vertical_descent_matches_its_closed_form() -> None:
    terminal_time_s, final_mass_kg = vertical_bang_bang()
    fine = solve_free_time(VERTICAL_STATE, options=NlpOptions(intervals=200))
    assert fine.status is Status.OPTIMAL
    # A switch inside an interval is smeared over 0.1 s.
    assert fine.terminal_time_s == pytest.approx(terminal_time_s, abs=0.005)
    assert fine.final_mass_kg == pytest.approx(final_mass_kg, abs=0.5)


def test_open_mean_bound_lets_the_discrete_problem_beat_the_continuous_one() -> None:
    _, final_mass_kg = vertical_bang_bang()
    closed = solve_free_time(VERTICAL_STATE)
    loose = solve_free_time(VERTICAL_STATE, options=NlpOptions(bound_mean_thrust=False))
    assert closed.status is Status.OPTIMAL
    assert loose.status is Status.OPTIMAL
    least_mean_n = magnitudes(interval_means(loose.controls)).min()
    assert least_mean_n < 0.9 * PAPER_PARAMETERS.thrust_min_n
    assert loose.final_mass_kg > final_mass_kg + 10.0
    # The discretisation costs a few tenths of a kilogram.
    assert closed.final_mass_kg == pytest.approx(final_mass_kg, abs=1.0)

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.linalg

from dscp_core import problems
from dscp_core.errors import InvalidInputError
from dscp_core.problems.powered_descent.guidance.observer import Observer, steady_gain
from dscp_core.problems.powered_descent.guidance.settings import GuidanceSettings
from dscp_core.problems.powered_descent.guidance.vehicle import Engine, Vehicle

PROBLEM = problems.get("powered_descent")
VALUES = PROBLEM.table.unpack(PROBLEM.pack({}))
VEHICLE = Vehicle.of(VALUES)


def engine(settings: GuidanceSettings) -> Engine:
    return Engine(
        VEHICLE,
        lag_s=settings.known_lag_s,
        attitude_response_s=settings.known_attitude_response_s,
        throttle_rate_n_s=settings.known_throttle_rate_n_s,
        latency_s=settings.known_command_latency_s,
    )


def independent_gain(settings: GuidanceSettings) -> np.ndarray:
    """From SciPy's solution of the algebraic Riccati equation."""
    t = settings.tick_s
    f = np.array([[1.0, t, t * t / 2.0], [0.0, 1.0, t], [0.0, 0.0, 1.0]])
    h = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    gust = settings.acceleration_noise_m_s2 * np.array([t * t / 2.0, t, 0.0])
    walk = settings.bias_walk * math.sqrt(t) * np.array([t * t / 6.0, t / 2.0, 1.0])
    r = np.diag([settings.position_noise_m**2, settings.velocity_noise_m_s**2])
    q = np.outer(gust, gust) + np.outer(walk, walk)
    p = scipy.linalg.solve_discrete_are(f.T, h.T, q, r)
    return np.asarray(p @ h.T @ np.linalg.inv(h @ p @ h.T + r))


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"tick_s": 0.05},
        {"position_noise_m": 5.0, "bias_walk": 0.01},
        {"velocity_noise_m_s": 1.0},
    ],
)
def test_the_gain_is_that_of_the_riccati_equation(changes: dict[str, float]) -> None:
    settings = GuidanceSettings(**changes)
    assert np.allclose(steady_gain(settings), independent_gain(settings), rtol=1e-6, atol=1e-9)


def test_it_is_an_independent_kalman_filter_of_a_falling_vehicle() -> None:
    """With the engine off the motion is linear, and a filter of three lines gives the same."""
    settings = GuidanceSettings(known_delay_s=0.0)
    observer, random = Observer(settings, engine(settings)), np.random.default_rng(3)
    gain, tick = independent_gain(settings), settings.tick_s
    pull = np.array([-VEHICLE.gravity_m_s2, 0.0, 0.0])
    position = velocity = bias = np.zeros(3)
    for k in range(30):
        measured = np.array([*random.normal(size=6) * 10.0, 1000.0])
        observer.measure(k * tick, measured)
        if k == 0:
            position, velocity = measured[0:3], measured[3:6]
            continue
        position = position + tick * velocity + 0.5 * tick**2 * (pull + bias)
        velocity = velocity + tick * (pull + bias)
        surprise = np.array([measured[0:3] - position, measured[3:6] - velocity])
        correction = gain @ surprise
        position, velocity = position + correction[0], velocity + correction[1]
        bias = bias + correction[2]
    seen = observer.at(29 * tick)
    assert np.allclose(seen.position, position, rtol=0.0, atol=1e-6)
    assert np.allclose(seen.velocity, velocity, rtol=0.0, atol=1e-6)
    assert np.allclose(observer.bias, bias, rtol=0.0, atol=1e-6)


def test_delay_and_latency_are_bridged_by_what_was_commanded() -> None:
    """Constant thrust behind a lag has a closed form; the mass hardly changes at this impulse."""
    values = {**VALUES, "specific_impulse": 1e4, "thrust_min": 1.0}
    vehicle = Vehicle.of(values)
    settings = GuidanceSettings(known_delay_s=0.25, known_command_latency_s=0.06)
    known = Engine(
        vehicle, lag_s=0.1, attitude_response_s=0.1, throttle_rate_n_s=math.inf, latency_s=0.06
    )
    observer = Observer(settings, known)
    observer.measure(0.25, np.array([100.0, 0.0, 0.0, -5.0, 1.0, 0.0, 1000.0]))  # as at 0 s
    known.command(0.25, np.array([2.0e4, 0.0, 0.0]))  # reaches the engine at 0.31 s
    seen = observer.at(1.31)
    lit_s, lag_s = 1.0, 0.1
    gained = 20.0 * (lit_s - lag_s * (1.0 - math.exp(-lit_s / lag_s)))
    assert seen.velocity[0] == pytest.approx(-5.0 - VEHICLE.gravity_m_s2 * 1.31 + gained, abs=2e-2)
    assert seen.position[1] == pytest.approx(1.31, abs=1e-9)
    assert seen.thrust_n == pytest.approx(2.0e4, rel=1e-4)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_measurement_that_is_not_finite_is_refused(bad: float) -> None:
    observer = Observer(GuidanceSettings(), engine(GuidanceSettings()))
    with pytest.raises(InvalidInputError, match="measured state"):
        observer.measure(0.0, np.array([0.0, 0.0, bad, 0.0, 0.0, 0.0, 1.0]))
    assert not observer.started


def test_a_measurement_out_of_order_is_refused_and_changes_nothing() -> None:
    observer = Observer(GuidanceSettings(), engine(GuidanceSettings()))
    with pytest.raises(InvalidInputError, match="measurements"):
        observer.at(0.0)
    state = np.array([100.0, 0.0, 0.0, -5.0, 0.0, 0.0, 1000.0])
    observer.measure(1.0, state)
    with pytest.raises(InvalidInputError, match="time of a measurement"):
        observer.measure(1.0, state + 1.0)
    with pytest.raises(InvalidInputError, match="mass"):
        observer.measure(1.1, -state)
    assert observer.at(0.95).position == pytest.approx(state[0:3])


@pytest.mark.parametrize("time_s", [math.nan, math.inf])
def test_a_time_that_is_none_is_refused(time_s: float) -> None:
    settings = GuidanceSettings()
    observer, state = Observer(settings, engine(settings)), np.full(7, 100.0)
    with pytest.raises(InvalidInputError, match="time of a measurement"):
        observer.measure(time_s, state)
    observer.measure(0.0, state)
    for late_s in (time_s, 1e9):
        with pytest.raises(InvalidInputError, match="1000 s after the last measurement"):
            observer.at(late_s)


def test_commands_do_not_go_back_in_time() -> None:
    driven = engine(GuidanceSettings())
    driven.command(5.0, np.array([3e5, 0.0, 0.0]))
    with pytest.raises(InvalidInputError, match=r"time of a command: got 4.9, expected >= 5 s"):
        driven.command(4.9, np.array([2e5, 0.0, 0.0]))

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.integrate

from dscp_core import problems
from dscp_core.errors import InvalidInputError
from dscp_core.problems.powered_descent.motion import Event, TrueMotion
from dscp_core.problems.powered_descent.truth import TruthSettings, World, true_parameters

PROBLEM = problems.get("powered_descent")
VALUES = PROBLEM.table.unpack(PROBLEM.pack({}))
MOTION = TrueMotion()
UP = [1.0, 0.0, 0.0]


def independent(
    state: np.ndarray,
    command: np.ndarray,
    wind: np.ndarray,
    truth: TruthSettings,
    duration_s: float,
) -> scipy.integrate.OdeSolution:
    """The same world, written down again, and its contact, by DOP853."""

    def rates(_: float, x: np.ndarray) -> np.ndarray:
        v, m, thrust, d = x[3:6], x[6], x[7], x[8:11]
        air = 0.5 * 1.225 * math.exp(-x[0] / 8500.0) * truth.drag_area_m2
        push = thrust * d / np.linalg.norm(d) - air * np.linalg.norm(v) * v
        change = np.clip(
            (command[0] - thrust) / truth.lag_s, -truth.throttle_rate_n_s, truth.throttle_rate_n_s
        )
        turn = (command[1:4] - d) / truth.attitude_response_s
        fall = np.array([-9.80655, 0.0, 0.0])
        return np.array([*v, *(push / m + wind + fall), -thrust / (282.0 * 9.80655), change, *turn])

    def ground(_: float, x: np.ndarray) -> float:
        return float(x[0])

    ground.terminal, ground.direction = True, -1.0  # type: ignore[attr-defined]
    return scipy.integrate.solve_ivp(
        rates, (0.0, duration_s), state, method="DOP853", rtol=1e-11, atol=1e-9, events=ground
    )


@pytest.mark.parametrize(
    "truth",
    [
        TruthSettings(),
        TruthSettings(drag_area_m2=20.0, attitude_response_s=0.5),
        TruthSettings(lag_s=0.3, throttle_rate_n_s=4e5),
    ],
    ids=["default", "air", "slow throttle"],
)
def test_the_motion_and_its_contact_are_those_of_an_independent_integrator(
    truth: TruthSettings,
) -> None:
    state = np.array([60.0, 5.0, -3.0, -30.0, 2.0, 1.0, 32000.0, 200e3, 0.98, 0.1, -0.05])
    command = np.array([500e3, 0.99, -0.1, 0.02])
    wind = np.array([0.1, -0.2, 0.05])
    parameters = true_parameters(VALUES, truth, 0.0)
    expected = independent(state, command, wind, truth, 5.0)
    assert expected.status == 1
    flown_s, end, event = MOTION.fly(state, command, wind, parameters, 5.0, 0.0, 0.0)
    assert event is Event.CONTACT
    assert flown_s == pytest.approx(expected.t[-1], abs=2e-6)
    scale = np.array([1.0] * 6 + [1e3, 1e5, 1.0, 1.0, 1.0])
    assert np.all(np.abs(end - expected.y[:, -1]) <= 2e-5 * scale)
    assert abs(end[0]) < 1e-12  # contact to rounding, whatever the steps


def test_a_touch_within_a_step_is_contact() -> None:
    """Braking at 40 m/s^2 from 0.1 m/s takes 2.5 ms and 0.125 mm: up again before the step ends."""
    truth = TruthSettings(lag_s=0.0, attitude_response_s=0.0)
    parameters = true_parameters(VALUES, truth, 0.0)
    thrust = 10000.0 * (40.0 + 9.80655)
    for altitude, touches in ((1.24e-4, True), (1.26e-4, False)):
        state = np.array([altitude, 0, 0, -0.1, 0, 0, 10000.0, thrust, *UP])
        command = np.array([thrust, *UP])
        flown_s, end, event = MOTION.fly(state, command, np.zeros(3), parameters, 0.0125, 0.0, 0.0)
        assert event is (Event.CONTACT if touches else None)
        assert end[3] < 0.0 if touches else end[3] > 0.3
        assert (flown_s < 0.0025) is touches


def test_the_engine_stops_where_the_last_propellant_is_burnt() -> None:
    """From that moment on it falls, whatever is commanded."""
    values = {**VALUES, "dry_mass": 37000.0}
    truth = TruthSettings(dispersion=0.0, wind_m_s2=0.0, lag_s=0.0)
    world = World(MOTION, values, truth, seed=1)
    world.set_command(np.array([500e3, 0.0, 0.0]))
    exhaust = 282.0 * 9.80655
    assert world.fly(6.0)
    assert world.dry_s == pytest.approx(1000.0 * exhaust / 500e3)
    assert world.state[3] == pytest.approx(-150.0 + exhaust * math.log(38.0 / 37.0) - 6.0 * 9.80655)
    world.set_command(np.array([500e3, 0.0, 0.0]))
    assert world.fly(7.0)
    assert np.linalg.norm(world.thrust) == 0.0
    assert world.state[6] == pytest.approx(37000.0, abs=1e-6)


def test_propellant_that_ends_after_contact_in_the_same_step_is_contact() -> None:
    parameters = true_parameters(VALUES, TruthSettings(), 0.0)
    state = np.array([0.05, 0, 0, -10.0, 0, 0, 30000.0, 500e3, *UP])
    command = np.array([500e3, *UP])
    for dry_kg, expected in ((29999.5, Event.DRY), (29998.5, Event.CONTACT)):  # 0.9 kg until then
        _, end, event = MOTION.fly(state, command, np.zeros(3), parameters, 0.0125, 0.0, dry_kg)
        assert event is expected
        assert bool(end[0] > 1e-3) is (event is Event.DRY)


def test_the_engine_keeps_its_bounds_and_shows_its_errors() -> None:
    truth = TruthSettings(lag_s=0.0, attitude_response_s=0.0, wind_m_s2=0.0)
    world = World(MOTION, VALUES, truth, seed=4)
    for asked in (1.0, 300e3, 1e9):
        world.set_command(np.array([asked, 0.0, 0.0]))
        made = float(np.linalg.norm(world.thrust))
        expected = min(max(asked * (1.0 + world.errors.thrust), 169e3), 845.2e3)
        assert made == pytest.approx(expected, rel=1e-12)
        tilt = math.acos(world.thrust[0] / made)
        off = float(np.linalg.norm(world.errors.thrust_direction_rad))
        assert tilt == pytest.approx(off, rel=1e-3)
    world.set_command(None)
    assert np.linalg.norm(world.thrust) == 0.0


def test_errors_have_their_size_and_none_moves_another() -> None:
    truth = TruthSettings(navigation_bias_m=0.3)
    errors = [World(MOTION, VALUES, truth, seed).errors for seed in range(400)]
    spread = np.std([e.initial_state for e in errors], axis=0)
    assert spread == pytest.approx([50.0] * 3 + [3.0] * 3 + [190.0], rel=0.15)
    assert np.std([e.navigation_bias[:3] for e in errors]) == pytest.approx(0.3, rel=0.1)
    twice = World(MOTION, VALUES, TruthSettings(dispersion=2.0, wind_m_s2=0.0), 7).errors
    once = World(MOTION, VALUES, TruthSettings(), 7).errors
    assert twice.initial_state == pytest.approx(2.0 * once.initial_state)


@pytest.mark.parametrize("correlation_s", [0.0, 5.0])
def test_wind_has_its_size_and_its_memory(correlation_s: float) -> None:
    truth = TruthSettings(wind_correlation_s=correlation_s)
    world, winds = World(MOTION, VALUES, truth, seed=1), []
    for _ in range(20000):
        world.blow(0.1)
        winds.append(world._wind)
    series = np.array(winds)
    assert np.std(series) == pytest.approx(0.1, rel=0.1)
    memory = np.mean(series[:-10] * series[10:]) / np.mean(series**2)
    expected = math.exp(-1.0 / correlation_s) if correlation_s else 0.0
    assert memory == pytest.approx(expected, abs=0.05)


def test_the_errors_of_the_start_follow_the_mission() -> None:
    paper = TruthSettings.suited(VALUES)
    assert paper.initial_position_m == pytest.approx(50.0, rel=0.01)
    assert paper.initial_velocity_m_s == pytest.approx(3.0, rel=0.01)
    hop = TruthSettings.suited({**VALUES, "initial_position": (100.0, 0.0, 0.0)})
    assert hop.initial_position_m == pytest.approx(1.0, rel=0.02)


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"thrust_scale": -0.1}, "thrust_scale"),
        ({"wind_m_s2": math.nan}, "wind_m_s2"),
        ({"lag_s": 1e-4}, "lag_s"),
        ({"lag_s": 0.0, "throttle_rate_n_s": 1e5}, "lag_s"),
        ({"late_plans": 1.5}, "late_plans"),
        ({"dispersion": 100.0}, "dispersion"),
        ({"drag_area_m2": 1e6}, "drag_area_m2"),
    ],
)
def test_a_bad_truth_is_named(changes: dict[str, float], field: str) -> None:
    with pytest.raises(InvalidInputError) as caught:
        TruthSettings.suited(VALUES, **changes)
    assert caught.value.field == field

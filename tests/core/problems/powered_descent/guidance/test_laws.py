from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.integrate

from dscp_core import problems
from dscp_core.errors import InvalidInputError
from dscp_core.problems.powered_descent.guidance.laws import profile_thrust
from dscp_core.problems.powered_descent.guidance.settings import GuidanceSettings
from dscp_core.problems.powered_descent.guidance.vehicle import Motion, Vehicle
from dscp_core.problems.powered_descent.truth import TruthSettings

PROBLEM = problems.get("powered_descent")
VALUES = PROBLEM.table.unpack(PROBLEM.pack({}))
VEHICLE, SETTINGS = Vehicle.of(VALUES), GuidanceSettings()
MASS_KG = 31800.0
NO_BIAS = np.zeros(3)


def at(position: list[float], velocity: list[float], time_s: float = 0.0) -> Motion:
    return Motion(time_s, np.array(position), np.array(velocity), MASS_KG)


def test_on_the_profile_the_thrust_carries_and_brakes() -> None:
    descent = SETTINGS.profile_descent_m_s(3.0)
    assert descent == pytest.approx(math.sqrt(0.25**2 + 2.0 * 4.0 * (3.0 - 0.12)))
    force = profile_thrust(SETTINGS, VEHICLE, at([3.0, 0.0, 0.0], [-descent, 0.0, 0.0]), NO_BIAS)
    assert force == pytest.approx([MASS_KG * (VEHICLE.gravity_m_s2 + 4.0), 0.0, 0.0])


def test_the_last_stretch_knows_no_clock() -> None:
    here = ([2.0, 0.3, -0.1], [-3.0, 0.1, 0.2])
    early, late = (profile_thrust(SETTINGS, VEHICLE, at(*here, t), NO_BIAS) for t in (0.0, 1e3))
    assert np.array_equal(early, late)


@pytest.mark.parametrize("descent_m_s", [0.0, 2.0, 6.9, 10.0])
def test_it_reaches_the_ground_at_its_descent(descent_m_s: float) -> None:
    """From any descent at the gate: never upwards for good, and never hard."""

    def rates(_: float, x: np.ndarray) -> np.ndarray:
        force = profile_thrust(SETTINGS, VEHICLE, at([x[0], 0, 0], [x[1], 0, 0]), NO_BIAS)
        return np.array([x[1], force[0] / MASS_KG - VEHICLE.gravity_m_s2])

    def ground(_: float, x: np.ndarray) -> float:
        return float(x[0])

    ground.terminal = True  # type: ignore[attr-defined]
    flown = scipy.integrate.solve_ivp(
        rates, (0.0, 20.0), [6.0, -descent_m_s], events=ground, max_step=0.01
    )
    assert flown.status == 1
    assert -flown.y[1, -1] == pytest.approx(SETTINGS.contact_descent_m_s, abs=0.05)


def test_the_tilt_shrinks_towards_the_ground() -> None:
    for altitude in (0.0, 1.0, 6.0):
        force = profile_thrust(SETTINGS, VEHICLE, at([altitude, 50.0, 0.0], [-1.0, 0, 0]), NO_BIAS)
        tilt = math.degrees(math.atan2(-force[1], force[0]))
        assert tilt == pytest.approx(2.5 + 2.0 * altitude, abs=1e-9)
    below = profile_thrust(SETTINGS, VEHICLE, at([-1.0, 50.0, 0.0], [-1.0, 0, 0]), NO_BIAS)
    assert math.atan2(-below[1], below[0]) == pytest.approx(SETTINGS.contact_tilt_max_rad)


def test_every_command_can_be_given() -> None:
    random = np.random.default_rng(5)
    for _ in range(500):
        asked = random.normal(size=3) * 10.0 ** random.uniform(2.0, 7.0)
        tilt = random.uniform(0.0, 1.5)
        force = VEHICLE.limited(asked, tilt)
        size = np.linalg.norm(force)
        assert VEHICLE.thrust_min_n * (1 - 1e-12) <= size <= VEHICLE.thrust_max_n * (1 + 1e-12)
        most = min(tilt, VEHICLE.pointing_angle_max_rad)
        assert math.hypot(force[1], force[2]) <= force[0] * math.tan(most) * (1 + 1e-9) + 1e-6
        assert VEHICLE.limited(force, tilt) == pytest.approx(force, rel=1e-9, abs=1e-3)


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"replan_s": 0.0}, "replan_s"),
        ({"tick_s": math.nan}, "tick_s"),
        ({"reserve": 0.6, "early_reserve": 0.5}, "early_reserve"),
        ({"contact_margin_m": 7.0}, "contact_margin_m"),
        ({"position_noise_m": -1.0}, "position_noise_m"),
        ({"contact_descent_m_s": 0.0}, "contact_descent_m_s"),  # it would hover for good
        ({"known_delay_s": 1e5}, "known_delay_s"),
    ],
)
def test_bad_settings_are_named(changes: dict[str, float], field: str) -> None:
    with pytest.raises(InvalidInputError) as caught:
        GuidanceSettings(**changes)
    assert caught.value.field == field


def test_what_suits_the_papers_vehicle_are_the_defaults() -> None:
    suited = GuidanceSettings.suited(VALUES, 31760.0)
    for name in GuidanceSettings.SUITED:
        assert getattr(suited, name) == pytest.approx(getattr(SETTINGS, name), rel=0.02), name


def test_a_vehicle_that_cannot_hover_has_another_law() -> None:
    # Least thrust of 338 kN on 24.2 t brakes by 4.2 m/s^2.
    values = {**VALUES, "thrust_min": 338080.0}
    settings = GuidanceSettings.suited(values, 24245.0)
    assert settings.cut_off == 1.0
    assert settings.profile_deceleration_m_s2 > 338080.0 / 24245.0 - VEHICLE.gravity_m_s2
    with pytest.raises(InvalidInputError, match="weight at landing"):
        GuidanceSettings.suited(values, 1e6)


def test_the_gate_is_below_the_start() -> None:
    """Plans to a gate above a start are refused, and without one the vehicle would fall."""
    low = {**VALUES, "initial_position": (3.0, 0.0, 0.0)}
    assert GuidanceSettings.suited(low, 31760.0).gate_altitude_m == 1.5
    with pytest.raises(InvalidInputError, match=r"gate_altitude_m: got 6.0, expected < 3 m"):
        GuidanceSettings.suited(low, 31760.0, gate_altitude_m=6.0)


def test_the_throttle_rate_is_the_vehicles() -> None:
    slow = {**VALUES, "thrust_rate_max": 4e5}
    assert GuidanceSettings.suited(slow, 31760.0).known_throttle_rate_n_s == 4e5
    assert TruthSettings.suited(slow).throttle_rate_n_s == 4e5
    assert TruthSettings.suited(slow, throttle_rate_n_s=3e5).throttle_rate_n_s == 3e5

"""Entries in closed loop: where they end, what they learn, and how they are integrated."""

from __future__ import annotations

import math
import pickle
from dataclasses import replace

import numpy as np
import pytest
import scipy.integrate
from numpy.typing import NDArray
from oracles import entry_physics

from dscp_core import problems
from dscp_core.errors import InvalidInputError
from dscp_core.planning.planner import Planner
from dscp_core.problems.entry.guidance import AirEstimate, GuidanceSettings
from dscp_core.problems.entry.motion import LIMITED, Motion
from dscp_core.problems.entry.simulation import EntrySimulation, NothingToFlyError
from dscp_core.problems.entry.truth import ARRIVED, GROUND, Target, TrueMotion, TruthSettings

Array = NDArray[np.float64]

PROBLEM = problems.get("entry")
SIMULATED = PROBLEM.extras.simulation
assert SIMULATED is not None
VALUES = PROBLEM.table.unpack(PROBLEM.table.pack())
TARGET = Target.of(VALUES)
FAR = np.array([6430e3, 0.5, 0.05, 6000.0, -0.003, 1.5, 0.3, 0.2])


@pytest.fixture(scope="module")
def planner() -> Planner:
    return Planner(PROBLEM)


@pytest.fixture(scope="module")
def usual(planner: Planner) -> EntrySimulation:
    return SIMULATED(planner, {"replan_s": 300.0, "replan_part": 0.3})


def test_steps_are_those_of_another_integrator() -> None:
    motion, packed = Motion(PROBLEM), PROBLEM.table.pack()
    rates = np.array([1e-4, -3e-4])
    flown = FAR
    for _ in range(50):
        flown = motion.step(flown, rates, packed, 2.0)
    position, velocity = entry_physics.to_cartesian(FAR)
    cartesian = scipy.integrate.solve_ivp(
        lambda t, y: np.concatenate(
            [y[3:], entry_physics.acceleration(spherical(y, FAR[6:] + rates * t), VALUES)]
        ),
        (0.0, 100.0),
        np.concatenate([position, velocity]),
        method="DOP853",
        rtol=1e-12,
        atol=1e-6,
    )
    # Two centimetres of 600 km, and a thousandth of a millimetre per second.
    assert flown == pytest.approx(
        spherical(cartesian.y[:, -1], FAR[6:] + 100.0 * rates), rel=3e-9, abs=3e-9
    )
    loads = motion.loads(FAR, packed)
    assert dict(zip(LIMITED, loads, strict=True)) == pytest.approx(
        entry_physics.limits(FAR, VALUES), rel=1e-12
    )


def spherical(motion: Array, angles: Array) -> Array:
    """State (8,) of position and velocity in Cartesian axes, and two angles."""
    return np.concatenate([entry_physics.to_spherical(motion[:3], motion[3:]), angles])


def near_target(along_m: float, across_m: float, altitude_m: float, gamma: float) -> Array:
    """A state east-bound near the target."""
    east = along_m / (TARGET.radius_m * math.cos(TARGET.latitude_rad))
    state = FAR.copy()
    state[:6] = (
        *(TARGET.radius_m + altitude_m, TARGET.longitude_rad + east),
        *(TARGET.latitude_rad - across_m / TARGET.radius_m, 2000.0, gamma, math.pi / 2.0),
    )
    return state


def test_it_ends_abeam_of_the_target_to_the_last_digit() -> None:
    motion, packed = TrueMotion(PROBLEM), PROBLEM.table.pack()
    start = near_target(-5000.0, 300.0, 100.0, 0.0)
    flown_s, end, _, ending = motion.fly(start, np.zeros(2), packed, 20.0, TARGET)
    assert ending == ARRIVED
    along, across = TARGET.offset_m(end)
    assert abs(along) < 1e-5
    assert across == pytest.approx(300.0, abs=20.0)
    assert flown_s == pytest.approx(2.5, rel=0.01)
    before_s, _, _, ending = motion.fly(start, np.zeros(2), packed, 0.5 * flown_s, TARGET)
    assert (before_s, ending) == (0.5 * flown_s, "")


def test_it_ends_at_the_ground() -> None:
    motion, packed = TrueMotion(PROBLEM), PROBLEM.table.pack()
    start = near_target(-4e5, 0.0, TARGET.ground_m - TARGET.radius_m + 500.0, -0.5)
    start[6:] = 0.0  # with lift, it would climb
    flown_s, end, _, ending = motion.fly(start, np.zeros(2), packed, 20.0, TARGET)
    assert ending == GROUND
    assert end[0] == pytest.approx(TARGET.ground_m, abs=1e-3)
    assert 0.0 < flown_s < 1.0


def test_the_far_side_of_the_planet_is_not_the_target() -> None:
    for longitude in np.linspace(-3.0, 3.0, 61) + TARGET.longitude_rad:
        state = near_target(0.0, 0.0, 0.0, 0.0)
        state[1] = longitude
        beyond = 0.0 <= longitude - TARGET.longitude_rad < 0.05
        assert (TARGET.passed_m(state) >= 0.0) == beyond


def test_without_errors_it_arrives_where_it_planned_to(planner: Planner) -> None:
    simulation = SIMULATED(planner, {"dispersion": 0.0, "replan_s": 300.0})
    figures = simulation.fly(1).figures
    assert figures["altitude_error_m"] < 5.0
    assert figures["cross_track_error_m"] < 5.0
    assert figures["refused_replans"] == 0.0
    # Plans keep four percent of every limit.
    assert 0.93 < figures["heat_rate_ratio"] < 0.97


def test_a_dispersed_flight_and_its_record(usual: EntrySimulation) -> None:
    record = usual.record(3)
    assert record.summary.failure == ""
    judged = {f.name: f.most for f in usual.figures if f.judged}
    assert all(record.summary.figures[name] <= most for name, most in judged.items())
    rows = len(record.times_s)
    for name in ("states", "measured", "measured_at_s", "commanded", "controls", "phases"):
        assert len(getattr(record, name)) == rows, name
    assert all(len(values) == rows for values in record.histories.values())
    limits = [VALUES["angle_of_attack_rate_max"], VALUES["bank_rate_max"]]
    assert np.all(np.abs(record.commanded) <= np.array(limits) + 1e-12)
    assert record.states[:, 6].max() <= VALUES["angle_of_attack_max"] + 3.0 * 5e-4
    assert record.events[-1] == (record.times_s[-1], ARRIVED)
    # The same flight by a copy, whatever flew before.
    copy = pickle.loads(pickle.dumps(usual))
    assert copy.fly(3) == record.summary
    assert copy.fly(4) != record.summary
    assert copy.fly(3) == record.summary


def test_what_it_learns_of_the_air() -> None:
    """Lift and drag of another vehicle, from noisy measurements of its flight."""
    planner, settings = Planner(PROBLEM), GuidanceSettings()
    truth = PROBLEM.table.pack(
        {
            "sea_level_density": 1.06 * float(VALUES["sea_level_density"]),
            "lift_coefficients": 0.95 * np.asarray(VALUES["lift_coefficients"]),
        }
    )
    motion, estimate = Motion(PROBLEM), AirEstimate(planner, settings)
    random = np.random.default_rng(2)
    noise = np.array([20.0, 3e-6, 3e-6, 0.1, 1e-4, 1e-4, 5e-4, 5e-4])
    state = FAR
    for _ in range(150):
        estimate.update(state + noise * random.standard_normal(8), np.zeros(2), settings.tick_s)
        state = motion.step(state, np.zeros(2), truth, settings.tick_s)
    assert estimate.factors == pytest.approx([1.06 * 0.95, 1.06], abs=0.02)
    nominal = planner.parameters.copy()
    estimate.apply(planner, nominal)
    told = PROBLEM.table.unpack(planner.parameters)
    assert told["sea_level_density"] == pytest.approx(1.06 * 1.225, rel=0.02)
    deaf = AirEstimate(planner, replace(settings, air_known_to=0.0))
    for _ in range(3):
        deaf.update(state, np.zeros(2), settings.tick_s)
    assert np.array_equal(deaf.factors, [1.0, 1.0])


def test_refusals(planner: Planner) -> None:
    with pytest.raises(InvalidInputError, match="free, to plan in flight"):
        SIMULATED(Planner(PROBLEM, terminal_time="fixed"), {})
    with pytest.raises(InvalidInputError, match="densty"):
        SIMULATED(planner, {"densty": 0.1})
    with pytest.raises(InvalidInputError, match="density"):
        TruthSettings(density=-0.1)
    with pytest.raises(NothingToFlyError):
        SIMULATED(Planner(PROBLEM, parameters={"heat_rate_max": 1e5}), {})


def test_settings_name_every_option(usual: EntrySimulation) -> None:
    options = {p.name for p in (*SIMULATED.truth, *SIMULATED.guidance, *SIMULATED.bounds)}
    told = usual.settings
    assert set(told["truth"]) | set(told["guidance"]) | set(told["bounds"]) == options
    assert told["guidance"]["replan_s"] == 300.0

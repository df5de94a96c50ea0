from __future__ import annotations

import math
from dataclasses import fields
from itertools import pairwise

import numpy as np
import pytest

from dscp_core.errors import InvalidInputError
from dscp_core.planning.plan import PlanStatus
from dscp_core.planning.planner import PlannerSettings, TerminalTime
from dscp_core.problems.powered_descent.simulation import (
    DescentRecord,
    Dispersions,
    NoFirstPlanError,
    SimulationOptions,
    simulate_descent,
)

GRAVITY_M_S2 = 9.80655
SPECIFIC_IMPULSE_S = 282.0
THRUST_MIN_N, THRUST_MAX_N = 169.0e3, 845.2e3
# Optimum of the paper's case, 50 intervals.
OPTIMAL_TIME_S, OPTIMAL_MASS_KG = 32.8103, 31760.298

SETTINGS = PlannerSettings(terminal_time=TerminalTime.FREE)
NONE = Dispersions(**{field.name: 0.0 for field in fields(Dispersions)})


@pytest.fixture(scope="module")
def dispersed() -> DescentRecord:
    return simulate_descent(SETTINGS, seed=1)


@pytest.fixture(scope="module")
def undispersed() -> DescentRecord:
    options = SimulationOptions(thrust_reserve=0.0)
    return simulate_descent(SETTINGS, seed=0, dispersions=NONE, options=options)


def test_without_dispersions_the_flight_is_the_optimum(undispersed: DescentRecord) -> None:
    # Commands are averaged over ticks of 0.1 s, in which the plan switches between its bounds.
    assert undispersed.times_s[-1] == pytest.approx(OPTIMAL_TIME_S, abs=0.05)
    # One tick of full thrust burns 30 kg; the switches cost and gain a part of that.
    assert undispersed.states[-1, 6] == pytest.approx(OPTIMAL_MASS_KG, abs=10.0)
    # The plan's own miss by its discretisation is 0.13 m, replanning shrinks it.
    assert undispersed.miss_position_m < 0.15
    # A tick of 0.1 s at 20 m/s^2 at the end, as the last plan may end within a tick.
    assert undispersed.miss_speed_m_s < 0.5
    assert np.array_equal(undispersed.states, undispersed.measured)


def test_a_dispersed_flight_lands_and_every_row_has_its_time(dispersed: DescentRecord) -> None:
    rows = len(dispersed.times_s)
    assert dispersed.states.shape == dispersed.measured.shape == (rows, 7)
    assert dispersed.commanded.shape == dispersed.thrusts.shape == (rows, 3)
    assert np.allclose(np.diff(dispersed.times_s)[:-1], 0.1, rtol=0.0, atol=1e-12)
    assert 0.0 < dispersed.times_s[-1] - dispersed.times_s[-2] <= 0.1 + 1e-12
    # What navigation noise of 0.2 m and 0.02 m/s leaves of a burn at 20 m/s^2 (seed 1).
    assert dispersed.miss_position_m < 2.0
    assert dispersed.miss_speed_m_s < 5.0
    assert dispersed.miss_position_m == pytest.approx(
        float(np.linalg.norm(dispersed.states[-1, :3]))
    )


def test_every_tick_obeys_the_rocket_equation(dispersed: DescentRecord) -> None:
    """Independent physics: at constant thrust both integrals have a closed form."""
    impulse_s = SPECIFIC_IMPULSE_S * (1.0 + dispersed.errors.specific_impulse)
    exhaust_m_s = impulse_s * GRAVITY_M_S2
    for now, after, thrust, step_s in zip(
        dispersed.states,
        dispersed.states[1:],
        dispersed.thrusts,
        np.diff(dispersed.times_s),
        strict=False,
    ):
        size = np.linalg.norm(thrust)
        assert now[6] - after[6] == pytest.approx(size * step_s / exhaust_m_s, rel=1e-9)
        gained = exhaust_m_s * math.log(now[6] / after[6]) * thrust / size
        expected = now[3:6] + gained + np.array([-GRAVITY_M_S2, 0.0, 0.0]) * step_s
        # The integrator's tolerance is 1e-6 m/s a tick.
        assert np.allclose(after[3:6], expected, rtol=0.0, atol=5e-6)


def test_the_engine_keeps_its_bounds_and_shows_its_errors(dispersed: DescentRecord) -> None:
    sizes = np.linalg.norm(dispersed.thrusts, axis=1)
    assert sizes.min() >= THRUST_MIN_N * (1.0 - 1e-12)
    assert sizes.max() <= THRUST_MAX_N * (1.0 + 1e-12)
    asked = np.linalg.norm(dispersed.commanded, axis=1)
    free = (sizes > 1.001 * THRUST_MIN_N) & (sizes < 0.999 * THRUST_MAX_N)
    assert free.any()
    assert np.allclose(sizes[free] / asked[free], 1.0 + dispersed.errors.thrust, rtol=1e-12)
    cosines = np.sum(dispersed.thrusts * dispersed.commanded, axis=1) / (sizes * asked)
    angles = np.arccos(np.minimum(cosines, 1.0))
    tilt = float(np.linalg.norm(dispersed.errors.thrust_direction_rad))
    # Equal where the thrust is at right angles to both axes, less where it leans (up to 30 deg).
    assert angles.max() <= tilt * (1.0 + 1e-3)
    assert angles.min() >= tilt * math.cos(math.radians(31.0))


def test_navigation_noise_has_its_size(dispersed: DescentRecord) -> None:
    noise = dispersed.measured - dispersed.states
    expected = Dispersions()
    # 330 rows of three axes: the sample deviation is within 10 % of the true one at 4 sigma.
    for part, size in (
        (noise[:, 0:3], expected.navigation_position_m),
        (noise[:, 3:6], expected.navigation_velocity_m_s),
    ):
        assert float(np.std(part)) == pytest.approx(size, rel=0.1)
    assert float(np.std(noise[:, 6] / dispersed.states[:, 6])) == pytest.approx(
        expected.navigation_mass, rel=0.2
    )


def test_the_reserve_of_thrust_is_given_back(dispersed: DescentRecord) -> None:
    limits = [replan.thrust_max_n for replan in dispersed.replans]
    assert limits[0] == pytest.approx(0.85 * THRUST_MAX_N)
    assert all(later > earlier for earlier, later in pairwise(limits))
    assert limits[-1] < THRUST_MAX_N
    assert [replan.tick for replan in dispersed.replans] == list(
        range(0, 10 * len(dispersed.replans), 10)
    )


def test_the_seed_decides_everything(dispersed: DescentRecord) -> None:
    again = simulate_descent(SETTINGS, seed=1)
    for name in ("times_s", "states", "measured", "commanded", "thrusts"):
        assert np.array_equal(getattr(again, name), getattr(dispersed, name)), name
    options = SimulationOptions(replan_ticks=1000)
    other = simulate_descent(SETTINGS, seed=2, options=options)
    assert not np.array_equal(other.states[0], dispersed.states[0])


def test_a_replan_that_fails_is_flown_through() -> None:
    """Without a reserve, a weak engine leaves no plan; the last one is flown to its end."""
    options = SimulationOptions(thrust_reserve=0.0, replan_ticks=20)
    record = simulate_descent(
        SETTINGS, seed=4, dispersions=Dispersions(thrust=0.01), options=options
    )
    assert record.errors.thrust < -0.005
    failed = [r for r in record.replans if r.outcome.status is not PlanStatus.CERTIFIED]
    assert failed
    assert record.times_s[-1] > 30.0
    assert np.all(np.isfinite(record.states))


def test_a_start_without_a_plan_is_an_error() -> None:
    settings = PlannerSettings(
        terminal_time=TerminalTime.FREE,
        parameters={
            "initial_position": (1500.0, 0.0, 0.0),
            "initial_velocity": (-200.0, 0.0, 0.0),
        },
    )
    with pytest.raises(NoFirstPlanError, match="INFEASIBLE"):
        simulate_descent(settings, seed=0)


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"tick_s": 0.0}, "tick_s"),
        ({"tick_s": math.nan}, "tick_s"),
        ({"replan_ticks": 0}, "replan_ticks"),
        ({"last_replan_s": -1.0}, "last_replan_s"),
        ({"thrust_reserve": 1.0}, "thrust_reserve"),
    ],
)
def test_bad_options_are_named(options: dict[str, float], field: str) -> None:
    with pytest.raises(InvalidInputError) as caught:
        SimulationOptions(**options)  # type: ignore[arg-type]
    assert caught.value.field == field


@pytest.mark.parametrize("value", [-0.1, math.nan, math.inf])
def test_bad_dispersions_are_named(value: float) -> None:
    with pytest.raises(InvalidInputError) as caught:
        Dispersions(thrust=value)
    assert caught.value.field == "thrust"

"""Intervals that are propagated: what they lead to, their derivatives, plans that fly exactly."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from oracles import entry_physics
from oracles.powered_descent_physics import DescentParameters, state_rate
from scipy.integrate import solve_ivp

from dscp_core import ControlHold, Discretisation, Planner, problems
from dscp_core.cone.program import ConeValues
from dscp_core.transcription.transcription import Transcription

Array = NDArray[np.float64]

CASES = [
    (name, hold, free)
    for name in ("powered_descent", "entry")
    for hold in ControlHold
    for free in (False, True)
]


class Case:
    """A propagated transcription at a random trajectory."""

    def __init__(self, name: str, hold: ControlHold, free: bool, intervals: int = 4) -> None:
        self.problem = problems.get(name)
        self.hold = hold
        self.transcription = Transcription(
            self.problem,
            intervals,
            free_terminal_time=free,
            discretisation=Discretisation.PROPAGATED,
            hold=hold,
        )
        random = np.random.default_rng(3)
        changes: dict[str, Any] = {"terminal_time": 8.0 if name == "powered_descent" else 100.0}
        self.parameters = self.problem.table.pack(changes)
        guess = self.transcription.initial_guess(self.parameters)
        self.reference = guess + 0.01 * random.standard_normal(guess.size)
        self.random = random


@pytest.fixture(scope="module", params=CASES, ids=lambda c: f"{c[0]}-{c[1].value}-{c[2]}")
def case(request: pytest.FixtureRequest) -> Case:
    return Case(*request.param)


def rates(name: str, state: Array, control: Array, parameters: dict[str, Any]) -> Array:
    if name == "powered_descent":
        return state_rate(state, control, DescentParameters())
    return np.concatenate([entry_physics.rates(state, parameters), control])


def test_the_defect_is_the_distance_from_an_independent_propagation(case: Case) -> None:
    layout, name = case.transcription.layout, case.problem.name
    states, controls = layout.states(case.reference), layout.controls(case.reference)
    step = case.transcription.terminal_time(case.reference, case.parameters) / layout.intervals
    named = case.problem.table.unpack(case.parameters)
    found = case.transcription.evaluate(case.reference, case.parameters).defects
    for n in range(layout.intervals):
        before, after = controls[n], controls[n + 1]

        def right_hand_side(t: float, x: Array, u: Array = before, w: Array = after) -> Array:
            share = 0.5 if case.hold is ControlHold.MEAN else t / step
            return rates(name, x, u + share * (w - u), named)

        flown = solve_ivp(
            right_hand_side, (0.0, step), states[n], method="DOP853", rtol=1e-12, atol=1e-9
        ).y[:, -1]
        # Four Runge-Kutta steps in an entry interval of 25 s are off by a few 1e-7 of the scales.
        expected = (states[n + 1] - flown) / layout.state_scale
        np.testing.assert_allclose(found[n] / layout.state_scale, expected, rtol=0.0, atol=5e-7)


def test_pullback_is_the_difference_of_the_values(case: Case) -> None:
    transcription, size = case.transcription, case.reference.size
    pattern = transcription.pattern
    flat = transcription.values(case.reference, case.parameters).to_flat()
    seed = case.random.standard_normal(flat.size)
    pulled = np.concatenate(
        transcription.values_pullback(
            case.reference, case.parameters, ConeValues.from_flat(pattern, seed)
        )
    )
    direction = case.random.standard_normal(pulled.size)
    direction[size:] *= np.where(np.isinf(case.parameters), 0.0, np.abs(case.parameters))
    both = np.concatenate([case.reference, case.parameters])

    def value(at: Array) -> float:
        return float(seed @ transcription.values(at[:size], at[size:]).to_flat())

    def difference(step: float) -> float:
        return (value(both + step * direction) - value(both - step * direction)) / (2 * step)

    expected = (4 * difference(5e-5) - difference(1e-4)) / 3
    assert pulled @ direction == pytest.approx(expected, rel=1e-6)
    pushed = transcription.values_pushforward(
        case.reference, case.parameters, direction[:size], direction[size:]
    ).to_flat()
    assert seed @ pushed == pytest.approx(pulled @ direction, rel=1e-9)


MARS = {
    "gravity": 3.7114,
    "standard_gravity": 9.807,
    "initial_position": (1500.0, 2000.0, 0.0),
    "initial_velocity": (-75.0, 100.0, 0.0),
    "initial_mass": 1905.0,
    "thrust_min": 4971.8,
    "thrust_max": 13258.2,
    "specific_impulse": 200.48,
    "pointing_angle_max": 1.55,
    "contact_tilt_max": 1.55,
    "glideslope_angle_max": math.radians(86.0),
    "terminal_time": 75.0,
}
MOON = {
    "gravity": 1.62,
    "initial_position": (15000.0, 520e3, 0.0),
    "initial_velocity": (0.0, -1690.0, 0.0),
    "initial_mass": 15000.0,
    "thrust_min": 4560.0,
    "thrust_max": 45040.0,
    "specific_impulse": 311.0,
    "pointing_angle_max": 1.55,
    "contact_tilt_max": 1.55,
    "glideslope_angle_max": 1.56,
    "terminal_time": 450.0,
    "terminal_time_max": 600.0,
}
HEAVY = {
    "initial_mass": 1e6,
    "thrust_min": 4.0e6,
    "thrust_max": 22.0e6,
    "initial_position": (5000.0, 500.0, 500.0),
}
HOP = {
    "initial_mass": 100.0,
    "thrust_min": 400.0,
    "thrust_max": 1500.0,
    "specific_impulse": 180.0,
    "initial_position": (100.0, 10.0, -5.0),
    "initial_velocity": (-10.0, 1.0, 0.0),
    "pointing_angle_max": 0.35,
    "terminal_time": 10.0,
}


@pytest.mark.parametrize("hold", ControlHold)
@pytest.mark.parametrize(
    "vehicle", [{}, MARS, MOON, HEAVY, HOP], ids=["paper", "mars", "moon", "heavy", "hop"]
)
def test_a_plan_flies_as_planned(vehicle: dict[str, Any], hold: ControlHold) -> None:
    """At N = 50 below 1 cm and 1 cm/s, by an integrator and physics of the test's own."""
    lighter = {"dry_mass": 0.0} if "dry_mass" in problems.get("powered_descent").table.names else {}
    planner = Planner(
        problems.get("powered_descent"),
        parameters={**lighter, **vehicle},
        terminal_time="free",
        hold=hold,
    )
    plan = planner.plan().plan
    assert plan is not None
    named = {**planner.problem.table.unpack(planner.parameters)}
    physics = DescentParameters(
        specific_impulse_s=named["specific_impulse"],
        gravity_m_s2=named["gravity"],
        mass_flow_gravity_m_s2=named["standard_gravity"],
    )
    state = plan.states[0]
    for n in range(50):
        start, end = plan.times_s[n], plan.times_s[n + 1]

        def right_hand_side(t: float, x: Array, n: int = n) -> Array:
            if hold is ControlHold.MEAN:
                thrust = (plan.controls[n] + plan.controls[n + 1]) / 2
            else:
                thrust = np.array(
                    [np.interp(t, plan.times_s[n : n + 2], u) for u in plan.controls[n : n + 2].T]
                )
            return state_rate(x, thrust, physics)

        state = solve_ivp(
            right_hand_side, (start, end), state, method="DOP853", rtol=1e-11, atol=1e-8
        ).y[:, -1]
    missed = state - plan.states[-1]
    assert np.linalg.norm(missed[:3]) < 1e-2
    assert np.linalg.norm(missed[3:6]) < 1e-2
    # What the last millimetres are worth: a contact within 5 cm/s of the target.
    assert abs(missed[0]) < 1e-4
    assert abs(missed[6]) < 1e-6 * plan.states[0, 6]


def test_the_midpoint_rule_is_still_there() -> None:
    planner = Planner(problems.get("powered_descent"), discretisation="midpoint")
    outcome = planner.plan()
    # IPOPT on the midpoint rule finds 31760.299756 kg at 32.81 s.
    assert outcome.cost == pytest.approx(-31760.299756, rel=1e-7)
    assert outcome.max_defect > 1e-12  # as the iterations left it

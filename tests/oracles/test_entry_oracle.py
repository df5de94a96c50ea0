"""Entry against an independent derivation of its dynamics, and against IPOPT."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from dscp_core import problems
from dscp_core.problems.entry import physics
from dscp_core.scp.scp import Scp, ScpOptions, ScpStatus
from dscp_core.transcription.transcription import Transcription

from . import entry_nlp, entry_physics

PROBLEM = problems.get("entry")
VALUES = PROBLEM.table.unpack(PROBLEM.pack())
GUESSED_TIME_S = 2500.0
PARAMETERS = {name: ca.SX(ca.DM(value)) for name, value in VALUES.items()}


def numeric(expression: ca.SX) -> entry_physics.Array:
    return np.asarray(ca.evalf(expression)).ravel()


def random_state(rng: np.random.Generator) -> entry_physics.Array:
    low = [6401e3, -2.0, -1.0, 1500.0, -0.3, -3.0, 0.0, -1.0]
    high = [6449e3, 2.0, 1.0, 6900.0, 0.3, 3.0, 0.7, 1.0]
    return rng.uniform(low, high)


@pytest.mark.parametrize("seed", range(4))
def test_dynamics_are_those_of_a_rotating_cartesian_frame(seed: int) -> None:
    state = random_state(np.random.default_rng(seed))
    control = np.array([0.01, -0.02])
    rates = numeric(PROBLEM.dynamics(ca.SX(state), ca.SX(control), PARAMETERS))
    expected = entry_physics.rates(state, VALUES)
    # Differences over 2 ms: their rounding is 1e-16 of the value over the step.
    rounding = 1e-15 * np.maximum(np.abs(state[:6]), 1.0) / 1e-3
    assert np.all(np.abs(rates[:6] - expected) <= 10 * rounding + 1e-6 * np.abs(expected))
    assert rates[6:] == pytest.approx(control, rel=1e-15)


@pytest.mark.parametrize("seed", range(3))
def test_limited_quantities(seed: int) -> None:
    state = random_state(np.random.default_rng(10 + seed))
    for name, value in entry_physics.limits(state, VALUES).items():
        found = numeric(getattr(physics, name)(ca.SX(state), PARAMETERS))
        assert found == pytest.approx([value], rel=1e-12)


@pytest.mark.parametrize("ratio", [1.0, 0.8])
def test_optimum_is_ipopts(ratio: float) -> None:
    transcription = Transcription(PROBLEM, 100)
    scp = Scp(transcription, ScpOptions(max_iterations=30, cost_tolerance=1e-9))
    parameters = PROBLEM.pack({"surface_to_mass_ratio": ratio})
    result = scp.run(parameters)
    assert result.status is ScpStatus.CONVERGED, result.message
    layout, found = transcription.layout, result.final_reference
    states, controls = layout.states(found), layout.controls(found)
    values = PROBLEM.table.unpack(parameters)
    start = transcription.initial_guess(parameters)  # IPOPT finds its own way
    optimum = entry_nlp.solve(
        PROBLEM, values, layout.states(start), layout.controls(start), GUESSED_TIME_S
    )
    assert optimum.message == "Solve_Succeeded"
    assert result.iterations[-1].cost == pytest.approx(optimum.cost, rel=1e-5)
    assert float(found[0]) * layout.time_scale == pytest.approx(optimum.terminal_time_s, abs=0.1)
    for name in ("dynamic_pressure", "heat_rate", "load_factor"):
        ours, theirs = (
            np.array([entry_physics.limits(x, values)[name] for x in nodes]) / values[f"{name}_max"]
            for nodes in (states, optimum.states)
        )
        # Where the cost has settled to 1e-9 the trajectory has to 1e-5.
        assert ours == pytest.approx(theirs, abs=3e-5)
        assert ours[1:].max() <= 1.0 + 1e-8
        on_limit = np.flatnonzero(ours > 1.0 - 1e-5)
        assert np.array_equal(on_limit, np.flatnonzero(theirs > 1.0 - 1e-5))
        if ratio == 1.0:  # as the prototype found
            expected = {"dynamic_pressure": [85], "heat_rate": [*range(66, 73)], "load_factor": []}
            assert on_limit.tolist() == expected[name]
    assert np.abs(states - optimum.states)[:, 6:].max() < 1e-3  # rad
    assert np.abs(controls - optimum.controls).max() < 1e-5  # rad/s

"""What a plan is said to cost above a local optimum, against what the optimum costs.

Every iterate of a run is judged as if the run had stopped there; the same run, going on until it
stands still, gives the optimum. The figures of many more: ``python -m benchmarks cost_to_gain``.
"""

from __future__ import annotations

import numpy as np
import pytest
from core.toy_problems import cart
from numpy.typing import NDArray

from dscp_core import Planner, PlanStatus, ScpOptions, problems
from dscp_core.problem.declaration import OptimalControlProblem
from dscp_core.scp.gain import cost_to_gain
from dscp_core.scp.trace import ScpStatus

Array = NDArray[np.float64]

DESCENT = problems.get("powered_descent")
TO_THE_END = 120

# A public Earth landing example: three engines that throttle to 40 %, nearly at the least thrust.
THREE_ENGINES = {
    "initial_position": [2400.0, 20.0, 50.0],
    "initial_velocity": [-80.0, 3.0, 1.0],
    "initial_mass": 35600.0,
    "thrust_min": 1014000.0,
    "thrust_max": 2535000.0,
    "pointing_angle_max": 1.55,
    "glideslope_angle_max": 1.5533430342749532,
    "terminal_time": 20.0,
}
# A first stage of 1000 t.
BOOSTER = {
    "initial_position": [5000.0, 300.0, 200.0],
    "initial_velocity": [-200.0, 10.0, -10.0],
    "initial_mass": 1e6,
    "thrust_min": 5.28e6,
    "thrust_max": 28.6e6,
    "specific_impulse": 327.0,
    "pointing_angle_max": 0.349,
    "terminal_time": 30.0,
}


def truth_and_claim(planner: Planner, state: Array | None = None) -> tuple[Array, Array]:
    """What was really to gain after each iteration that leaves no virtual control; the claims."""
    packed = planner.check_state(planner.initial_state if state is None else state)
    scp = planner.scp.with_options(fixed_iterations=TO_THE_END)
    iterations = scp.run(packed).iterations
    assert len(iterations) == TO_THE_END
    claims = [cost_to_gain(scp, iteration) for iteration in iterations]
    best = min(iteration.cost for iteration in iterations[-10:])
    pairs = [(i.cost - best, c) for i, c in zip(iterations, claims, strict=True) if c is not None]
    gained, claimed = np.array(pairs).T
    return gained, claimed


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("weight", [0.0, 1e-3, 0.3, 10.0])
def test_random_states_and_weights(seed: int, weight: float) -> None:
    rng = np.random.default_rng(seed)
    planner = Planner(
        DESCENT,
        terminal_time="fixed" if weight else "free",
        parameters={"trust_region_control": [weight] * 3, "terminal_time": 40.0},
    )
    state = planner.initial_state * (1.0 + rng.uniform(-0.1, 0.1, 7))
    gained, claimed = truth_and_claim(planner, state)
    assert np.all(gained <= claimed)


@pytest.mark.parametrize("vehicle", [THREE_ENGINES, BOOSTER], ids=["three engines", "booster"])
def test_other_vehicles(vehicle: dict[str, float | list[float]]) -> None:
    planner = Planner(DESCENT, terminal_time="free", parameters=vehicle)
    gained, claimed = truth_and_claim(planner)
    assert np.all(gained <= claimed)


@pytest.mark.parametrize("problem", [problems.get("entry"), cart()], ids=["entry", "cart"])
def test_other_problems(problem: OptimalControlProblem) -> None:
    gained, claimed = truth_and_claim(Planner(problem, intervals=40))
    assert np.all(gained <= claimed)


def test_a_run_cut_short_tells_what_it_left() -> None:
    limit = 35
    options = ScpOptions(max_iterations=limit)
    planner = Planner(DESCENT, terminal_time="free", parameters=THREE_ENGINES, options=options)
    outcome = planner.plan()
    assert (outcome.status, outcome.stopped) == (
        PlanStatus.CERTIFIED,
        ScpStatus.ITERATION_LIMIT,
    )
    gained, _ = truth_and_claim(planner)
    assert outcome.cost_to_gain is not None
    gap = gained[limit - 1]
    assert 5.0 < gap <= outcome.cost_to_gain < 20.0 * gap


def test_steps_that_are_made_short_cannot_make_it_small() -> None:
    # They end as converged, 0.1 % of the fuel above the optimum.
    planner = Planner(
        DESCENT,
        parameters={"trust_region_control": [100.0] * 3, "terminal_time": 34.0},
        options=ScpOptions(cost_tolerance=1e-3),
    )
    short = planner.plan()
    best = Planner(DESCENT, parameters={"terminal_time": 34.0}).plan()
    assert short.stopped is ScpStatus.CONVERGED
    assert short.cost_to_gain is not None
    assert 10.0 < short.cost - best.cost <= short.cost_to_gain


def test_a_converged_plan_has_next_to_nothing_to_gain() -> None:
    outcome = Planner(DESCENT).plan()
    assert outcome.converged
    assert outcome.cost_to_gain is not None
    assert 0.0 < outcome.cost_to_gain < 1e-4 * abs(outcome.cost)

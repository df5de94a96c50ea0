"""Gradients of the tuning's objective against central differences of the whole of it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from core import tuning_support as support
from core.whole_runs import difference

from dscp_core import problems
from dscp_core.planning.certificate import PlanVerifier
from dscp_core.planning.planner import PlannerSettings, TerminalTime
from dscp_core.problem.declaration import TERMINAL_TIME, OptimalControlProblem
from dscp_core.problem.flight import ControlHold, Discretisation
from dscp_core.scp.scp import Scp, ScpOptions
from dscp_core.transcription.transcription import Transcription
from dscp_core.tuning.choice import cost_is_minus_mass
from dscp_core.tuning.errors import TuningError
from dscp_core.tuning.rollout import MissLoss
from dscp_core.tuning.samples import StateSet

USER = """
import torch

def loss(states, controls, terminal_time_s):
    lateral = torch.mean(states[:, 1:3] ** 2)
    thrust = torch.mean(torch.linalg.vector_norm(controls, dim=1))
    return 1e-4 * lateral + 1e-5 * thrust + 0.1 * terminal_time_s ** 2
"""

FREE = PlannerSettings(intervals=12, terminal_time=TerminalTime.FREE)
FIXED = support.planner(intervals=12)
# A weight that leaves a virtual control to be seen; a formulation that needs a trust region.
SOFT = support.planner(intervals=12, parameters={"virtual_control_weight": 100.0})
PRINTED = problems.get("powered_descent", "printed")

ENTRY = PlannerSettings(intervals=60, terminal_time=TerminalTime.FREE)


@dataclass(frozen=True)
class Case:
    """What is tuned for what, along which step of the coordinates, and how good it must be.

    Differences of runs with K iterations carry the rounding of the polished solutions, about 1e-12
    of the loss, over the step; and a remainder of fourth order in it. Which dominates differs:
    weights change the loss by little, so that their tolerance is wider.
    """

    tuned: str
    loss: str
    planner: PlannerSettings
    iterations: int | None
    step: float
    tolerance: float
    problem: OptimalControlProblem = field(default_factory=lambda: problems.get("powered_descent"))


# Propagated plans miss by rounding, which has no derivative.
MISSING = replace(FIXED, discretisation=Discretisation.MIDPOINT)

CASES = {
    "parameter fuel": Case("thrust_max=7e5:9e5", "fuel", FIXED, 6, 1e-3, 1e-6),
    "parameter cost free time": Case("thrust_max=7e5:9e5", "cost", FREE, 6, 1e-4, 1e-5),
    "parameters miss": Case("specific_impulse=250:300", "miss", MISSING, 6, 1e-3, 1e-6),
    "time miss linear": Case(
        "terminal_time=34:38",
        "miss",
        replace(MISSING, hold=ControlHold.LINEAR),
        6,
        1e-3,
        1e-6,
    ),
    "parameter user": Case("gravity=9:11", "user", FREE, 6, 1e-4, 1e-5),
    "time user": Case("terminal_time=34:38", "user", FIXED, 6, 1e-4, 1e-5),
    "weights convergence": Case(
        "trust_region_control", "convergence", FIXED, 4, 1e-3, 1e-5, PRINTED
    ),
    "state weight convergence": Case(
        "trust_region_state.vy@1", "convergence", FIXED, 4, 1e-2, 1e-4, PRINTED
    ),
    "weight iterations": Case(
        "trust_region_control.thrust_y", "iterations", FIXED, 5, 1e-3, 1e-5, PRINTED
    ),
    "step weight cost": Case("trust_region_step@10", "cost", FREE, 3, 1e-3, 1e-4),
    "virtual weight convergence": Case(
        "virtual_control_weight", "convergence", SOFT, 3, 1e-2, 1e-4
    ),
    "logarithmic parameter": Case(
        "thrust_prox=1e-9:1e-3@1e-5", "convergence", FIXED, 4, 1e-3, 1e-4
    ),
}
# Path constraints become active node by node: the step has to be small for no kink to be crossed.
ENTRY_CASES = {
    "entry parameter cost": Case(
        "surface_to_mass_ratio=0.75:1.25", "cost", ENTRY, 5, 1e-4, 1e-4, problems.get("entry")
    ),
    "entry parameter miss": Case(
        "surface_to_mass_ratio=0.75:1.25", "miss", ENTRY, 5, 1e-4, 1e-4, problems.get("entry")
    ),
    "entry weights convergence": Case(
        "trust_region_state.flight_path_angle,trust_region_control",
        "convergence",
        ENTRY,
        4,
        1e-4,
        1e-4,
        problems.get("entry", "printed"),
    ),
}


def states_of(case: Case) -> StateSet:
    if case.problem.name == "entry":
        problem = problems.get("entry")
        packed = problem.pack()
        names = problem.initial_state_parameters
        return support.state_set(
            np.concatenate([packed[problem.table.slice(name)] for name in names])[None, :]
        )
    printed = case.problem.formulation == "printed"
    return support.state_set(support.PRINTED_STATES if printed else support.STATES[:2])


@pytest.mark.parametrize("name", [*CASES, *ENTRY_CASES])
def test_every_kind_of_quantity_and_loss(name: str, tmp_path: Path) -> None:
    case = {**CASES, **ENTRY_CASES}[name]
    loss = case.loss
    if loss == "user":
        (tmp_path / "own.py").write_text(USER, encoding="utf-8")
        loss = f"{tmp_path / 'own.py'}:loss"
    objective = support.objective(
        case.tuned,
        loss,
        case.planner,
        fixed_iterations=case.iterations,
        problem=case.problem,
    )
    states = states_of(case)
    start = objective.space.start()
    found = objective.evaluate(start, states)
    assert (found.used, found.untrusted) == (len(states), 0), found.message
    direction = np.ones(start.size)
    along = float(found.gradient @ direction)

    def value(size: float) -> float:
        return objective.evaluate(start + size * direction, states).loss

    assert abs(along) > 1e-9
    assert along == pytest.approx(difference(value, case.step), rel=case.tolerance)


TIGHT = ScpOptions(cost_tolerance=1e-9, max_iterations=60)


@pytest.mark.parametrize(
    ("tuned", "loss", "planner"),
    [
        ("specific_impulse=250:300", "fuel", FIXED),
        ("terminal_time=34:38", "cost", FIXED),
        ("fuel_weight=0.5:2", "cost", FREE),
        ("surface_to_mass_ratio=0.75:1.25", "cost", ENTRY),
        ("rate_weight=0.5:2", "fuel", ENTRY),
    ],
    ids=lambda value: value if isinstance(value, str) else f"{value.intervals}",
)
def test_envelope(tuned: str, loss: str, planner: PlannerSettings) -> None:
    """Derivative of the optimum from multipliers alone, against differences of converged runs."""
    problem = problems.get("entry" if planner is ENTRY else "powered_descent")
    case = Case(tuned, loss, replace(planner, options=TIGHT), None, 0.0, 0.0, problem)
    objective = support.objective(tuned, loss, case.planner, envelope=True, problem=problem)
    states = states_of(case).part(np.array([0]))
    start = objective.space.start()
    found = objective.evaluate(start, states)
    assert found.used == len(states), found.message
    step = np.array([1e-3])

    def value(size: float) -> float:
        return objective.evaluate(start + size * step, states).loss

    # Runs end within 1e-9 of the optimal cost, which leaves 1e-3 of its difference.
    assert float(found.gradient @ step) == pytest.approx(difference(value, 1.0), rel=1e-3)


def test_where_fuel_is_the_cost() -> None:
    problem = problems.get("powered_descent")
    weight = problem.table.slice("fuel_weight").start
    assert cost_is_minus_mass(problem, problem.pack(), [])
    assert not cost_is_minus_mass(problem, problem.pack(), [weight])
    assert not cost_is_minus_mass(problem, problem.pack({"time_weight": 1.0}), [])
    assert not cost_is_minus_mass(problems.get("entry"), problems.get("entry").pack(), [])


def test_network_weights() -> None:
    predicted = PlannerSettings(intervals=12, terminal_time=TerminalTime.PREDICTED)
    objective = support.objective(
        "network", "fuel", predicted, fixed_iterations=6, predictor=support.untrained()
    )
    states = support.state_set()
    found = objective.evaluate(np.zeros(0), states)
    assert (found.used, found.untrusted) == (3, 0), found.message
    network = objective.network
    assert network is not None
    start = network.tensors()
    rng = np.random.default_rng(3)
    direction = {name: rng.standard_normal(tensor.shape) for name, tensor in start.items()}
    along = sum(float(np.sum(found.network[n].numpy() * d)) for n, d in direction.items())

    def value(size: float) -> float:
        network.set_tensors({n: start[n] + size * d for n, d in direction.items()})
        return objective.evaluate(np.zeros(0), states).loss

    # A step of 1e-5 in 8000 weights moves the times by 1e-3 s; the loss is rounded to 1e-8 kg.
    assert along == pytest.approx(difference(value, 1e-5), rel=1e-4)


def test_infeasible_time_moves_the_network_and_nothing_else() -> None:
    predicted = PlannerSettings(intervals=12, terminal_time=TerminalTime.PREDICTED)
    objective = support.objective(
        "network,thrust_max=7e5:9e5", "fuel", predicted, predictor=support.untrained()
    )
    network = objective.network
    assert network is not None
    with torch.no_grad():
        bias = dict(network.named_parameters())["layers.3.bias"]
        low, high = network.interval_s
        bias -= 30.0  # predictions at the lower end, 30 s: too short for every state
    assert network.predict(support.STATES).max() < low + 1e-3 * (high - low)
    found = objective.evaluate(objective.space.start(), support.state_set())
    assert found.failures == 3
    assert not found.gradient.any()
    # Minus the gradient leads to longer times.
    assert float(found.network["layers.3.bias"][0]) < 0.0


def test_failed_states_cost_the_penalty() -> None:
    objective = support.objective("thrust_max=7e5:9e5", "fuel", FIXED)
    times = [support.TIME_S, support.SHORT_TIME_S]
    states = support.state_set(support.STATES[:2], times)
    start = objective.space.start()
    out = objective.evaluate(start, states)
    penalised = objective.evaluate(start, states, penalised=True, penalty=5.0)
    assert out.loss < objective.evaluate(start, states, penalised=True).penalty
    assert (out.used, out.failures) == (1, 1)
    assert "virtual control" in out.message
    assert penalised.loss == pytest.approx(0.5 * (out.loss + 5.0))
    np.testing.assert_allclose(penalised.gradient, 0.5 * out.gradient, rtol=1e-12)


@pytest.mark.parametrize("hold", list(ControlHold))
@pytest.mark.parametrize(("name", "time_s"), [("powered_descent", 33.0), ("entry", 2500.0)])
def test_miss_agrees_with_an_independent_integration(
    name: str, time_s: float, hold: ControlHold
) -> None:
    problem, intervals = problems.get(name), 60
    transcription = Transcription(problem, intervals, free_terminal_time=name == "entry")
    # To a gate above the ground: a certificate flies landings on to contact.
    gate = {"gate_height": 10.0} if name == "powered_descent" else {}
    trace = Scp(transcription).run(problem.pack({TERMINAL_TIME: time_s, **gate}))
    layout, final = transcription.layout, trace.final_reference
    certificate = PlanVerifier(problem, intervals, hold=hold).certify(
        np.linspace(0.0, transcription.terminal_time(final, trace.parameters), intervals + 1),
        layout.states(final),
        layout.controls(final),
        trace.parameters,
    )
    checks = [certificate.check(miss.name) for miss in problem.misses]
    missed = [check.worst_value / check.bound for check in checks]
    # Four Runge-Kutta steps per interval of 45 s are good to 0.1 m after a flight of 10 000 km.
    assert MissLoss(transcription, hold).value(transcription, trace) == pytest.approx(
        float(np.linalg.norm(missed)), rel=1e-3
    )


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("def loss(x, u, t):\n    return 3.0", "no scalar tensor"),
        ("def loss(x, u, t):\n    return x.sum().detach()", "does not depend"),
        ("def loss(x, u, t):\n    return x[99, 0]", "IndexError"),
    ],
)
def test_users_function_that_fails(source: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(source, encoding="utf-8")
    objective = support.objective(
        "thrust_max=7e5:9e5", f"{tmp_path / 'own.py'}:loss", FIXED, fixed_iterations=2
    )
    with pytest.raises(TuningError, match=message):
        objective.evaluate(objective.space.start(), support.state_set(support.STATES[:1]))


def test_users_function_that_is_not_finite_is_left_out(tmp_path: Path) -> None:
    source = "def loss(x, u, t):\n    return (0.0 * x[0, 0]) / 0.0"
    (tmp_path / "own.py").write_text(source, encoding="utf-8")
    objective = support.objective("thrust_max=7e5:9e5", f"{tmp_path / 'own.py'}:loss", FIXED)
    found = objective.evaluate(objective.space.start(), support.state_set(support.STATES[:1]))
    assert (found.used, found.untrusted, found.failures) == (0, 1, 0)
    assert np.isnan(found.loss)
    assert not found.gradient.any()

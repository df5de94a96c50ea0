"""Every example runs as a user runs it, and what it says is compared with independent truth."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import nbclient
import nbformat
import numpy as np
import pytest
from core.whole_runs import difference
from examples_support import EXAMPLES, ROOT, ExampleRun, check_figure, run_example
from oracles.declared_nlp import solve

from dscp_core import (
    OptimalControlProblem,
    Planner,
    PlannerSettings,
    PlanOutcome,
    ScpOptions,
    TerminalTime,
    problems,
)
from dscp_ros.parameter_set import load
from dscp_ros.planner.choice import ProblemChoice

NAMES = sorted(path.stem for path in EXAMPLES.glob("*.py"))
TESTED = {
    "batch_with_failures",
    "car_past_discs",
    "double_integrator",
    "gradient_in_torch",
    "own_log",
    "own_vehicle",
    "quadrotor_past_obstacle",
}


def declared(name: str) -> OptimalControlProblem:
    return problems.get(f"{EXAMPLES}/{name}")


def optimum(problem: OptimalControlProblem, **parameters: Any) -> float:
    """Cost of a whole plan, iterated until nothing changes any more."""
    settings = PlannerSettings.suited(
        problem, options=ScpOptions.for_gradients(fixed_iterations=60)
    )
    return Planner(problem, settings, parameters=parameters).plan().cost


def check_against_ipopt(problem: OptimalControlProblem, outcome: PlanOutcome) -> None:
    """IPOPT, which linearises nothing, finds no better trajectory around a plan."""
    plan = outcome.plan
    assert plan is not None
    found = solve(
        problem,
        outcome.parameters,
        plan.states,
        plan.controls,
        plan.terminal_time_s,
        free=problem.free_terminal_time,
        propagated=True,
    )
    assert found.message == "Solve_Succeeded"
    assert outcome.cost == pytest.approx(found.cost, rel=1e-6)
    assert plan.terminal_time_s == pytest.approx(found.terminal_time_s, rel=1e-4)
    scales = np.array([state.scale for state in problem.states])
    np.testing.assert_allclose(plan.states / scales, found.states / scales, atol=1e-3)


def check_differences(planner: Planner, steps: Mapping[str, float]) -> None:
    """Gradients of the cost are differences of whole plans."""
    gradient = planner.gradient("cost")
    assert gradient.trusted, gradient.reasons
    for name, step in steps.items():
        value = planner.problem.table[name].default
        assert isinstance(value, float)
        whole = difference(
            lambda change, n=name, v=value: optimum(planner.problem, **{n: v + change}), step
        )
        assert gradient[name] == pytest.approx(whole, rel=1e-5), name


def check_certified(run: ExampleRun) -> None:
    """Every check that is printed keeps its bound."""
    rows = [line.split() for line in run.printed.splitlines() if "<=" in line]
    assert rows
    for _, worst, _, bound, _ in rows:
        assert float(worst) <= float(bound)


def test_every_example_is_tested_and_short() -> None:
    assert set(NAMES) == TESTED
    for name in NAMES:
        assert len((EXAMPLES / f"{name}.py").read_text("utf-8").splitlines()) < 120, name


@pytest.mark.slow
def test_double_integrator(tmp_path: Path) -> None:
    run = run_example("double_integrator", tmp_path)
    errors = []
    for intervals in (10, 20, 40, 80, 160):
        cost, error = run.numbers(f"{intervals} ")
        # By hand: ramps of 5 s from 2.4 m/s^2 to 0, so twice 2.4^2 / 2 * 5 / 3.
        assert error == pytest.approx(abs(cost - 2 * 2.4**2 / 2 * 5 / 3), abs=2e-5)
        errors.append(error)
    falls = [coarse / fine for coarse, fine in itertools.pairwise(errors)]
    assert falls[-2:] == pytest.approx([4.0, 4.0], rel=0.02)
    # By hand: d/dV of 4/3 V^2 / (3/2 (T - D/V)) at V = 6 m/s.
    gradient, analytic = run.numbers("d cost / d speed_max")
    assert analytic == pytest.approx(8 * 6 / 15 - 8)
    assert gradient == pytest.approx(analytic, rel=5e-3)
    planner = Planner(declared("double_integrator.py:double_integrator"))
    check_differences(planner, {"speed_max": 1e-3, "distance": 1e-2})


@pytest.mark.slow
def test_car_past_discs(tmp_path: Path) -> None:
    run = run_example("car_past_discs", tmp_path)
    check_certified(run)
    planner = Planner(declared("car_past_discs.py:car"))
    outcome = planner.plan()
    assert outcome.headline in run.printed
    check_against_ipopt(planner.problem, outcome)
    check_differences(planner, {"grip": 1e-4, "margin": 1e-4, "comfort": 1e-5})
    assert outcome.certificate is not None
    from_discs = [
        np.hypot(*(outcome.certificate.states[:, :2] - (x, y)).T).min() - radius
        for x, y, radius in ((12.0, 1.0, 4.0), (25.0, 9.0, 5.0), (36.0, 2.0, 4.0))
    ]
    assert min(from_discs) > 0.0
    assert max(from_discs) < 0.5


@pytest.mark.slow
def test_quadrotor_past_obstacle(tmp_path: Path) -> None:
    run = run_example("quadrotor_past_obstacle", tmp_path)
    check_certified(run)
    planner = Planner(declared("quadrotor_past_obstacle.py:quadrotor"))
    outcome = planner.plan()
    assert outcome.headline in run.printed
    check_against_ipopt(planner.problem, outcome)
    check_differences(planner, {"mass": 1e-4, "terminal_time": 1e-4, "inertia": 1e-6})


@pytest.mark.slow
def test_own_vehicle(tmp_path: Path) -> None:
    run = run_example("own_vehicle", tmp_path)
    check_figure(run.output / "own_vehicle_sensitivities.png")
    assert run.printed.startswith("certified, converged")
    assert "trusted" in run.printed
    assert "NOT" not in run.printed
    descent = problems.get("powered_descent")
    settings = PlannerSettings.suited(
        descent,
        terminal_time=TerminalTime.FREE,
        options=ScpOptions.for_gradients(fixed_iterations=40),
    )
    vehicle = EXAMPLES / "data" / "lunar_lander.yaml"
    for name in ("initial_mass", "specific_impulse", "thrust_max", "pointing_angle_max"):
        value, per_percent = run.numbers(name)

        def mass(change: float, name: str = name, value: float = value) -> float:
            changed = {name: value * (1.0 + change)}
            return -Planner(descent, settings, vehicle=vehicle, parameters=changed).plan().cost

        assert per_percent == pytest.approx(difference(mass, 1e-4) / 100.0, rel=2e-3, abs=1e-4)


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_gradient_in_torch(tmp_path: Path) -> None:
    run = run_example("gradient_in_torch", tmp_path)
    beyond = [run.numbers(f"step {step:2}:")[0] for step in range(0, 31, 5)]
    # No plan burns less than one whose terminal time is free.
    assert min(beyond) > 0.0
    assert beyond[-1] < 0.2 * beyond[0]
    assert beyond[-1] < 1.0


@pytest.mark.slow
def test_batch_with_failures(tmp_path: Path) -> None:
    run = run_example("batch_with_failures", tmp_path)
    plans, trusted = run.numbers("30 states")
    failed = {int(x.split()[1].rstrip(":")): x for x in run.printed.splitlines() if "zero" in x}
    assert plans == 30 - len(failed)
    assert trusted <= plans
    assert "landing altitude" in failed[3]
    assert "finite" in failed[16]
    planner = Planner(
        problems.get("powered_descent"),
        PlannerSettings(intervals=20, parameters={"terminal_time": 34.0}),
    )
    for number in range(30):
        state = planner.initial_state
        state[:2] = 3000.0 + 625.0 * (number // 6), -1500.0 + 700.0 * (number % 6)
        if number not in (3, 16):
            assert planner.plan(state).certified == (number not in failed), number
    apart = run.numbers("planned without those that fail")
    assert max(apart) < 1e-9


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_own_log(tmp_path: Path) -> None:
    run = run_example("own_log", tmp_path)
    (before, _), (after, failures) = (run.numbers(when) for when in ("before", "after"))
    assert after < 0.5 * before
    assert failures == 0
    name = f"{EXAMPLES}/quadrotor_past_obstacle.py:quadrotor"
    found = load(run.output / "quadrotor_set", ProblemChoice.read(name))
    assert found.label in run.printed
    weights = found.values["parameters.trust_region_state"]
    # The last fifth of the log, planned with the set's weights by hand.
    states = np.loadtxt(EXAMPLES / "data" / "quadrotor_log.csv", delimiter=",", skiprows=1)[32:, 1:]
    options = ScpOptions(max_iterations=60, cost_tolerance=1e-6)
    for values, mean in (((0.01, 0.01, 1.0, 0.01, 0.01, 0.01), before), (weights, after)):
        planner = Planner(
            problems.get(name),
            PlannerSettings(options=options, parameters={"trust_region_state": values}),
        )
        outcomes = [planner.plan(state) for state in states]
        assert all(outcome.certified for outcome in outcomes)
        assert np.mean([outcome.iterations for outcome in outcomes]) == pytest.approx(
            mean, abs=0.01
        )


@pytest.mark.slow
def test_notebook(tmp_path: Path) -> None:
    path = EXAMPLES / "powered_descent.ipynb"
    notebook = nbformat.read(path, as_version=4)
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert not any(cell.outputs or cell.execution_count for cell in cells)  # stored without
    nbclient.NotebookClient(
        notebook, timeout=100, resources={"metadata": {"path": str(ROOT)}}
    ).execute()
    texts = ["".join(output.get("text", "") for output in cell.outputs) for cell in cells]
    assert texts[0].startswith("certified, converged")
    assert "image/png" in cells[2].outputs[0].data
    assert texts[3].splitlines()[0].endswith("trusted")
    named = dict(line.split() for line in texts[3].splitlines()[1:4])
    words = texts[4].replace(",", "").split()
    assert float(named["specific_impulse"]) == pytest.approx(float(words[1]), rel=1e-3)
    assert float(named["terminal_time"]) == pytest.approx(float(words[4]), rel=1e-3)
    masses = [
        [float(word) for word in line.partition("]")[2].strip(" []").split()]
        for line in texts[5].splitlines()
    ]
    assert np.all(np.diff(np.array(masses), axis=0) > 0.0)

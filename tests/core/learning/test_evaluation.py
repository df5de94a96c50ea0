"""Measuring a network against brute force."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from learning_support import network

from dscp_core import problems
from dscp_core.learning.evaluation import (
    Measurement,
    check_against_ipopt,
    infeasible_predictions,
    measure,
)
from dscp_core.learning.evaluator import OptimumEvaluator, OptimumModel
from dscp_core.learning.figures import profile_figure, training_figure, write_figure
from dscp_core.learning.labels import LabelError
from dscp_core.learning.sampling import PAPER_BOX, horizontal_profile
from dscp_core.workers.processes import SerialEngine

MODEL = OptimumModel(problems.get("powered_descent"), {"mean_thrust_fraction": 1.0}, intervals=20)
STATES = PAPER_BOX.uniform(5, np.random.default_rng(6))


@pytest.fixture(scope="module")
def evaluator() -> OptimumEvaluator:
    return MODEL()


@pytest.fixture
def engine(evaluator: OptimumEvaluator) -> SerialEngine:  # type: ignore[type-arg]
    return SerialEngine(lambda: evaluator)


@pytest.fixture(scope="module")
def truth(evaluator: OptimumEvaluator) -> Measurement:
    return measure(
        SerialEngine(lambda: evaluator),
        lambda states: np.full(len(states), 35.0),
        STATES,
        symmetric=True,
    )


def test_prediction_error_and_fuel(truth: Measurement, engine: SerialEngine) -> None:  # type: ignore[type-arg]
    late = measure(engine, lambda _: truth.true_s * 1.001, STATES, symmetric=False)
    # Solved in another order, and the solver keeps some state from state to state.
    np.testing.assert_allclose(late.true_s, truth.true_s, rtol=1e-7)
    np.testing.assert_allclose(late.relative_error, 1e-3, rtol=1e-3)
    assert np.all(late.fuel_lost_kg > 0.0)
    exact = measure(engine, lambda _: truth.true_s, STATES, symmetric=False)
    # Both runs stop when 1e-9 of the mass is left: 3e-5 kg, and a little more where they are slow.
    np.testing.assert_allclose(exact.fuel_lost_kg, 0.0, atol=5e-3)
    figures = late.document()
    assert figures["states"] == 5
    assert figures["max_relative_error"] == pytest.approx(1e-3, rel=1e-3)
    assert figures["infeasible"] == figures["unsolved"] == 0
    assert figures["max_fuel_lost_kg"] == pytest.approx(late.fuel_lost_kg.max())


def test_infeasible_predictions_are_counted(
    truth: Measurement,
    engine: SerialEngine,  # type: ignore[type-arg]
) -> None:
    times = truth.true_s.copy()
    times[1] = 29.0
    early = measure(engine, lambda _: times, STATES, symmetric=False)
    assert early.document()["infeasible"] == 1
    assert early.document()["infeasible_share"] == pytest.approx(0.2)
    assert np.isnan(early.fuel_lost_kg[1])
    refused = infeasible_predictions(
        engine,
        lambda states: np.where(np.all(states == STATES[1], axis=1), 29.0, 36.0),
        STATES,
    )
    np.testing.assert_array_equal(refused, STATES[1:2])


def test_states_without_any_optimum(engine: SerialEngine) -> None:  # type: ignore[type-arg]
    state = STATES[:1].copy()
    state[0, 3] = -900.0  # hits the ground in six seconds
    with pytest.raises(LabelError, match="none of 1 states"):
        measure(engine, network().evaluate, state, symmetric=False)


def test_symmetric_states_are_solved_once(engine: SerialEngine) -> None:  # type: ignore[type-arg]
    states = horizontal_profile(3)
    solved: list[int] = []
    net = network()
    found = measure(engine, net.evaluate, states, symmetric=True, progress=solved.append)
    assert sum(solved) == 2 * 3, "center, edges and corners, each twice"
    assert len(found.states) == 9
    np.testing.assert_array_equal(found.states, states)
    assert len(np.unique(found.true_s)) == 3
    np.testing.assert_array_equal(found.predicted_s, net.evaluate(states))


def test_optimum_is_that_of_ipopt(engine: SerialEngine) -> None:  # type: ignore[type-arg]
    check = check_against_ipopt(engine, MODEL, STATES[:3])
    assert (check.states, check.failed) == (3, 0)
    # Both ends: 1e-10 of the cost is 3e-6 of the time where the iterations are slow.
    assert check.max_relative_difference < 2e-5
    assert check.max_mass_difference_kg < 0.02


def test_figures_are_drawn(truth: Measurement, engine: SerialEngine, tmp_path: Path) -> None:  # type: ignore[type-arg]
    profile = measure(engine, network().evaluate, horizontal_profile(3), symmetric=True)
    figure = profile_figure(profile, (1, 2), ("y", "z"), "horizontal")
    assert len(figure.axes) == 4, "two panels and two color bars"
    errors = {f"validation_{name}": 1e-3 for name in ("mean", "p99", "max", "rms")}
    regression = [{"stage": "supervised", "elapsed_s": 1.0, "rms_s": 1e-2, **errors}]
    rounds = [
        {"stage": "refinement_fit", "elapsed_s": 2.0, "mean_abs_slope_kg_s": 3.0, **errors}
    ] * 2
    figure = training_figure([*regression, *rounds], "default")
    found = [line.get_xdata().tolist() for line in figure.axes[0].get_lines()]
    assert found == [[2.0, 3.0], [1.0]], "slopes of two rounds, misfit of the regression"
    path = tmp_path / "training.png"
    write_figure(figure, path)
    assert path.read_bytes().startswith(b"\x89PNG")
    stochastic = [
        {
            "stage": "stochastic",
            "epoch": epoch,
            "elapsed_s": float(epoch),
            "learning_rate": 0.01,
            "mean_abs_slope": 1.0 / epoch,
            **errors,
        }
        for epoch in (1, 2, 3)
    ]
    figure = training_figure(stochastic, "paper")
    gradient, _, rate = figure.axes
    np.testing.assert_allclose(gradient.get_lines()[0].get_ydata(), [1.0, 0.5, 1.0 / 3.0])
    np.testing.assert_allclose(rate.get_lines()[0].get_ydata(), 0.01)

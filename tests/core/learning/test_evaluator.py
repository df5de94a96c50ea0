"""What workers compute: optimal times, plans at given times, slopes."""

from __future__ import annotations

import numpy as np
import pytest
from oracles.powered_descent_nlp import NlpOptions, solve_free_time

from dscp_core import problems
from dscp_core.learning.evaluator import (
    BestTimeJob,
    GivenTimeJob,
    GradientMethod,
    OptimumEvaluator,
    OptimumModel,
)
from dscp_core.learning.labels import LabelError, best_times, given_times
from dscp_core.learning.sampling import PAPER_BOX
from dscp_core.scp.scp import ScpOptions
from dscp_core.workers.processes import SerialEngine

PAPER_STATE = np.array([[5000.0, 500.0, 500.0, -150.0, 30.0, -30.0, 38000.0]])
TIGHT = ScpOptions(cost_tolerance=1e-10, max_iterations=120)
PATIENT = ScpOptions(max_iterations=60)


@pytest.fixture(scope="module")
def evaluator() -> OptimumEvaluator:
    return OptimumModel(
        problems.get("powered_descent"), {"mean_thrust_fraction": 1.0}, intervals=15
    )()


def test_best_times_are_those_of_an_independent_solver(evaluator: OptimumEvaluator) -> None:
    states = np.concatenate([PAPER_STATE, PAPER_BOX.uniform(3, np.random.default_rng(1))])
    outcome = evaluator(BestTimeJob(states, TIGHT))
    assert outcome.converged.all()
    for row, state in enumerate(states):
        optimum = solve_free_time(state, options=NlpOptions(intervals=15))
        # The slowest converge linearly: where 1e-10 of the cost is left, so is 2e-5 of the time.
        assert outcome.terminal_time_s[row] == pytest.approx(optimum.terminal_time_s, rel=3e-5)
        assert outcome.final_mass_kg[row] == pytest.approx(optimum.final_mass_kg, abs=0.01)


def test_result_does_not_depend_on_what_was_done_before(evaluator: OptimumEvaluator) -> None:
    states = PAPER_BOX.uniform(3, np.random.default_rng(2))
    first = evaluator(BestTimeJob(states, ScpOptions()))
    evaluator(BestTimeJob(PAPER_STATE, ScpOptions()))
    again = evaluator(BestTimeJob(states, ScpOptions()))
    np.testing.assert_array_equal(first.terminal_time_s, again.terminal_time_s)
    np.testing.assert_array_equal(first.references, again.references)


@pytest.mark.parametrize("method", [GradientMethod.ENVELOPE, GradientMethod.UNROLLED])
def test_slopes_are_those_of_the_mass(method: GradientMethod) -> None:
    # 0.999, the planner's own: with it the unrolled derivative has a regular active set.
    evaluator = OptimumModel(problems.get("powered_descent"), intervals=15)()
    options = ScpOptions.for_gradients(cost_tolerance=1e-11, max_iterations=60)
    step = 1e-3
    for time in (32.6, 33.3, 34.0):
        times = time + step * np.array([-1.0, 0.0, 1.0])
        states = np.repeat(PAPER_STATE, 3, axis=0)
        outcome = evaluator(GivenTimeJob(states, options, times, method))
        assert outcome.converged.all()
        difference = -(outcome.final_mass_kg[2] - outcome.final_mass_kg[0]) / (2.0 * step)
        # Third derivative of the mass times step^2, and 1e-6 kg of convergence over 2 step.
        assert outcome.slope_kg_s[1] == pytest.approx(difference, abs=5e-3)
        assert outcome.trusted[1]


def test_slope_of_an_infeasible_time_leads_out_of_it(evaluator: OptimumEvaluator) -> None:
    times = np.array([29.0, 30.0, 31.0, 34.0])
    outcome = evaluator(
        GivenTimeJob(
            np.repeat(PAPER_STATE, 4, axis=0), ScpOptions(), times, GradientMethod.ENVELOPE
        )
    )
    np.testing.assert_array_equal(outcome.infeasible, [True, True, True, False])
    np.testing.assert_array_equal(outcome.converged, [False, False, False, True])
    slopes = outcome.slope_kg_s
    assert slopes[0] < slopes[1] < slopes[2] < -1e6
    assert 0.0 < slopes[3] < 1e3


def test_warm_start_saves_iterations(evaluator: OptimumEvaluator) -> None:
    states = PAPER_BOX.uniform(4, np.random.default_rng(3))
    best = evaluator(BestTimeJob(states, TIGHT))
    times = best.terminal_time_s + 0.01
    cold = evaluator(GivenTimeJob(states, ScpOptions(), times))
    warm = evaluator(GivenTimeJob(states, ScpOptions(), times, references=best.references))
    assert cold.converged.all()
    assert warm.converged.all()
    assert warm.iterations.sum() < 0.7 * cold.iterations.sum()
    # Two ends of the same flat valley: the tolerance of 1e-8 is 3e-4 kg of the mass.
    np.testing.assert_allclose(warm.final_mass_kg, cold.final_mass_kg, atol=2e-3)
    partly = best.references.copy()
    partly[1] = np.nan
    mixed = evaluator(GivenTimeJob(states, ScpOptions(), times, references=partly))
    assert mixed.iterations[1] == cold.iterations[1]
    assert mixed.iterations[0] == warm.iterations[0]


def test_a_failure_harms_no_other(evaluator: OptimumEvaluator) -> None:
    states = np.repeat(PAPER_STATE, 2, axis=0)
    states[0, 0] = 100.0
    states[0, 3] = -900.0  # hits the ground in a tenth of a second
    outcome = evaluator(GivenTimeJob(states, ScpOptions(), np.array([33.0, 33.0])))
    np.testing.assert_array_equal(outcome.converged, [False, True])
    alone = evaluator(GivenTimeJob(PAPER_STATE, ScpOptions(), np.array([33.0])))
    # Equal up to the solver's tolerance, to which the state before it matters.
    assert outcome.final_mass_kg[1] == pytest.approx(alone.final_mass_kg[0], abs=1e-3)


def test_batches_are_put_together_in_order(evaluator: OptimumEvaluator) -> None:
    engine = SerialEngine(lambda: evaluator)
    states = PAPER_BOX.uniform(18, np.random.default_rng(4))
    counted: list[int] = []
    labels = best_times(engine, states, PATIENT, counted.append)
    assert counted == [16, 2]
    np.testing.assert_array_equal(labels.states, states)
    alone = evaluator(BestTimeJob(states[16:], PATIENT))
    np.testing.assert_array_equal(labels.terminal_time_s[16:], alone.terminal_time_s)
    outcome = given_times(
        engine, states, labels.terminal_time_s, PATIENT, references=labels.references
    )
    assert outcome.converged.all()
    np.testing.assert_allclose(outcome.final_mass_kg, labels.final_mass_kg, atol=2e-3)


def test_states_without_an_optimum_are_named(evaluator: OptimumEvaluator) -> None:
    state = PAPER_STATE.copy()
    state[0, 3] = -900.0
    with pytest.raises(LabelError, match=r"1 of 1 states.*-900"):
        best_times(SerialEngine(lambda: evaluator), state, PATIENT)

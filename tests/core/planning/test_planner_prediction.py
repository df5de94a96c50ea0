from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from oracles.powered_descent_physics import PAPER_INITIAL_STATE

from dscp_core import problems
from dscp_core.errors import InvalidInputError
from dscp_core.planning.plan import PlanOutcome, PlanStatus
from dscp_core.planning.planner import Planner, PlannerSettings, TerminalTime
from dscp_core.planning.terminal_time_network import TerminalTimeNetwork
from dscp_core.problem.trajectory import Plan
from dscp_core.problems.powered_descent.definition import NETWORK

Array = NDArray[np.float64]

START = np.array(PAPER_INITIAL_STATE)


@pytest.fixture(scope="module")
def free() -> Planner:
    return Planner(
        problems.get("powered_descent"), PlannerSettings(terminal_time=TerminalTime.FREE)
    )


def plan_of(outcome: PlanOutcome) -> Plan:
    assert outcome.plan is not None, outcome.message
    return outcome.plan


class Predictor:
    """Predicts the same terminal time for every state of 38 t."""

    def __init__(self, time_s: float) -> None:
        self.time_s = time_s

    def predict(self, state: Array) -> float:
        if state[6] != START[6]:
            raise InvalidInputError("mass", float(state[6]), "38000 kg")
        return self.time_s


@pytest.fixture(scope="module")
def predicted() -> Planner:
    """Predicts 33.1 s for every state of 38 t."""
    settings = PlannerSettings(terminal_time=TerminalTime.PREDICTED)
    return Planner(problems.get("powered_descent"), settings, Predictor(33.1))


def predicting(planner: Planner, time_s: float) -> Planner:
    """The same planner with another prediction."""
    assert isinstance(planner._predictor, Predictor)
    planner._predictor.time_s = time_s
    return planner


def test_predicted_terminal_time(predicted: Planner) -> None:
    outcome = predicting(predicted, 33.1).plan(START)
    assert outcome.status is PlanStatus.CERTIFIED
    assert outcome.terminal_time_predicted_s == 33.1
    assert outcome.terminal_time_used_s == 33.1
    assert outcome.terminal_time_source is TerminalTime.PREDICTED
    assert outcome.terminal_time_reason == ""
    # On the way, the last plan is the start, with the prediction for the new state.
    first = plan_of(outcome)
    elapsed_s = float(first.times_s[4])
    state = np.array([*first.states[4][:6], START[6]])
    warm = predicting(predicted, 30.6).plan(state, warm_start=first, elapsed_s=elapsed_s)
    assert warm.status is PlanStatus.CERTIFIED
    assert warm.warm_started
    assert warm.terminal_time_used_s == 30.6


def test_plan_that_is_far_away_is_no_start(predicted: Planner, free: Planner) -> None:
    first = plan_of(predicting(predicted, 33.1).plan(START))
    state = np.array([5300.0, -600.0, 300.0, -125.0, -20.0, 10.0, 38000.0])
    assert not free.plan(state, warm_start=first, elapsed_s=0.3).warm_started
    outcome = predicting(predicted, 36.0).plan(state, warm_start=first, elapsed_s=0.3)
    assert outcome.status is PlanStatus.CERTIFIED
    assert outcome.terminal_time_used_s == 36.0
    assert not outcome.warm_started


def test_state_that_the_predictor_does_not_know_has_a_free_terminal_time(
    predicted: Planner, free: Planner
) -> None:
    state = np.array([*START[:6], 37000.0])
    outcome = predicted.plan(state)
    reference = free.plan(state)
    assert outcome.status is PlanStatus.CERTIFIED
    assert outcome.terminal_time_predicted_s is None
    assert outcome.terminal_time_source is TerminalTime.FREE
    assert outcome.terminal_time_reason == "mass: got 37000.0, expected 38000 kg"
    assert outcome.iterations == reference.iterations
    # The solver keeps what it factorised last, which shows in the last digits.
    assert outcome.terminal_time_used_s == pytest.approx(reference.terminal_time_used_s, abs=1e-6)
    assert reference.terminal_time_source is TerminalTime.FREE
    assert reference.terminal_time_reason == ""


def test_in_flight_what_is_left_of_the_plan_is_the_start(predicted: Planner, free: Planner) -> None:
    # The mass has left what the predictor knows, as it does with the first fuel burnt.
    first = plan_of(predicting(predicted, 33.1).plan(START))
    outcome = predicted.plan(first.states[4], warm_start=first, elapsed_s=float(first.times_s[4]))
    assert outcome.status is PlanStatus.CERTIFIED
    assert outcome.warm_started
    assert outcome.terminal_time_source is TerminalTime.FREE
    # The best from here, and not what the prediction has left; flat: see test_powered_descent.
    best = free.plan(first.states[4])
    assert outcome.terminal_time_used_s == pytest.approx(best.terminal_time_used_s, abs=0.002)


@pytest.mark.parametrize(
    ("time_s", "reason"),
    [
        (31.0, "no plan in the predicted 31.000 s: no feasible trajectory"),
        (float("nan"), "terminal_time: got nan"),
        (-3.0, "terminal_time: got -3"),
        (250.0, "predicted terminal time: got 250.0, expected 1 to 200 s"),
    ],
)
def test_bad_prediction_is_followed_by_a_free_terminal_time(
    predicted: Planner, free: Planner, time_s: float, reason: str
) -> None:
    outcome = predicting(predicted, time_s).plan(START, deadline_s=60.0)
    reference = free.plan(START)
    assert outcome.status is PlanStatus.CERTIFIED
    assert outcome.terminal_time_source is TerminalTime.FREE
    assert outcome.terminal_time_reason.startswith(reason)
    # The solver keeps what it factorised last, which shows in the last digits.
    assert outcome.terminal_time_used_s == pytest.approx(reference.terminal_time_used_s, abs=1e-6)
    infeasible = reason.startswith("no plan")
    assert outcome.terminal_time_predicted_s == (time_s if infeasible else None)
    # Those of the failed prediction count.
    assert (outcome.iterations > reference.iterations) == infeasible


def test_after_a_bad_prediction_the_deadline_still_counts(predicted: Planner) -> None:
    outcome = predicting(predicted, 31.0).plan(START, deadline_s=1e-9)
    assert outcome.status is PlanStatus.DEADLINE
    assert outcome.iterations == 0


def test_shipped_network_is_a_predictor(free: Planner) -> None:
    network = TerminalTimeNetwork.load(
        NETWORK, free.problem.vehicle_of(free.problem.table.unpack(free.parameters))
    )
    planner = Planner(
        problems.get("powered_descent"),
        PlannerSettings(terminal_time=TerminalTime.PREDICTED),
        network,
    )
    outcome = planner.plan(START)
    best = free.plan(START)
    assert outcome.status is PlanStatus.CERTIFIED
    assert outcome.terminal_time_source is TerminalTime.PREDICTED
    assert outcome.terminal_time_used_s == network.predict(START)
    # 1e-3 of 32.8 s; the mass has a curvature of 67 kg/s^2 there.
    assert outcome.terminal_time_used_s == pytest.approx(best.terminal_time_used_s, rel=1e-3)
    assert outcome.cost == pytest.approx(best.cost, abs=0.1)
    high = START + np.array([600.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    outside = planner.plan(high)
    assert outside.status is PlanStatus.CERTIFIED
    assert outside.terminal_time_reason.startswith("x: got 5600")
    assert "trained for" in outside.terminal_time_reason


@pytest.mark.parametrize(
    ("mode", "predictor"),
    [(TerminalTime.PREDICTED, None), (TerminalTime.FIXED, Predictor(33.0))],
)
def test_predictor_comes_with_its_mode(mode: TerminalTime, predictor: Any) -> None:
    with pytest.raises(InvalidInputError, match="predictor"):
        Planner(problems.get("powered_descent"), PlannerSettings(terminal_time=mode), predictor)

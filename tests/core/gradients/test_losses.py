from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from core.toy_problems import cart
from numpy.typing import NDArray

from dscp_core.errors import InvalidInputError
from dscp_core.gradients.losses import (
    ConvergenceLoss,
    CostLoss,
    FinalStateLoss,
    LogConvergenceLoss,
    Loss,
)
from dscp_core.scp.scp import Scp, ScpOptions, ScpResult
from dscp_core.transcription.transcription import Transcription

Array = NDArray[np.float64]

LOSSES: tuple[Loss, ...] = (
    FinalStateLoss("position", -2.0),
    CostLoss(),
    ConvergenceLoss(),
    LogConvergenceLoss(3.0, 1e-3),
)


@pytest.fixture(scope="module")
def scp() -> Scp:
    return Scp(Transcription(cart(), 5), ScpOptions(fixed_iterations=4))


@pytest.fixture(scope="module")
def trace(scp: Scp) -> ScpResult:
    """A run whose decisions are shaken, so that no two iterates nearly coincide."""
    table = scp.transcription.table
    result = scp.run(table.pack({"target": [1.2, 0.3]}))
    shake = np.random.default_rng(3).standard_normal((4, scp.transcription.layout.size))
    return moved(scp, result, shake, np.zeros(table.size), 0.05)


def moved(
    scp: Scp, trace: ScpResult, decisions: Array, parameters: Array, step: float
) -> ScpResult:
    """The trace with other decisions and parameters, its costs computed again."""
    packed = trace.parameters + step * parameters
    iterations = []
    for iteration, change in zip(trace.iterations, decisions, strict=True):
        z = iteration.solution.z + step * change
        size = trace.initial_reference.size
        iterations.append(
            replace(
                iteration,
                solution=replace(iteration.solution, z=z),
                cost=scp.transcription.evaluate(z[:size], packed).cost,
            )
        )
    return replace(trace, iterations=tuple(iterations), parameters=packed)


@pytest.mark.parametrize("loss", LOSSES, ids=lambda loss: type(loss).__name__)
def test_gradient_matches_differences(scp: Scp, trace: ScpResult, loss: Loss) -> None:
    transcription = scp.transcription
    gradient = loss.gradient(transcription, trace)
    assert gradient.decisions.shape == (4, transcription.layout.size)
    assert gradient.parameters.shape == (transcription.table.size,)
    rng = np.random.default_rng(4)
    for _ in range(5):
        decisions = rng.standard_normal(gradient.decisions.shape)
        parameters = rng.standard_normal(gradient.parameters.shape)
        step = 1e-5
        ahead, behind = (
            loss.value(transcription, moved(scp, trace, decisions, parameters, sign * step))
            for sign in (1.0, -1.0)
        )
        along = np.sum(gradient.decisions * decisions) + gradient.parameters @ parameters
        # The remainder is 1e-10 times third derivatives, up to 1e4 for the logarithm.
        assert along == pytest.approx((ahead - behind) / (2 * step), rel=1e-6, abs=1e-6)


def test_final_state_is_in_si(scp: Scp, trace: ScpResult) -> None:
    layout = scp.transcription.layout
    last = layout.states(trace.final_reference)[-1]
    assert FinalStateLoss("position").value(scp.transcription, trace) == pytest.approx(last[0])
    assert FinalStateLoss("speed", 3.0).value(scp.transcription, trace) == pytest.approx(
        3.0 * last[1]
    )


def test_cost_is_that_of_the_last_iterate(scp: Scp, trace: ScpResult) -> None:
    assert CostLoss().value(scp.transcription, trace) == trace.iterations[-1].cost


def test_convergence_counts_from_the_second_iterate(scp: Scp, trace: ScpResult) -> None:
    costs = [iteration.cost for iteration in trace.iterations]
    expected = abs(costs[1] - costs[3]) + abs(costs[2] - costs[3])
    value = ConvergenceLoss().value(scp.transcription, trace)
    assert value == pytest.approx(expected)
    assert expected > 1e-3
    gradient = ConvergenceLoss().gradient(scp.transcription, trace)
    assert not gradient.decisions[0].any()


def test_logarithm_of_the_metric_has_a_floor(scp: Scp, trace: ScpResult) -> None:
    metric = ConvergenceLoss().value(scp.transcription, trace)
    loss = LogConvergenceLoss(2.0, 1e-3)
    assert loss.value(scp.transcription, trace) == pytest.approx(np.log(metric / 2.0 + 1e-3))
    short = replace(trace, iterations=trace.iterations[:1])
    assert loss.value(scp.transcription, short) == pytest.approx(np.log(1e-3))


def test_single_iteration_has_converged(scp: Scp, trace: ScpResult) -> None:
    short = replace(trace, iterations=trace.iterations[:1])
    assert ConvergenceLoss().value(scp.transcription, short) == 0.0
    gradient = ConvergenceLoss().gradient(scp.transcription, short)
    assert not gradient.decisions.any()
    assert not gradient.parameters.any()


def test_unknown_state(scp: Scp, trace: ScpResult) -> None:
    with pytest.raises(InvalidInputError, match="one of position, speed"):
        FinalStateLoss("mass").value(scp.transcription, trace)


@pytest.mark.parametrize("loss", LOSSES, ids=lambda loss: type(loss).__name__)
def test_no_gradient_of_an_empty_trace(scp: Scp, trace: ScpResult, loss: Loss) -> None:
    with pytest.raises(InvalidInputError, match="0 iterations"):
        loss.gradient(scp.transcription, replace(trace, iterations=()))

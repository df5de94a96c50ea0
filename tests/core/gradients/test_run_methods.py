from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from core.toy_problems import cart, effort_of, free_cart, least_effort
from core.whole_runs import MINUS_FINAL_MASS, descent, difference, packed, unit
from numpy.typing import NDArray

from dscp_core.errors import InvalidInputError
from dscp_core.gradients.losses import ConvergenceLoss, CostLoss, LossGradient
from dscp_core.gradients.run import DifferentiationError, Method, implicit, tangent, unrolled
from dscp_core.scp.scp import Scp, ScpOptions, ScpResult, ScpStatus
from dscp_core.transcription.transcription import Transcription

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LinearLoss:
    """Given weights on every entry of every iterate and on the parameters."""

    decisions: Array
    parameters: Array

    def value(self, transcription: Transcription, trace: ScpResult) -> float:
        iterates = np.array([iteration.solution.z for iteration in trace.iterations])
        return float(np.sum(self.decisions * iterates) + self.parameters @ trace.parameters)

    def gradient(self, transcription: Transcription, trace: ScpResult) -> LossGradient:
        return LossGradient(self.decisions, self.parameters)


@pytest.fixture(scope="module")
def fine() -> Scp:
    """The paper's case."""
    return descent(50)


@pytest.fixture(scope="module")
def coarse() -> Scp:
    """Four iterations from the initial guess: not converged, so that every weight matters."""
    return descent(20).with_options(fixed_iterations=4)


@pytest.fixture(scope="module")
def coarse_free() -> Scp:
    return descent(20, free=True).with_options(fixed_iterations=4)


@pytest.fixture(scope="module")
def printed() -> Scp:
    return descent(20, "printed").with_options(fixed_iterations=4)


@pytest.mark.parametrize("which", ["coarse", "coarse_free", "printed"])
def test_forward_and_reverse_mode_agree(which: str, request: pytest.FixtureRequest) -> None:
    scp: Scp = request.getfixturevalue(which)
    table = scp.transcription.table
    values: dict[str, Any] = {"terminal_time": 33.2, "trust_region_state": [0.5] * 7}
    parameters = table.pack(values)
    trace = scp.run(parameters)
    rng = np.random.default_rng(6)
    for _ in range(3):
        # A loss of every entry of every iterate, intermediate ones included.
        weights = rng.standard_normal((4, scp.transcription.layout.size))
        loss = LinearLoss(weights, rng.standard_normal(table.size) / (1.0 + np.abs(parameters)))
        sizes = np.maximum(np.abs(parameters), 1e-3)
        # A bound that is infinite stays so.
        direction = rng.standard_normal(table.size) * np.where(np.isinf(sizes), 0.0, sizes)
        gradient = unrolled(scp, trace, loss)
        forward = tangent(scp, trace, direction)
        assert forward.decisions.shape == weights.shape
        terms = weights * forward.decisions
        pushed = np.sum(terms) + loss.parameters @ direction
        pulled = gradient.parameters @ direction
        # The dot product itself rounds, relative to the size of its terms.
        size = np.sum(np.abs(terms)) + np.sum(np.abs(loss.parameters * direction))
        assert abs(pushed - pulled) < 1e-10 * size


def test_warm_start_hands_its_gradient_to_the_caller(coarse: Scp) -> None:
    transcription = coarse.transcription
    parameters = packed(coarse, terminal_time=33.2)
    cold = unrolled(coarse, coarse.run(parameters), MINUS_FINAL_MASS)
    guess = transcription.initial_guess(parameters)
    warm = unrolled(coarse, coarse.run(parameters, guess), MINUS_FINAL_MASS)
    through_guess = transcription.initial_guess_pullback(parameters, warm.initial_reference)
    # The same runs; the sums are ordered differently.
    np.testing.assert_allclose(
        warm.parameters + through_guess, cold.parameters, rtol=1e-6, atol=1e-12
    )
    assert np.abs(through_guess).max() > 1e-5
    trace = coarse.run(parameters, guess)
    assert not tangent(coarse, trace, unit(coarse, "glideslope_angle_max", 0)).decisions.any()


def test_implicit_and_unrolled_agree_at_convergence() -> None:
    scp = descent(30).with_options(fixed_iterations=30)
    for time_s in (32.6, 33.3):
        parameters = packed(scp, terminal_time=time_s)
        trace = scp.run(parameters)
        through, at_the_end = (
            function(scp, trace, MINUS_FINAL_MASS) for function in (unrolled, implicit)
        )
        assert through.trusted, through.reasons
        assert at_the_end.trusted, at_the_end.reasons
        assert at_the_end.method is Method.IMPLICIT
        assert at_the_end.value == through.value
        assert not at_the_end.initial_reference.any()
        # Per natural change of each parameter, in kilograms; the largest is 1e5. Thirty steps
        # leave 1e-7 of their start where the steps shrink by half each.
        natural = np.maximum(np.abs(parameters), 1.0)
        natural[scp.transcription.table.slice("thrust_prox")] = 1e-8
        natural[np.isinf(natural)] = 0.0  # no bound, and none for a small change
        difference_kg = np.abs(through.parameters - at_the_end.parameters) * natural
        assert difference_kg.max() < 1e-5 * np.abs(through.parameters * natural).max()
        time_gradients = (
            g.parameters @ unit(scp, "terminal_time", 0) for g in (through, at_the_end)
        )
        assert next(time_gradients) == pytest.approx(next(time_gradients), rel=1e-5)


def test_implicit_matches_differences_of_the_optimum() -> None:
    # A linear-quadratic problem, whose optimum is known in closed form.
    scp = Scp(Transcription(free_cart(), 8), ScpOptions.for_gradients(solver="clarabel"))
    trace = scp.run(scp.transcription.table.pack())

    def cost(time_s: float, mass_kg: float) -> float:
        return effort_of(least_effort(8, time_s, mass_kg), time_s)

    for method in (unrolled, implicit):
        gradient = method(scp, trace, CostLoss())
        assert gradient.trusted, gradient.reasons
        by_time = gradient.parameters @ unit(scp, "terminal_time", 0)
        by_mass = gradient.parameters @ unit(scp, "mass", 0)
        # Fourth-order differences of a smooth closed form.
        assert by_time == pytest.approx(difference(lambda s: cost(2.0 + s, 1.5), 1e-3), rel=1e-8)
        assert by_mass == pytest.approx(difference(lambda s: cost(2.0, 1.5 + s), 1e-3), rel=1e-8)


def test_implicit_says_when_nothing_has_converged(coarse: Scp) -> None:
    once = coarse.with_options(fixed_iterations=1)
    gradient = implicit(once, once.run(packed(once)), MINUS_FINAL_MASS)
    assert not gradient.trusted
    assert any("not settled" in reason for reason in gradient.reasons)


def test_weakly_active_bound_is_not_trusted() -> None:
    # The bound touches the optimum of the unbounded problem: the derivative is one-sided.
    touching = float(np.abs(least_effort(8, 2.0, 1.5)).max())
    scp = Scp(Transcription(cart(), 8), ScpOptions.for_gradients(solver="clarabel"))
    for force_max, trusted in ((touching, False), (1.01 * touching, True), (0.99 * touching, True)):
        trace = scp.run(packed(scp, drag=0.0, force_max=force_max))
        assert trace.status is ScpStatus.CONVERGED
        gradient = unrolled(scp, trace, CostLoss())
        assert gradient.trusted is trusted, (force_max, gradient.reasons)
        if not trusted:
            assert all(reason.startswith("iteration ") for reason in gradient.reasons)
        assert len(gradient.verdicts) == len(trace.iterations)


def test_radius_is_the_distance_to_the_kink() -> None:
    touching = float(np.abs(least_effort(8, 2.0, 1.5)).max())
    scp = Scp(Transcription(cart(), 8), ScpOptions.for_gradients(solver="clarabel"))
    trace = scp.run(packed(scp, drag=0.0, force_max=touching + 0.01))
    towards = tangent(scp, trace, -unit(scp, "force_max", 0))
    # Linear in the bound: exact but for the solver's tolerance of 1e-12.
    assert towards.active_set_radius == pytest.approx(0.01, rel=1e-6)
    away = tangent(scp, trace, unit(scp, "force_max", 0))
    assert away.active_set_radius == np.inf


def test_unpolished_run_has_a_gradient_too(fine: Scp) -> None:
    plain = Scp(fine.transcription)
    trace = plain.run(packed(fine, terminal_time=33.3))
    polished = fine.run(packed(fine, terminal_time=33.3))
    index = fine.transcription.table.slice("terminal_time").start
    rough = unrolled(plain, trace, MINUS_FINAL_MASS).parameters[index]
    exact = unrolled(fine, polished, MINUS_FINAL_MASS).parameters[index]
    # The unpolished thrusts differ by 1e-5, scaled, where they hardly matter.
    assert rough == pytest.approx(exact, rel=1e-3)


def test_no_gradient_of_a_failed_run() -> None:
    scp = Scp(Transcription(cart(), 8))
    trace = scp.run(packed(scp, terminal_time=0.3))
    assert trace.status is ScpStatus.SUBPROBLEM_INFEASIBLE
    with pytest.raises(DifferentiationError, match="infeasible"):
        unrolled(scp, trace, CostLoss())
    with pytest.raises(DifferentiationError, match="infeasible"):
        implicit(scp, trace, CostLoss())
    with pytest.raises(DifferentiationError, match="infeasible"):
        tangent(scp, trace, np.zeros(scp.transcription.table.size))


def test_no_gradient_after_the_deadline(fine: Scp) -> None:
    late = fine.with_options(deadline_s=1e-9)
    with pytest.raises(DifferentiationError, match="time"):
        unrolled(late, late.run(packed(late)), MINUS_FINAL_MASS)


def test_implicit_refuses_losses_of_earlier_iterates(coarse: Scp) -> None:
    trace = coarse.run(packed(coarse))
    with pytest.raises(InvalidInputError, match="ConvergenceLoss"):
        implicit(coarse, trace, ConvergenceLoss())


def test_overflowing_gradient_is_an_error(coarse: Scp) -> None:
    trace = coarse.run(packed(coarse))
    weights = np.zeros((4, coarse.transcription.layout.size))
    weights[-1, 0] = np.inf
    loss = LinearLoss(weights, np.zeros(coarse.transcription.table.size))
    with pytest.raises(DifferentiationError, match="not finite"):
        unrolled(coarse, trace, loss)

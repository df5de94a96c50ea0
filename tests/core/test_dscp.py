from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from core.toy_problems import cart, free_cart, least_effort
from numpy.typing import NDArray

from dscp_core import problems
from dscp_core.dscp import DifferentiationError, Method, Tangent, implicit, tangent, unrolled
from dscp_core.errors import InvalidInputError
from dscp_core.losses import ConvergenceLoss, CostLoss, FinalStateLoss, Loss, LossGradient
from dscp_core.scp import Scp, ScpOptions, ScpResult, ScpStatus
from dscp_core.transcription import Transcription

Array = NDArray[np.float64]

MINUS_FINAL_MASS = FinalStateLoss("mass", -1.0)


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


def descent(intervals: int, formulation: str = "convergent", *, free: bool = False) -> Scp:
    transcription = Transcription(
        problems.get("powered_descent", formulation), intervals, free_terminal_time=free
    )
    return Scp(transcription, ScpOptions.for_gradients(solver="clarabel"))


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


def packed(scp: Scp, **values: Any) -> Array:
    return scp.transcription.table.pack(values)


def difference(function: Callable[[float], float], step: float) -> float:
    """Derivative at zero by central differences, extrapolated once to fourth order."""
    near, far = ((function(size) - function(-size)) / (2.0 * size) for size in (step, 2.0 * step))
    return (4.0 * near - far) / 3.0


def unit(scp: Scp, name: str, component: int) -> Array:
    direction = np.zeros(scp.transcription.table.size)
    direction[scp.transcription.table.slice(name).start + component] = 1.0
    return direction


def compare(
    scp: Scp, parameters: Array, direction: Array, step: float, loss: Loss = MINUS_FINAL_MASS
) -> tuple[float, float, Tangent]:
    """Gradient along a direction, and difference of whole runs with the same K.

    The step is cut to where the first active set changes: no difference across a kink.
    """
    trace = scp.run(parameters)
    gradient = unrolled(scp, trace, loss)
    assert gradient.trusted, gradient.reasons
    assert gradient.method is Method.UNROLLED
    assert gradient.value == pytest.approx(loss.value(scp.transcription, trace), rel=1e-14)
    forward = tangent(scp, trace, direction)
    backward = tangent(scp, trace, -direction)
    # Twice the step is used, and the radius is of first order.
    safe = min(step, 0.3 * forward.active_set_radius, 0.3 * backward.active_set_radius)

    def value(size: float) -> float:
        return loss.value(scp.transcription, scp.run(parameters + size * direction))

    return float(gradient.parameters @ direction), difference(value, safe), forward


# Error of the differences: rounding of the mass, 1e-11 kg, over the change of mass that the step
# makes, and the fourth-order remainder. It limits every tolerance below; the gradients themselves
# are as exact as the polished iterates, about 1e-10.
@pytest.mark.parametrize(
    ("name", "component", "step", "tolerance"),
    [
        ("terminal_time", 0, 3e-3, 1e-8),
        ("initial_position", 0, 0.5, 1e-8),
        ("initial_position", 1, 0.5, 1e-8),
        ("initial_velocity", 0, 0.02, 1e-8),
        ("initial_velocity", 2, 0.02, 1e-8),
        ("initial_mass", 0, 4.0, 1e-8),
        ("final_position", 0, 0.2, 1e-8),
        ("final_velocity", 2, 0.02, 1e-7),
        ("specific_impulse", 0, 0.03, 1e-8),
        ("gravity", 0, 1e-3, 1e-8),
        ("thrust_max", 0, 100.0, 1e-7),
        # Moves the mass by 1e-4 kg only: more of it is rounding.
        ("thrust_min", 0, 50.0, 1e-6),
        ("pointing_angle_max", 0, 1e-4, 1e-7),
        # Weights of penalties act through what is left of the steps, grams.
        ("fuel_weight", 0, 1e-2, 1e-6),
        ("thrust_prox", 0, 3e-7, 1e-5),
        ("trust_region_state", 0, 0.02, 1e-6),
        ("trust_region_state", 4, 0.02, 1e-6),
        ("trust_region_state", 6, 0.02, 1e-5),
        ("trust_region_control", 0, 0.01, 1e-6),
        ("trust_region_control", 2, 0.01, 1e-6),
        # Micrograms per kilogram of weight; the step is a thirtieth of the weight.
        ("virtual_control_weight", 0, 1e5, 1e-4),
    ],
)
def test_gradient_matches_differences_of_the_whole_run(
    coarse: Scp, name: str, component: int, step: float, tolerance: float
) -> None:
    parameters = packed(
        coarse,
        terminal_time=33.2,
        thrust_prox=1e-5,
        trust_region_state=[1.0] * 7,
        trust_region_control=[0.3] * 3,
    )
    exact, measured, _ = compare(coarse, parameters, unit(coarse, name, component), step)
    assert exact != 0.0
    assert exact == pytest.approx(measured, rel=tolerance)


@pytest.mark.parametrize(
    ("name", "component", "step", "tolerance"),
    [
        ("terminal_time", 0, 3e-3, 1e-8),
        ("initial_position", 1, 0.5, 1e-8),
        ("initial_velocity", 0, 0.02, 1e-8),
        ("initial_mass", 0, 4.0, 1e-8),
        ("specific_impulse", 0, 0.03, 1e-8),
        ("thrust_min", 0, 50.0, 1e-7),
        ("thrust_max", 0, 100.0, 1e-7),
        ("trust_region_control", 0, 0.1, 1e-7),
        ("virtual_control_weight", 0, 1e7, 1e-6),
    ],
)
def test_printed_formulation(
    printed: Scp, name: str, component: int, step: float, tolerance: float
) -> None:
    parameters = packed(printed, terminal_time=33.2)
    exact, measured, _ = compare(printed, parameters, unit(printed, name, component), step)
    assert exact != 0.0
    assert exact == pytest.approx(measured, rel=tolerance)


@pytest.mark.parametrize(
    ("name", "component", "step", "tolerance"),
    [
        ("initial_position", 0, 0.5, 1e-8),
        ("initial_velocity", 1, 0.02, 1e-8),
        ("initial_mass", 0, 4.0, 1e-8),
        ("thrust_max", 0, 100.0, 1e-7),
        # The first guess, whose influence fades.
        ("terminal_time", 0, 0.02, 1e-5),
        ("time_weight", 0, 0.1, 1e-5),
        # 1e-5 kg over the whole of it.
        ("trust_region_step", 0, 30.0, 1e-4),
    ],
)
def test_free_terminal_time(
    coarse_free: Scp, name: str, component: int, step: float, tolerance: float
) -> None:
    parameters = packed(coarse_free, terminal_time=33.2, trust_region_step=100.0, time_weight=1.0)
    exact, measured, _ = compare(coarse_free, parameters, unit(coarse_free, name, component), step)
    assert exact != 0.0
    assert exact == pytest.approx(measured, rel=tolerance)


def test_gradient_over_the_terminal_time(fine: Scp) -> None:
    direction = unit(fine, "terminal_time", 0)
    untrusted = 0
    for time_s in (32.3, 32.5, 32.7, 33.0, 33.3, 33.6, 33.9):
        parameters = packed(fine, terminal_time=time_s)
        trace = fine.run(parameters)
        assert trace.status is ScpStatus.CONVERGED
        same = fine.with_options(fixed_iterations=len(trace.iterations))
        gradient = unrolled(same, trace, MINUS_FINAL_MASS)
        exact = float(gradient.parameters @ direction)

        def value(size: float, scp: Scp = same, at: Array = parameters) -> float:
            result = scp.run(at + size * direction)
            return MINUS_FINAL_MASS.value(scp.transcription, result)

        radius = min(tangent(same, trace, d).active_set_radius for d in (direction, -direction))
        measured = difference(value, min(1e-3, 0.3 * radius))
        # Loss of 5 to 70 kg/s: rounding of 1e-11 kg over the step of 1e-4 s or more.
        error = abs(exact - measured) / abs(measured)
        untrusted += not gradient.trusted
        assert error < (1e-6 if gradient.trusted else 1e-3), (time_s, gradient.reasons)
    assert untrusted <= 1


def test_gradient_vanishes_at_the_optimal_time(fine: Scp) -> None:
    direction = unit(fine, "terminal_time", 0)
    slopes = []
    for time_s in (32.80, 32.82):
        trace = fine.run(packed(fine, terminal_time=time_s))
        slopes.append(unrolled(fine, trace, MINUS_FINAL_MASS).parameters @ direction)
    # IPOPT: -0.62075 and +0.62451 kg/s, to 1e-4; K steps have converged to about 1e-3.
    np.testing.assert_allclose(slopes, [-0.62075, 0.62451], atol=5e-3)


def test_bound_of_the_mean_thrust(fine: Scp) -> None:
    # Active only where a trust region does not keep the thrust from alternating.
    parameters = packed(fine, terminal_time=33.6)
    same = fine.with_options(fixed_iterations=len(fine.run(parameters).iterations))
    direction = unit(fine, "mean_thrust_fraction", 0)
    exact, measured, _ = compare(same, parameters, direction, 1e-4)
    assert exact != 0.0
    # Changes the mass by 1e-4 kg: rounding of 1e-11 kg.
    assert exact == pytest.approx(measured, rel=1e-6)


@pytest.mark.parametrize("time_s", [31.0, 31.8])
def test_verdict_on_infeasible_times(coarse: Scp, time_s: float) -> None:
    parameters, direction = packed(coarse, terminal_time=time_s), unit(coarse, "terminal_time", 0)
    trace = coarse.run(parameters)
    assert np.abs(trace.iterations[-1].virtual_control).max() > 0.1  # m/s
    gradient = unrolled(coarse, trace, MINUS_FINAL_MASS)

    def value(size: float) -> float:
        result = coarse.run(parameters + size * direction)
        return MINUS_FINAL_MASS.value(coarse.transcription, result)

    # Stiff penalties leave the iterates less accurate than those of feasible times.
    right = gradient.parameters @ direction == pytest.approx(difference(value, 1e-3), rel=1e-4)
    assert right or not gradient.trusted


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
        direction = rng.standard_normal(table.size) * np.maximum(np.abs(parameters), 1e-3)
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


def test_gradient_with_respect_to_the_initial_reference() -> None:
    scp = descent(20).with_options(fixed_iterations=2)
    parameters = packed(scp, terminal_time=33.2, trust_region_control=[0.3] * 3)
    guess = scp.transcription.initial_guess(parameters)
    gradient = unrolled(scp, scp.run(parameters, guess), MINUS_FINAL_MASS)
    assert gradient.trusted, gradient.reasons
    rng = np.random.default_rng(12)
    for _ in range(4):
        direction = rng.standard_normal(guess.size)

        def value(size: float, direction: Array = direction) -> float:
            result = scp.run(parameters, guess + size * direction)
            return MINUS_FINAL_MASS.value(scp.transcription, result)

        exact = gradient.initial_reference @ direction
        # Curvatures of the norms of thrust, of size 1, times 1e-5 squared twice; rounding
        # of 1e-11 kg over 1e-5.
        assert exact == pytest.approx(difference(value, 1e-5), rel=1e-5)


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
        return float(time_s / 8 * np.sum(least_effort(8, time_s, mass_kg) ** 2) / 2)

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
    assert any("not converged" in reason for reason in gradient.reasons)


def test_losses_of_a_run_with_running_cost() -> None:
    scp = Scp(
        Transcription(cart(), 8),
        ScpOptions.for_gradients(solver="clarabel", fixed_iterations=4),
    )
    # Drag strong enough for the iterates to differ, a bound that is active on some nodes.
    parameters = packed(scp, drag=2.0, target=[1.0, 0.2], trust_region_control=[0.5])
    for loss in (CostLoss(), ConvergenceLoss(), FinalStateLoss("speed")):
        for name, step in (("drag", 1e-3), ("terminal_time", 1e-3), ("force_max", 1e-3)):
            exact, measured, _ = compare(scp, parameters, unit(scp, name, 0), step, loss)
            # Numbers of size 1, rounding 1e-15 over 1e-3, fourth-order remainder 1e-12; the
            # pinned final speed has no derivative at all.
            assert exact == pytest.approx(measured, rel=1e-7, abs=1e-9)


def test_convergence_loss_of_the_descent(coarse: Scp) -> None:
    parameters = packed(coarse, terminal_time=33.2, trust_region_control=[0.3] * 3)
    for name, component, step in (
        ("trust_region_control", 0, 0.01),
        ("terminal_time", 0, 3e-3),
    ):
        direction = unit(coarse, name, component)
        exact, measured, _ = compare(coarse, parameters, direction, step, ConvergenceLoss())
        assert exact != 0.0
        # Differences of nearly equal masses: as for the weights above.
        assert exact == pytest.approx(measured, rel=1e-5)


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

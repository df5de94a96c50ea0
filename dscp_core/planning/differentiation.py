"""The gradient of a plan that was made: at its own trajectory, with its own parameters."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from dscp_core.errors import InvalidInputError
from dscp_core.gradients.gradient import Gradient, Method
from dscp_core.gradients.losses import ConvergenceLoss, Loss
from dscp_core.gradients.quantities import quantity
from dscp_core.gradients.run import DifferentiationError, of_plan, settle
from dscp_core.planning.certificate import PlanVerifier
from dscp_core.planning.plan import PlanOutcome, TerminalTime
from dscp_core.problem import checks
from dscp_core.problem.flight import ControlHold
from dscp_core.problem.trajectory import Plan
from dscp_core.scp.restoration import flyable
from dscp_core.scp.scp import GRADIENT_TOLERANCE, Scp, ScpResult

# How far the differentiated trajectory may be from the plan's, in units of the states' scales, and
# by how many tolerances of the iterations its cost may differ.
_SAME_TRAJECTORY = 1e-2
_SAME_COST = 100.0


class Certifier:
    """Says of runs whether their last trajectory can be flown; for layers, so it can be pickled."""

    def __init__(self, scp: Scp, hold: ControlHold) -> None:
        """Compile the verifier.

        Args:
            scp: The loop that runs.
            hold: How the controls are flown.
        """
        self._scp, self._hold = scp, hold
        transcription = scp.transcription
        self._verifier = PlanVerifier(
            transcription.problem, transcription.layout.intervals, hold=hold
        )

    def __reduce__(self) -> tuple[Any, ...]:
        """By what it was made of; the copy compiles its own functions."""
        return Certifier, (self._scp, self._hold)

    def __call__(self, trace: ScpResult) -> bool:
        """Whether the flight passes every check."""
        transcription, z = self._scp.transcription, trace.final_reference
        layout = transcription.layout
        if trace.iterations and self._scp.satisfies_dynamics(trace.iterations[-1]):
            z = flyable(transcription, z, trace.parameters)
        seconds = transcription.terminal_time(z, trace.parameters)
        times = np.linspace(0.0, seconds, layout.intervals + 1)
        states, controls = layout.states(z), layout.controls(z)
        return self._verifier.certify(times, states, controls, trace.parameters).passed


def differentiable(scp: Scp) -> Scp:
    """The same loop with polished, tightly solved subproblems and no deadline."""
    settings = scp.options.solver_settings
    tight = replace(settings, tolerance=min(settings.tolerance, GRADIENT_TOLERANCE))
    return scp.with_options(polish=True, solver_settings=tight, deadline_s=None)


def suited_method(loss: Loss, method: Method | None) -> Method:
    """The method that was asked for, or else implicit, except for what depends on the way."""
    if method is not None:
        return checks.choice("method", method, Method)
    return Method.UNROLLED if isinstance(loss, ConvergenceLoss) else Method.IMPLICIT


def plan_gradient(
    scp: Scp, outcome: PlanOutcome, of: str | Loss, method: Method | None
) -> Gradient:
    """Gradient of a plan; see `dscp_core.planning.planner.Planner.gradient`.

    Args:
        scp: A loop of the same problem, intervals and kind of terminal time.
        outcome: With the plan.
        of: See `dscp_core.gradients.quantities.quantity`.
        method: How to differentiate, or None for what suits.

    Raises:
        DifferentiationError: There is no plan, or its run has no gradient.
        InvalidInputError: A plan of another problem, or an unknown quantity.
    """
    problem, layout = scp.transcription.problem, scp.transcription.layout
    loss = quantity(problem, of).loss
    chosen = suited_method(loss, method)
    plan = outcome.plan
    if plan is None:
        raise DifferentiationError(f"there is no plan to differentiate: {outcome.headline}")
    free = outcome.terminal_time_source is TerminalTime.FREE
    here = (problem.name, layout.intervals, layout.free_terminal_time)
    there = (plan.problem, len(plan.states) - 1, free)
    if here != there:
        given, expected = (
            f"a plan of {name}, {intervals} intervals, terminal time {'free' if free else 'given'}"
            for name, intervals, free in (there, here)
        )
        raise InvalidInputError("at", given, expected)
    packed = problem.table.pack(outcome.parameters)
    loop = differentiable(scp)
    if chosen is Method.IMPLICIT:
        reference = layout.reference(plan.states, plan.controls, plan.terminal_time_s)
        trace = settle(loop, packed, reference)
    else:
        trace = loop.run(packed)
    gradient = of_plan(loop, trace, loss, chosen)
    moved = _moved(scp, trace, outcome, plan)
    if moved is None or not gradient.feasible:
        return gradient
    return replace(gradient, trusted=False, reasons=(*gradient.reasons, moved))


def _moved(scp: Scp, trace: ScpResult, outcome: PlanOutcome, plan: Plan) -> str | None:
    """Why what was differentiated is not the plan, where that is so."""
    layout, problem = scp.transcription.layout, scp.transcription.problem
    distance = layout.relative(layout.states(trace.final_reference) - plan.states)
    transcription, parameters = scp.transcription, trace.parameters
    flown = flyable(transcription, trace.final_reference, parameters)
    cost = transcription.evaluate(flown, parameters).cost
    size = max(problem.cost_magnitude or problem.cost_scale, abs(outcome.cost))
    if distance <= _SAME_TRAJECTORY and np.abs(cost - outcome.cost) <= (
        _SAME_COST * scp.cost_tolerance * size
    ):
        return None
    return (
        f"what was differentiated is {distance:.1e} (scaled) from the plan, whose iterations ended "
        f"with: {'' if outcome.stopped is None else outcome.stopped.value}; cost {cost:.9g} "
        f"instead of {outcome.cost:.9g}"
    )

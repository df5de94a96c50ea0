"""Gradients of entry runs at a fixed number of iterations, against differences of whole runs."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from core.entry_runs import CASES, weights
from core.whole_runs import compare, unit

from dscp_core import problems
from dscp_core.gradients.losses import ConvergenceLoss, CostLoss, Loss
from dscp_core.gradients.run import implicit, unrolled
from dscp_core.scp.scp import Scp, ScpOptions
from dscp_core.transcription.transcription import Transcription


@cache
def transcription(formulation: str, intervals: int) -> Transcription:
    return Transcription(problems.get("entry", formulation), intervals)


def loop(formulation: str, intervals: int, iterations: int) -> Scp:
    options = ScpOptions.for_gradients(fixed_iterations=iterations)
    return Scp(transcription(formulation, intervals), options)


def packed(scp: Scp, **values: Any) -> Any:
    return scp.transcription.problem.pack(values)


# K as the paper's rule finds them at the nominal vehicle.
@pytest.mark.parametrize(
    ("intervals", "case", "iterations", "ratio"),
    [
        (100, "case1", 19, 0.87),
        (100, "case2", 10, 1.08),
        (100, "case3", 5, 0.81),
        (100, "case4", 5, 1.13),
        (200, "case4", 7, 0.9),
    ],
)
def test_surface_to_mass_ratio(intervals: int, case: str, iterations: int, ratio: float) -> None:
    scp = loop("printed", intervals, iterations)
    parameters = packed(scp, surface_to_mass_ratio=ratio, **weights(*CASES[case]))
    direction = unit(scp, "surface_to_mass_ratio", 0)
    gradient, difference = compare(scp, parameters, direction, 3e-5, CostLoss())
    assert gradient == pytest.approx(difference, rel=1e-5)


# Steps balance truncation against 1e-13 of rounding; what is left is 1e-5.
@pytest.mark.parametrize(
    ("name", "component", "step"),
    [
        ("trust_region_state", 4, 3e-3),
        ("trust_region_control", 0, 1e-4),
        ("trust_region_control", 1, 1e-4),
        ("surface_to_mass_ratio", 0, 1e-4),
        ("drag_coefficients", 2, 1e-4),
        ("final_longitude", 0, 1e-5),
        # Those that act through the reference's rollout, alone or also.
        ("terminal_time", 0, 0.05),
        ("guess_angle_of_attack", 0, 3e-5),
        ("initial_bank_angle", 0, 3e-5),
        ("scale_height", 0, 0.1),
    ],
)
@pytest.mark.parametrize("loss", [CostLoss(), ConvergenceLoss()], ids=["cost", "convergence"])
def test_every_kind_of_parameter(loss: Loss, name: str, component: int, step: float) -> None:
    scp = loop("printed", 60, 3)
    gradient, difference = compare(scp, packed(scp), unit(scp, name, component), step, loss)
    assert gradient == pytest.approx(difference, rel=3e-5)


def test_derivative_of_the_rollout_matters() -> None:
    # The paper's reference depends on w_S/m; leaving that out costs percents at K = 3.
    scp = loop("printed", 60, 3)
    trace = scp.run(packed(scp))
    gradient = unrolled(scp, trace, CostLoss())
    where = scp.transcription.table.slice("surface_to_mass_ratio")
    through_guess = scp.transcription.initial_guess_pullback(
        trace.parameters, gradient.initial_reference
    )[where]
    assert abs(through_guess[0]) > 1e-2 * abs(gradient.parameters[where][0])


def test_implicit_equals_unrolled_at_convergence() -> None:
    scp = loop("quadratic", 100, 24)
    trace = scp.run(packed(scp))
    along, at_the_end = unrolled(scp, trace, CostLoss()), implicit(scp, trace, CostLoss())
    assert along.trusted, along.reasons
    assert at_the_end.trusted, at_the_end.reasons
    table = scp.transcription.table
    physical = [p.name for p in scp.transcription.problem.parameters]
    compared = 0
    for name in physical:
        a, b = along.parameters[table.slice(name)], at_the_end.parameters[table.slice(name)]
        if np.abs(b).max() > 1e-10:
            np.testing.assert_allclose(a, b, rtol=0.0, atol=1e-5 * np.abs(b).max(), err_msg=name)
            compared += 1
    assert compared > 15


def test_polish_is_one_newton_step_where_the_solver_told_the_active_set() -> None:
    # States without a cost: their dynamics' multipliers cancel where no limit is active, and
    # thresholds from what is left of them would take every inactive heat-rate row for active.
    scp = loop("quadratic", 100, 6)
    gradient = unrolled(scp, scp.run(packed(scp, surface_to_mass_ratio=0.97)), CostLoss())
    assert gradient.trusted, gradient.reasons
    assert all(v.polished for v in gradient.verdicts)
    assert sum(v.repairs for v in gradient.verdicts) <= 2
    assert max(v.kkt_residual for v in gradient.verdicts) < 1e-10

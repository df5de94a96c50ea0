"""The running cost's integral against an optimum that is known by hand.

A cart goes a distance D in a time T, from rest to rest, with the least integral of u^2 / 2 and a
speed of at most V. Where the limit holds, u = 0. Before, the costate of the speed, which is u,
falls linearly (that of the position is constant), and reaches 0 where the limit is met, at t_1, as
u is continuous there: u = (2 V / t_1) (1 - t / t_1), which gains V. The way up to t_1 is
2/3 V t_1. The end mirrors the start, so that D = V (T - 2 t_1) + 4/3 V t_1, which gives
t_1 = 3/2 (T - D / V). Both arcs together cost

    J = integral of (2 V / t_1)^2 (1 - t / t_1)^2 from 0 to t_1 = 4 V^2 / (3 t_1).

With T = 4 s, D = 6 m, V = 1.875 m/s: t_1 = 1.2 s, a node of every grid below, and J = 3.90625.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from core.toy_problems import effort
from numpy.typing import NDArray

from dscp_core.gradients.losses import CostLoss
from dscp_core.gradients.run import implicit, unrolled
from dscp_core.problem.declaration import (
    CostTerm,
    InitialGuess,
    OptimalControlProblem,
    PathConstraint,
    Quadrature,
    Variable,
    Where,
)
from dscp_core.problem.parameters import Parameter
from dscp_core.scp.scp import Scp, ScpOptions, ScpStatus
from dscp_core.transcription.transcription import Transcription

Array = NDArray[np.float64]

COST = 4 * 1.875**2 / (3 * 1.2)
# By t_1 and directly: dt_1 = 3/2 (dT - dD / V + D dV / V^2).
BY_TIME = -COST / 1.2 * 1.5
BY_DISTANCE = COST / 1.2 * 1.5 / 1.875
BY_SPEED = 2 * COST / 1.875 - COST / 1.2 * 1.5 * 6.0 / 1.875**2


def trolley() -> OptimalControlProblem:
    def guess(p: Any, intervals: int) -> InitialGuess:
        share = ca.DM(np.linspace(0.0, 1.0, intervals + 1)).T
        speed = p["distance"] / p["terminal_time"] * ca.MX.ones(1, intervals + 1)
        return InitialGuess(ca.vertcat(p["distance"] * share, speed), 0 * speed)

    return OptimalControlProblem(
        name="trolley",
        states=(Variable("position", "m", 6.0, ""), Variable("speed", "m/s", 2.0, "")),
        controls=(Variable("acceleration", "m/s^2", 3.0, ""),),
        parameters=(
            Parameter("terminal_time", 4.0, "s", ""),
            Parameter("distance", 6.0, "m", ""),
            Parameter("speed_max", 1.875, "m/s", ""),
        ),
        dynamics=lambda x, u, p: ca.vertcat(x[1], u[0]),
        initial_state=lambda p: ca.SX(2, 1),
        final_state={"position": lambda p: p["distance"], "speed": lambda p: 0.0},
        running_cost=lambda x, u, p: u[0] ** 2 / 2,
        cost_scale=1.0,
        path_constraints=(
            PathConstraint(
                "speed_max",
                lambda at, p: at.x[1] - p["speed_max"],
                2.0,
                "m/s",
                skip_first=True,
                skip_last=True,
            ),
        ),
        initial_guess=guess,
    )


def errors(problem: OptimalControlProblem, grids: tuple[int, ...]) -> Array:
    """Of cost and gradients by time, distance and speed limit, relative, (grids, 4)."""
    rows = []
    for intervals in grids:
        scp = Scp(Transcription(problem, intervals), ScpOptions.for_gradients())
        result = scp.run(problem.pack())
        assert result.status is ScpStatus.CONVERGED, result.message
        for method in (unrolled, implicit):
            gradient = method(scp, result, CostLoss())
            assert gradient.trusted, gradient.reasons
        found = np.array([result.iterations[-1].cost, *gradient.parameters[:3]])
        rows.append(found / [COST, BY_TIME, BY_DISTANCE, BY_SPEED] - 1.0)
    return np.array(rows)


MEAN = CostTerm("effort", effort, Where.MEAN)


@pytest.mark.parametrize("terms", [(), (MEAN,)], ids=["nodes", "means"])
def test_the_error_falls_by_4_when_the_intervals_double(terms: tuple[CostTerm, ...]) -> None:
    assert pytest.approx(3.90625, rel=1e-14) == COST
    found = errors(replace(trolley(), cost_terms=terms), (20, 40, 80, 160))
    # Higher orders are still seen on the coarser grids.
    np.testing.assert_allclose(found[:-1] / found[1:], 4.0, rtol=0.6)
    np.testing.assert_allclose(found[-2] / found[-1], 4.0, rtol=0.06)
    assert np.abs(found[1]).max() < 0.04
    assert np.abs(found[-1]).max() < 2e-3


def test_a_plain_sum_is_of_first_order() -> None:
    plain = replace(trolley(), quadrature=Quadrature.SUM)
    found, better = (errors(problem, (20, 40, 80)) for problem in (plain, trolley()))
    np.testing.assert_allclose(found[1] / found[2], 2.0, rtol=0.2)
    assert np.all(np.abs(found) > 4 * np.abs(better))
    assert np.all(np.abs(found[-1]) > 14 * np.abs(better[-1]))


def test_weights_of_the_nodes() -> None:
    problems = trolley(), replace(trolley(), quadrature=Quadrature.SUM)
    trapezoid, plain = (Transcription(problem, 4) for problem in problems)
    parameters = trolley().pack()
    reference = plain.initial_guess(parameters) + 1.0
    force = plain.layout.controls(reference)[0, 0]
    # All forces are the same; T = 1 s.
    assert plain.evaluate(reference, parameters).cost == pytest.approx(5 * force**2 / 2)
    assert trapezoid.evaluate(reference, parameters).cost == pytest.approx(4 * force**2 / 2)
    indices = [plain.layout.control_index(node, 0) for node in range(5)]
    kept = np.isin(plain.pattern.q.columns, indices)
    weighted, full = (t.values(reference, parameters).q[kept] for t in (trapezoid, plain))
    np.testing.assert_allclose(weighted / full, [0.5, 1.0, 1.0, 1.0, 0.5])

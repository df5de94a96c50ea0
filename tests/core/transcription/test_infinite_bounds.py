"""Constraints with infinite bounds are not imposed, and nothing else changes."""

from __future__ import annotations

import math
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from core.toy_problems import cart
from core.whole_runs import unit

from dscp_core.cone.program import ConeValues
from dscp_core.gradients.losses import CostLoss
from dscp_core.gradients.run import implicit, tangent, unrolled
from dscp_core.planning.certificate import PlanVerifier
from dscp_core.problem.declaration import ConeConstraint, OptimalControlProblem, PathConstraint
from dscp_core.problem.parameters import Parameter
from dscp_core.scp.scp import Scp, ScpOptions, ScpStatus
from dscp_core.transcription.transcription import Transcription

INTERVALS = 8
CONE = ConeConstraint("force_cone", lambda at, p: ca.vertcat(p["force_max"], at.u), 3.0, "N")


def boundless(*, cone: bool = False) -> OptimalControlProblem:
    """The cart, whose bound on the force may be infinite."""
    parameters = tuple(
        replace(p, default=math.inf, upper=math.inf, infinite=True) if p.name == "force_max" else p
        for p in cart().parameters
    )
    problem = replace(cart(), parameters=parameters)
    return replace(problem, path_constraints=(), cone_constraints=(CONE,)) if cone else problem


@pytest.mark.parametrize("cone", [False, True])
def test_an_infinite_bound_is_none(cone: bool) -> None:
    problem = boundless(cone=cone)
    scp = Scp(Transcription(problem, INTERVALS), ScpOptions.for_gradients())
    without = Scp(
        Transcription(replace(cart(), path_constraints=()), INTERVALS), ScpOptions.for_gradients()
    )
    parameters = problem.pack()
    result, expected = scp.run(parameters), without.run(cart().pack())
    assert result.status is ScpStatus.CONVERGED, result.message
    np.testing.assert_allclose(
        result.final_reference, expected.final_reference, rtol=0.0, atol=1e-10
    )
    force = problem.table.slice("force_max")
    for method in (unrolled, implicit):
        gradient = method(scp, result, CostLoss())
        bare = method(without, expected, CostLoss())
        assert gradient.trusted, gradient.reasons
        np.testing.assert_allclose(gradient.parameters, bare.parameters, rtol=1e-7, atol=1e-9)
        assert gradient.parameters[force] == 0.0
    direction = np.ones(parameters.size)
    direction[force] = 0.0
    moved = tangent(scp, result, direction)
    np.testing.assert_allclose(
        moved.decisions, tangent(without, expected, direction).decisions, rtol=0.0, atol=1e-8
    )
    # The same bound, finite and in the way.
    bounded = scp.run(problem.pack({"force_max": 2.0}))
    assert bounded.iterations[-1].cost > result.iterations[-1].cost * 1.0001


def test_only_the_infinite_one_of_two_bounds_goes() -> None:
    sides = (
        PathConstraint("force_max", lambda at, p: at.u[0] - p["force_max"], 3.0, "N"),
        PathConstraint("force_min", lambda at, p: -at.u[0] - 2.0, 3.0, "N"),
    )
    problem = replace(boundless(), path_constraints=sides)
    scp = Scp(Transcription(problem, INTERVALS))
    result = scp.run(problem.pack())
    forces = scp.transcription.layout.controls(result.final_reference)[:, 0]
    assert forces.min() == pytest.approx(-2.0, abs=1e-6)
    assert forces.max() > 2.0


def test_a_bound_that_is_infinite_in_the_declaration() -> None:
    sides = (PathConstraint("force_max", lambda at, p: at.u[0] - math.inf, 3.0, "N"),)
    problem = replace(cart(), path_constraints=sides)
    transcription = Transcription(problem, INTERVALS)
    parameters = problem.pack()
    reference = transcription.initial_guess(parameters)
    values = transcription.values(reference, parameters)
    values.check(transcription.pattern)
    assert not values.g.any()
    assert np.all(values.h == 1.0)
    # Its rows have no derivative in either direction.
    seed = ConeValues.from_flat(transcription.pattern, np.ones(transcription.pattern.n_values))
    pulled = transcription.values_pullback(reference, parameters, seed)
    direction = np.random.default_rng(0).standard_normal(reference.size + parameters.size)
    pushed = transcription.values_pushforward(
        reference, parameters, direction[: reference.size], direction[reference.size :]
    )
    assert np.concatenate(pulled) @ direction == pytest.approx(pushed.to_flat().sum(), rel=1e-12)
    assert not pushed.g.any()
    assert not pushed.h.any()


@pytest.mark.parametrize("bounds", [(0.5, math.inf), (-math.inf, 3.0), (-math.inf, math.inf)])
def test_bounds_of_the_terminal_time(bounds: tuple[float, float]) -> None:
    problem = replace(
        cart(),
        running_cost=lambda x, u, p: 1 + u[0] ** 2 / 2,
        terminal_time_bounds=lambda p: bounds,
        trust_region_step=1.0,
    )
    transcription = Transcription(problem, INTERVALS, free_terminal_time=True)
    result = Scp(transcription).run(problem.pack())
    assert result.status is ScpStatus.CONVERGED, result.message
    time_s = transcription.terminal_time(result.final_reference, result.parameters)
    assert time_s == pytest.approx(2.56165, abs=1e-3)


def test_certificates_leave_them_out() -> None:
    problem = boundless()
    transcription = Transcription(problem, INTERVALS)
    verifier = PlanVerifier(problem, INTERVALS)
    names = []
    for values in ({}, {"force_max": 50.0}):
        parameters = problem.pack(values)
        reference = Scp(transcription).run(parameters).final_reference
        certificate = verifier.certify(
            np.linspace(0.0, 2.0, INTERVALS + 1),
            transcription.layout.states(reference),
            transcription.layout.controls(reference),
            parameters,
        )
        assert certificate.passed, certificate.reasons
        names.append({check.name for check in certificate.checks})
    assert names[1] - names[0] == {"force_max", "force_min"}


def test_a_bound_that_becomes_infinite_where_no_parameter_is() -> None:
    limit = PathConstraint("speed", lambda at, p: at.x[1] - 1 / p["rate"], 1.0, "m/s")
    problem = replace(
        cart(),
        parameters=(*cart().parameters, Parameter("rate", 0.5, "s/m", "", lower=0.0)),
        path_constraints=(limit,),
    )
    scp = Scp(Transcription(problem, INTERVALS), ScpOptions.for_gradients())
    result = scp.run(problem.pack({"rate": 0.0}))
    direction = unit(scp, "mass", 0)
    reference, parameters = scp.transcription.cost_gradient(
        result.final_reference, result.parameters
    )
    moved = tangent(scp, result, direction).decisions[-1][: reference.size]
    gradient = unrolled(scp, result, CostLoss())
    forward = reference @ moved + parameters @ direction
    assert forward == pytest.approx(gradient.parameters[direction == 1.0][0], rel=1e-9)
    # By the rate itself there is no derivative, and it says so.
    assert gradient.reasons == ("gradient is not finite",)

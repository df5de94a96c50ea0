"""What subproblems minimise of a running and a terminal cost, against IPOPT and differences."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from core.toy_problems import cart, effort
from core.whole_runs import compare, unit
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from oracles import declared_nlp

from dscp_core.errors import InvalidInputError
from dscp_core.gradients.losses import CostLoss
from dscp_core.gradients.run import implicit, unrolled
from dscp_core.planning.planner import Planner, PlannerSettings
from dscp_core.problem.declaration import (
    ConeConstraint,
    CostTerm,
    InitialGuess,
    OptimalControlProblem,
    Parameters,
    PathConstraint,
    StagePoint,
    Variable,
    Where,
)
from dscp_core.problem.parameters import Parameter
from dscp_core.scp.scp import Scp, ScpOptions, ScpStatus
from dscp_core.transcription.analysis import CostForm
from dscp_core.transcription.costs import convexified
from dscp_core.transcription.transcription import Transcription

Array = NDArray[np.float64]
Cost = Callable[[ca.SX, ca.SX, Parameters], ca.SX]

INTERVALS = 20
EXACT, CONVEXIFIED = CostForm.EXACT, CostForm.CONVEXIFIED
BLOCK = ca.DM([1.0, 0.7])


def plane(running_cost: Cost) -> OptimalControlProblem:
    """A point with quadratic drag in a plane, accelerated from rest to rest."""
    names = ("x", "y", "vx", "vy")

    def rates(x: ca.SX, u: ca.SX, p: Parameters) -> ca.SX:
        speed = ca.sqrt(ca.sumsqr(x[2:]) + 1e-4)
        return ca.vertcat(x[2:], u - p["drag"] * speed * x[2:])

    def guess(p: Any, intervals: int) -> InitialGuess:
        share = ca.DM(np.linspace(0.0, 1.0, intervals + 1)).T
        still = ca.MX.ones(2, intervals + 1)
        states = ca.vertcat(ca.mtimes(p["goal"], share), 0.5 * still)
        return InitialGuess(states, 0.3 * still)

    return OptimalControlProblem(
        name="plane",
        states=tuple(Variable(n, "m", 2.0, "") for n in names),
        controls=(Variable("ax", "m/s^2", 1.0, ""), Variable("ay", "m/s^2", 1.0, "")),
        parameters=(
            Parameter("terminal_time", 3.0, "s", ""),
            Parameter("goal", (2.0, 1.0), "m", ""),
            Parameter("weight", 0.3, "1", ""),
            Parameter("drag", 0.2, "1/m", ""),
        ),
        dynamics=rates,
        initial_state=lambda p: ca.SX(4, 1),
        final_state={
            "x": lambda p: p["goal"][0],
            "y": lambda p: p["goal"][1],
            "vx": lambda p: 0.0,
            "vy": lambda p: 0.0,
        },
        cost_scale=1.0,
        running_cost=running_cost,
        initial_guess=guess,
    )


def cart_with(running_cost: Cost, **changes: Any) -> OptimalControlProblem:
    return replace(cart(), running_cost=running_cost, **changes)


def ending(terminal_cost: Cost) -> OptimalControlProblem:
    return replace(cart(), terminal_cost=terminal_cost, final_state={})


def _crossed(x: ca.SX, u: ca.SX, p: Parameters) -> ca.SX:
    return 1 + ca.sumsqr(u) / 2 + p["weight"] * x[2] ** 2 * u[1] ** 2


FIXED = {
    "quadratic": (EXACT, cart()),
    "coupled": (EXACT, cart_with(lambda x, u, p: (x[0] - 2 * u[0]) ** 2 + 0.1 * u[0] ** 2)),
    "by parameters": (EXACT, cart_with(lambda x, u, p: p["mass"] * u[0] ** 2 + p["drag"] * x[1])),
    "quartic": (CONVEXIFIED, cart_with(lambda x, u, p: u[0] ** 4 / 4 + x[0] ** 2)),
    "saddle": (CONVEXIFIED, cart_with(lambda x, u, p: (u[0] + x[0]) ** 2 / 2 - x[0] ** 2 / 4)),
    "concave part": (CONVEXIFIED, cart_with(lambda x, u, p: u[0] ** 2 / 2 - x[1] ** 2 / 2)),
    "waves": (CONVEXIFIED, cart_with(lambda x, u, p: u[0] ** 2 / 2 + ca.sin(4 * x[0]))),
    "rounded norm": (CONVEXIFIED, plane(lambda x, u, p: ca.sqrt(1 + ca.sumsqr(u)))),
    "obstacle": (
        CONVEXIFIED,
        plane(lambda x, u, p: ca.sumsqr(u) / 2 + 3 * ca.exp(-4 * ca.sumsqr(x[:2] - BLOCK))),
    ),
    "crossed": (CONVEXIFIED, plane(_crossed)),
}
FREE = {
    "quadratic": cart_with(lambda x, u, p: 1 + u[0] ** 2 / 2, trust_region_step=1.0),
    "crossed": plane(_crossed),
}
ENDS = {
    "quadratic": (EXACT, ending(lambda x, time, p: 5 * ca.sumsqr(x - p["target"]))),
    "convex": (
        CONVEXIFIED,
        ending(lambda x, time, p: ca.cosh(3 * (x[0] - 1)) + 5 * ca.cosh(x[1])),
    ),
    "concave": (CONVEXIFIED, ending(lambda x, time, p: -ca.tanh(x[0]) - 0.3 * x[1] ** 2)),
}


def solved(problem: OptimalControlProblem, *, free: bool = False) -> tuple[Scp, Any]:
    scp = Scp(
        Transcription(problem, INTERVALS, free_terminal_time=free),
        ScpOptions.for_gradients(max_iterations=40),
    )
    result = scp.run(problem.pack())
    assert result.status is ScpStatus.CONVERGED, result.message
    return scp, result


def assert_optimal(problem: OptimalControlProblem, *, free: bool = False) -> Scp:
    scp, result = solved(problem, free=free)
    layout, start = scp.transcription.layout, result.initial_reference
    best = declared_nlp.solve(
        problem,
        problem.table.unpack(result.parameters),
        layout.states(start),
        layout.controls(start),
        scp.transcription.terminal_time(start, result.parameters),
        free=free,
    )
    assert best.message == "Solve_Succeeded"
    # The stopping tolerance is 1e-8 of the cost; controls off by its root cost that much.
    assert result.iterations[-1].cost == pytest.approx(best.cost, rel=3e-8)
    controls = layout.controls(result.final_reference)
    np.testing.assert_allclose(controls, best.controls, rtol=0.0, atol=1e-3)
    time_s = scp.transcription.terminal_time(result.final_reference, result.parameters)
    assert time_s == pytest.approx(best.terminal_time_s, rel=1e-4)
    return scp


@pytest.mark.parametrize("name", FIXED)
def test_a_running_cost_alone_leads_to_its_optimum(name: str) -> None:
    form, problem = FIXED[name]
    scp = assert_optimal(problem)
    assert scp.transcription.costs.running is form
    assert scp.transcription.costs.terminal is CostForm.NONE


@pytest.mark.parametrize("name", FREE)
def test_so_it_does_with_a_free_terminal_time(name: str) -> None:
    assert_optimal(FREE[name], free=True)


@pytest.mark.parametrize("name", ENDS)
def test_a_terminal_cost_keeps_its_curvature(name: str) -> None:
    form, problem = ENDS[name]
    assert assert_optimal(problem).transcription.costs.terminal is form


def test_a_norm_is_better_bounded_by_a_control() -> None:
    """As docs/own-problem.md says."""
    norm = plane(lambda x, u, p: ca.sqrt(1e-2 + ca.sumsqr(u)) + ca.sumsqr(u) / 100)
    outcome = Planner(norm, PlannerSettings(intervals=INTERVALS)).plan()
    assert not outcome.converged
    assert "converged:" not in outcome.headline

    def guess(p: Any, intervals: int) -> InitialGuess:
        given = norm.initial_guess(p, intervals)
        return InitialGuess(given.states, ca.vertcat(given.controls, given.controls[0, :]))

    bound = ConeConstraint("norm", lambda at, p: ca.vertcat(at.u[2], 0.1, at.u[:2]), 1.0, "m/s^2")
    bounded = replace(
        norm,
        controls=(*norm.controls, Variable("norm", "m/s^2", 1.0, "")),
        dynamics=lambda x, u, p: norm.dynamics(x, u[:2], p),
        running_cost=lambda x, u, p: u[2] + ca.sumsqr(u[:2]) / 100,
        cone_constraints=(bound,),
        initial_guess=guess,
    )
    scp, result = solved(bounded)
    layout, end = scp.transcription.layout, result.final_reference
    best = declared_nlp.solve(
        norm,
        norm.table.unpack(norm.pack()),
        layout.states(end),
        layout.controls(end)[:, :2],
        3.0,
        free=False,
    )
    assert best.message == "Solve_Succeeded"
    assert result.iterations[-1].cost == pytest.approx(best.cost, rel=1e-7)


def box(running_cost: Cost, terminal_cost: Cost | None = None, still: float = 0.0) -> Planner:
    """A point in a plane whose speeds are bounded by 1 each."""

    def bound(axis: int, sign: int) -> PathConstraint:
        return PathConstraint(f"{axis} {sign}", lambda at, p: sign * at.u[axis] - 1, 1.0, "m/s")

    def guess(p: Any, intervals: int) -> InitialGuess:
        rows = ca.MX(2, intervals + 1)
        return InitialGuess(rows + still, rows + still)

    problem = replace(
        plane(running_cost),
        states=tuple(Variable(n, "m", 1.0, "") for n in "xy"),
        dynamics=lambda x, u, p: u,
        initial_state=lambda p: ca.SX(2, 1),
        final_state={},
        terminal_cost=terminal_cost,
        path_constraints=tuple(bound(axis, sign) for axis in (0, 1) for sign in (-1, 1)),
        initial_guess=guess,
    )
    return Planner(problem, PlannerSettings(intervals=6))


SADDLES: dict[str, tuple[Cost, Cost | None]] = {
    "diag(1, -1)": (lambda x, u, p: u[0] ** 2 - u[1] ** 2, None),
    "product": (lambda x, u, p: u[0] * u[1], None),
    "of states": (lambda x, u, p: ca.sumsqr(u) / 100 - 10 * x[1] ** 2, None),
    "at the end": (lambda x, u, p: ca.sumsqr(u) / 100, lambda x, time, p: -ca.sumsqr(x)),
}


@pytest.mark.parametrize("name", SADDLES)
def test_a_gradient_at_a_saddle_is_not_trusted(name: str) -> None:
    planner = box(*SADDLES[name])
    outcome = planner.plan()
    assert outcome.cost == 0.0
    gradient = planner.gradient("cost", at=outcome)
    assert not gradient.trusted
    assert any("no minimum but a saddle" in reason for reason in gradient.reasons)
    # From beside the saddle it ends at a minimum.
    planner = box(*SADDLES[name], still=0.1)
    outcome = planner.plan()
    assert outcome.converged
    assert outcome.cost < -0.5
    gradient = planner.gradient("cost", at=outcome)
    assert gradient.trusted, gradient.reasons


@pytest.mark.parametrize("name", ["crossed", "rounded norm", "obstacle", "saddle"])
def test_gradients_of_convexified_costs_match_differences(name: str) -> None:
    problem = FIXED[name][1]
    # Before convergence, so that the derivatives of the convexified Hessian count.
    options = ScpOptions.for_gradients(fixed_iterations=3)
    scp = Scp(Transcription(problem, 8), options)
    for parameter in ("terminal_time", "drag"):
        direction = unit(scp, parameter, 0)
        exact, measured = compare(scp, problem.pack(), direction, 1e-3, CostLoss())
        # Rounding 1e-12 of the solver over 1e-3, fourth-order remainder.
        assert exact == pytest.approx(measured, rel=1e-6, abs=1e-7)


def test_a_declared_model_has_the_values_of_the_derived_one() -> None:
    derived = Transcription(cart(), 6, free_terminal_time=True)
    declared = Transcription(
        replace(cart(), cost_terms=(CostTerm("effort", effort, Where.NODE),)),
        6,
        free_terminal_time=True,
    )
    assert declared.costs.running is CostForm.DECLARED
    assert declared.costs.models == {"effort"}
    parameters = cart().pack()
    reference = derived.initial_guess(parameters) + 0.1
    for name in ("q", "c"):
        np.testing.assert_allclose(
            getattr(declared.values(reference, parameters), name),
            getattr(derived.values(reference, parameters), name),
            rtol=1e-13,
            atol=1e-13,
        )


def test_curvature_and_proximal_terms_leave_the_running_cost_to_be_derived() -> None:
    def prox(at: StagePoint, reference: StagePoint, p: Parameters) -> ca.SX:
        return (at.u[0] - reference.u[0]) ** 2 / 100

    with_prox = replace(cart(), cost_terms=(CostTerm("prox", prox, Where.NODE),))
    plain, held = (Transcription(problem, 4) for problem in (cart(), with_prox))
    assert held.costs.running is CostForm.EXACT
    assert not held.costs.models
    parameters = cart().pack()
    reference = plain.initial_guess(parameters)
    added = held.values(reference, parameters).q - plain.values(reference, parameters).q
    # Second derivative 1/50, scales 3^2 / 2, at the ends as inside: it is no part of an integral.
    np.testing.assert_allclose(added[added != 0.0], np.full(5, 0.09))
    assert_optimal(with_prox)


@pytest.mark.parametrize(
    ("running", "factor", "message"),
    [
        (cart().running_cost, 2.0, r"along force .*that of T times the running_cost"),
        (None, 1.0, r"along force .*0: no running_cost is declared"),
        (lambda x, u, p: u[0] ** 2 / 2 + x[0], 1.0, "along position"),
        (lambda x, u, p: 1 + u[0] ** 2 / 2, 1.0, "along the interval length"),
    ],
)
def test_a_model_of_another_cost_is_refused(running: Any, factor: float, message: str) -> None:
    term = CostTerm("effort", lambda *points: factor * effort(*points), Where.NODE)
    problem = replace(cart(), running_cost=running, cost_terms=(term,))
    with pytest.raises(InvalidInputError, match=f"cost_terms effort: got 'gradient .*{message}"):
        Transcription(problem, 4, free_terminal_time=True)
    if "interval length" in message:  # which is no decision with a fixed terminal time
        Transcription(problem, 4, free_terminal_time=False)


def test_a_weight_that_is_zero_by_default_does_not_hide_a_model() -> None:
    weight = Parameter("weight", 0.0, "1", "", lower=0.0)
    terms = (
        CostTerm(
            "speed",
            lambda at, ref, p: (
                p["weight"] * (ref.step * at.x[1] ** 2 + (at.step - ref.step) * ref.x[1] ** 2)
            ),
            Where.NODE,
        ),
    )
    problem = cart_with(
        lambda x, u, p: p["weight"] * x[1] ** 2,
        parameters=(*cart().parameters, weight),
        cost_terms=terms,
    )
    assert Transcription(problem, 4).costs.models == {"speed"}


def test_a_running_cost_stands_at_nodes_or_at_means() -> None:
    def half(at: StagePoint, reference: StagePoint, p: Parameters) -> ca.SX:
        return effort(at, reference, p) / 2

    terms = (CostTerm("one", half, Where.NODE), CostTerm("other", half, Where.MEAN))
    with pytest.raises(InvalidInputError, match=r"cost_terms: got \['one', 'other'\]"):
        Transcription(replace(cart(), cost_terms=terms), 4)


def test_costs_that_cannot_be_evaluated_are_named() -> None:
    with pytest.raises(InvalidInputError, match=r"running_cost: .*24 points near the initial"):
        Transcription(cart_with(lambda x, u, p: ca.log(-1 - x[0] ** 2)), 4)


def test_a_cost_of_interval_means_does_not_let_the_controls_chatter() -> None:
    terms = (CostTerm("effort", effort, Where.MEAN),)
    scp, result = solved(replace(cart(), cost_terms=terms))
    forces = scp.transcription.layout.controls(result.final_reference)[:, 0]
    mean_forces = (forces[1:] + forces[:-1]) / 2
    # The part of the forces that no mean shows.
    signs = (-1.0) ** np.arange(forces.size)
    chatter = np.abs(np.sum(signs * forces)) / forces.size
    assert chatter < 0.01 * np.abs(forces).max()
    step = 2.0 / INTERVALS
    cost = step * np.sum(mean_forces**2) / 2
    assert result.iterations[-1].cost == pytest.approx(cost, rel=1e-12)
    for method in (unrolled, implicit):
        gradient = method(scp, result, CostLoss())
        assert gradient.trusted, gradient.reasons


def test_only_models_at_means_are_kept_from_chattering() -> None:
    def curvature(at: StagePoint, reference: StagePoint, p: Parameters) -> ca.SX:
        return (at.u[0] - reference.u[0]) ** 2

    problem = replace(cart(), cost_terms=(CostTerm("bend", curvature, Where.MEAN),))
    with_bend, without = (Transcription(q, 3) for q in (problem, cart()))
    parameters = cart().pack()
    reference = without.initial_guess(parameters)
    forces = [without.layout.control_index(n, 0) for n in range(4)]
    blocks = []
    for transcription in (with_bend, without):
        values = transcription.values(reference, parameters)
        upper = transcription.pattern.q.matrix(values.q).toarray()
        blocks.append(upper[np.ix_(forces, forces)])
    # Second derivative 2 of a mean, 1/4 of it each for two nodes and their product.
    expected = np.diag([1.0, 2.0, 2.0, 1.0]) / 2 + np.diag([0.5] * 3, 1)
    np.testing.assert_allclose(blocks[0] - blocks[1], expected * 3.0**2 / 2.0, atol=1e-12)


@settings(max_examples=60, deadline=None)
@given(
    size=st.integers(1, 6),
    rank=st.integers(1, 6),
    exponent=st.integers(-6, 6),
    seed=st.integers(0, 2**32 - 1),
    hollow=st.booleans(),
)
def test_convexified_matrices(size: int, rank: int, exponent: int, seed: int, hollow: bool) -> None:
    random = np.random.default_rng(seed)
    upper = ca.SX.sym("h", ca.Sparsity.upper(size))
    function = ca.Function("convexified", [upper], [convexified(ca.triu2symm(upper))])

    def result(matrix: Array) -> Array:
        return np.asarray(function(ca.DM(np.triu(matrix))).full())

    root = random.standard_normal((size, min(rank, size)))
    convex = 10.0**exponent * root @ root.T
    # What is convex stays as it is, singular or not.
    assert np.abs(result(convex) - convex).max() <= 1e-10 * np.abs(convex).max()
    other = random.standard_normal((size, size))
    other = 10.0**exponent * (other + other.T)
    if hollow:
        other -= np.diag(np.diag(other))
    found = result(other)
    largest = np.abs(other).max(initial=1e-300)
    assert np.isfinite(found).all()
    assert np.linalg.eigvalsh(found)[0] >= -1e-12 * largest
    assert np.abs(found).max() <= 10 * size**2 * largest


def test_very_many_coupled_variables_get_a_diagonal_that_exceeds_the_matrix() -> None:
    size = 50
    upper = ca.SX.sym("h", ca.Sparsity.upper(size))
    function = ca.Function("convexified", [upper], [convexified(ca.triu2symm(upper))])
    matrix = np.random.default_rng(0).standard_normal((size, size))
    matrix += matrix.T
    found = np.asarray(function(ca.DM(np.triu(matrix))).full())
    assert np.array_equal(found, np.diag(np.diag(found)))
    assert np.linalg.eigvalsh(found - matrix)[0] >= 0.0

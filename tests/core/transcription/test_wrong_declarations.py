"""What is refused when the functions of a declaration are called with symbols."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from core.toy_problems import cart

from dscp_core.cone.convexity import NotConvexError
from dscp_core.errors import InvalidInputError
from dscp_core.planning.certificate import PlanVerifier
from dscp_core.problem.declaration import (
    ConeConstraint,
    CostTerm,
    InitialGuess,
    Miss,
    OptimalControlProblem,
    PathConstraint,
    Where,
)
from dscp_core.problem.parameters import Parameter
from dscp_core.scp.scp import Scp, ScpStatus
from dscp_core.transcription.transcription import Transcription

CART = cart()
ELSEWHERE = ca.SX.sym("elsewhere")


def path(expression: Any) -> dict[str, Any]:
    return {"path_constraints": (PathConstraint("limit", expression, 1.0, "N"),)}


def cone(expression: Any) -> dict[str, Any]:
    return {"cone_constraints": (ConeConstraint("ball", expression, 1.0, "N"),)}


def dynamics(function: Any) -> dict[str, Any]:
    return {"dynamics": function}


def guess(states: Any, controls: Any = None) -> dict[str, Any]:
    def build(p: Any, intervals: int) -> InitialGuess:
        given = states(p, intervals) if callable(states) else states
        return InitialGuess(given, ca.MX(1, 5) if controls is None else controls)

    return {"initial_guess": build}


def bends(x: ca.SX, u: ca.SX, p: Any) -> ca.SX:
    return ca.vertcat(x[1], u[0]) if x[0] > 0 else x


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        # CasADi would broadcast the first to both states.
        (dynamics(lambda x, u, p: x[1]), r"dynamics: got 'shape \(1, 1\)'.*shape \(2, 1\)"),
        (dynamics(lambda x, u, p: ca.vertcat(x, u)), r"dynamics: got 'shape \(3, 1\)'"),
        (dynamics(lambda x, u, p: ca.horzcat(x[1], u[0])), r"dynamics: got 'shape \(1, 2\)'"),
        (dynamics(lambda x, u, p: None), "dynamics: got 'None', expected a casadi.SX"),
        (dynamics(lambda x, u, p: [x[1], u[0]]), "dynamics: got 'a list'"),
        (dynamics(lambda x, u, p: np.array([x[1], u[0]])), "dynamics: got 'a ndarray'"),
        (dynamics(lambda x, u, p: ca.MX(2, 1)), "dynamics: got 'a MX'"),
        (dynamics(lambda x, u, p: True), "dynamics: got 'a bool'"),
        (dynamics(lambda x, u: x), "dynamics: got 'TypeError: .*2 positional arguments"),
        (dynamics(bends), r"truth value .* at test_wrong_declarations.py:\d+'"),
        (dynamics(lambda x, u, p: ca.vertcat(x[1], u[1])), "dynamics: got 'RuntimeError: .*bounds"),
        (
            dynamics(lambda x, u, p: ca.vertcat(x[1], u[0] / p["weight"])),
            r"dynamics: got \"parameter 'weight' at test_wrong_declarations.py:\d+\", expected one "
            r"of terminal_time, start, target, mass, drag, force_max, trust_region",
        ),
        (
            dynamics(lambda x, u, p: ca.vertcat(x[1], u[0] + ELSEWHERE)),
            "dynamics: got 'elsewhere', expected symbols of its arguments only",
        ),
        (
            dynamics(lambda x, u, p: ca.vertcat(x[1], u[0] + math.sin(x[0]))),
            "dynamics: got 'a NaN constant', expected functions of casadi",
        ),
        ({"initial_state": lambda p: p["start"][0]}, "initial_state: got 'shape"),
        ({"initial_state": lambda p: 0.0}, "initial_state: got 'shape"),
        ({"final_state": {"speed": lambda p: None}}, "final_state speed: got 'None'"),
        ({"final_state": {"speed": lambda p: p["target"]}}, "final_state speed: got 'shape"),
        ({"running_cost": lambda x, u, p: x}, "running_cost: got 'shape"),
        ({"terminal_cost": lambda x, time, p: x[7]}, "terminal_cost: got 'RuntimeError"),
        (path(lambda at, p: at.x), r"constraint limit: got 'shape \(2, 1\)'"),
        (path(lambda at, p: p["limit"]), "constraint limit: got \"parameter 'limit'"),
        (cone(lambda at, p: at.u[0]), r"constraint ball: got 'shape \(1, 1\)'.*2 rows"),
        # It would be linearised without a word.
        (cone(lambda at, p: ca.vertcat(1.0, at.u[0] ** 2)), "constraint ball: .*row 1.*affine"),
        (cone(lambda at, p: ca.vertcat(at.x[0] * at.u[0], at.x)), "constraint ball: .*row 0"),
        ({"initial_guess": lambda p, intervals: None}, "initial_guess: got 'a NoneType'"),
        (guess(ca.MX(2, 4)), r"states of initial_guess: got 'shape \(2, 4\)'.*\(2, 5\)"),
        (guess(ca.MX(5, 2)), r"states of initial_guess: got 'shape \(5, 2\)'.*\(2, 5\)"),
        (guess(ca.MX(2, 5), ca.MX(2, 5)), r"controls of initial_guess: got 'shape \(2, 5\)'"),
        (guess([[0.0] * 5] * 2), "states of initial_guess: got 'a list'"),
        (guess(ca.SX(2, 5)), "states of initial_guess: got 'a SX'"),
        (guess(ca.MX.sym("start", 2, 5)), "initial_guess: got 'start'.*its arguments only"),
        (guess(lambda p, intervals: p["goal"]), "initial_guess: got \"parameter 'goal'"),
    ],
)
def test_refused_by_name(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        Transcription(replace(CART, **changes), 4)


PLACES: dict[str, Any] = {
    "dynamics": lambda f: {"dynamics": f},
    "initial_state": lambda f: {"initial_state": f},
    "final_state speed": lambda f: {"final_state": {"speed": f}},
    "running_cost": lambda f: {"running_cost": f},
    "terminal_cost": lambda f: {"terminal_cost": f},
    "constraint limit": path,
    "constraint ball": cone,
    "cost term bend": lambda f: {"cost_terms": (CostTerm("bend", f),)},
    "initial_guess": lambda f: {"initial_guess": f},
}
WRONG = (
    None,
    "text",
    [1.0, 2.0],
    {},
    object(),
    1j,
    math.nan,
    np.array(["a"]),
    np.ones((2, 2, 2)),
    ca.MX(2, 1),
    ca.SX(3, 7),
    ca.SX.sym("other", 2),
)
ERRORS = (
    ValueError("no"),
    ZeroDivisionError(),
    KeyError(),
    KeyError("a", 1),
    RecursionError("deep"),
)


@pytest.mark.parametrize("what", PLACES)
def test_whatever_a_function_does_it_is_named(what: str) -> None:
    for value in WRONG:
        with pytest.raises(InvalidInputError, match=what):
            Transcription(replace(CART, **PLACES[what](lambda *_, value=value: value)), 4)
    for error in ERRORS:

        def fails(*_: Any, error: Exception = error) -> None:
            raise error

        with pytest.raises(
            InvalidInputError, match=rf"{what}: got .*{type(error).__name__}"
        ) as why:
            Transcription(replace(CART, **PLACES[what](fails)), 4)
        assert why.value.__cause__ is error


@pytest.mark.parametrize(
    ("bounds", "message"),
    [
        (lambda p: 1.0, "terminal_time_bounds: got 'a float', expected two scalars"),
        (lambda p: (p["low"], 2.0), "terminal_time_bounds: got \"parameter 'low'"),
        (lambda p: (1.0, None), "second of terminal_time_bounds: got 'None'"),
    ],
)
def test_bounds_of_the_terminal_time(bounds: Any, message: str) -> None:
    problem = replace(CART, terminal_time_bounds=bounds)
    with pytest.raises(InvalidInputError, match=message):
        Transcription(problem, 4, free_terminal_time=True)


def test_cones_are_affine_in_the_interval_length_too() -> None:
    problem = replace(CART, **cone(lambda at, p: ca.vertcat(1.0, at.u * at.step)))
    Transcription(problem, 4, free_terminal_time=False)
    with pytest.raises(InvalidInputError, match=r"constraint ball: .*row 1"):
        Transcription(problem, 4, free_terminal_time=True)


def test_numbers_are_expressions_too() -> None:
    problem = replace(
        CART,
        initial_state=lambda p: np.zeros(2),
        final_state={"position": lambda p: 1, "speed": lambda p: np.float64(0.0)},
        terminal_cost=lambda x, time, p: 0.0,
    )
    transcription = Transcription(problem, 8)
    result = Scp(transcription).run(problem.pack())
    expected = Scp(Transcription(CART, 8)).run(CART.pack())
    assert result.iterations[-1].cost == pytest.approx(expected.iterations[-1].cost, rel=1e-12)


def test_misses_are_functions_too() -> None:
    miss = Miss("distance", lambda x, p: x, "m", 1.0)
    with pytest.raises(InvalidInputError, match=r"miss distance: got 'shape \(2, 1\)'"):
        PlanVerifier(replace(CART, misses=(miss,)), 4)


@pytest.mark.parametrize("intervals", [2.5, "4", None])
def test_intervals_are_a_whole_number(intervals: Any) -> None:
    with pytest.raises(InvalidInputError, match="intervals"):
        Transcription(CART, intervals)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_cost_terms_are_convex(sign: float) -> None:
    def curved(at: Any, reference: Any, p: Any) -> ca.SX:
        change = at.u[0] - reference.u[0]
        return sign * change**2 + 3 * change * (at.x[0] - reference.x[0])

    problem = replace(CART, cost_terms=(CostTerm("bent", curved, Where.NODE),))
    # Curvatures 2 s and 0, product 3; scales 3 and 2, cost in units of 2: (9 s - sqrt(405)) / 2.
    least = (9.0 * sign - math.sqrt(81.0 + 4 * 81.0)) / 2
    with pytest.raises(NotConvexError, match=f"cost term bent: .*eigenvalue {least:.3g} of"):
        Transcription(problem, 4)


def weighted(weight: float) -> OptimalControlProblem:
    return replace(
        CART,
        parameters=(*CART.parameters, Parameter("weight", weight, "1", "")),
        running_cost=lambda x, u, p: p["weight"] * u[0] ** 2,
    )


def test_a_weight_that_makes_the_cost_concave_is_refused_where_it_is_used() -> None:
    problem = weighted(1.0)
    scp = Scp(Transcription(problem, 4))
    assert scp.run(problem.pack()).status is ScpStatus.CONVERGED
    result = scp.run(problem.pack({"weight": -1.0}))
    assert not result.succeeded
    assert result.iterations == ()
    # T 2 w 3^2 / 2, before the quadrature's weights.
    named = "running_cost: got 'least eigenvalue -4.5 of its Hessian at node 0 (0 s)'"
    assert named in result.message


def test_trouble_at_the_reference_has_a_name_a_node_and_a_time() -> None:
    def message(**changes: Any) -> str:
        scp = Scp(Transcription(replace(CART, **changes), 4))
        result = scp.run(scp.transcription.table.pack())
        assert result.status is ScpStatus.DIVERGED
        assert result.iterations == ()
        return result.message

    # The guess goes from 0 to 1 in 2 s, its force is 0.
    root = message(**path(lambda at, p: ca.sqrt(0.6 - at.x[0]) - 2.0))
    assert "derivative of constraint limit: got 'nan at node 3 (1.5 s)', expected finite" in root
    norm = message(**path(lambda at, p: ca.norm_2(ca.vertcat(at.u, at.u)) - 2.0))
    assert "derivative of constraint limit: got 'nan at node 0 (0 s)'" in norm
    mean = message(dynamics=lambda x, u, p: ca.vertcat(x[1], ca.log(0.6 - x[0])))
    assert "dynamics: got 'nan in interval 2 (from 1 s)'" in mean
    cost = message(running_cost=lambda x, u, p: u[0] ** 2 + ca.sqrt(0.6 - x[0]))
    assert "running_cost: got 'nan at node 3 (1.5 s)'" in cost
    end = message(terminal_cost=lambda x, time, p: 1 / (x[0] - 1.0))
    assert "terminal_cost: got 'inf at the end (2 s)'" in end
    start = message(initial_state=lambda p: p["start"] / p["start"][0])
    assert "initial_state: got 'nan', expected finite" in start
    never = message(**path(lambda at, p: at.u[0] + math.inf))
    assert "constraint limit: got '-inf at node 0 (0 s)', expected a margin" in never


def test_a_guess_that_is_not_finite_is_named() -> None:
    problem = replace(
        CART,
        initial_guess=lambda p, intervals: InitialGuess(
            ca.MX(2, intervals + 1),
            ca.sqrt(ca.MX(ca.DM(np.linspace(1.0, -1.0, intervals + 1))).T),
        ),
    )
    scp = Scp(Transcription(problem, 4))
    with pytest.raises(InvalidInputError, match=r"force at node 3 of the problem's initial guess"):
        scp.run(problem.pack())
    reference = np.zeros(scp.transcription.layout.reference_size)
    reference[4] = np.inf
    with pytest.raises(InvalidInputError, match=r"speed at node 1 of initial_reference: got inf"):
        scp.run(problem.pack(), reference)


def test_an_unbounded_subproblem_says_what_lacks_a_bound() -> None:
    endless = tuple(
        replace(p, lower=-math.inf, upper=math.inf) if p.name == "terminal_time" else p
        for p in CART.parameters
    )
    problem = replace(
        CART,
        parameters=endless,
        running_cost=lambda x, u, p: u[0] ** 2 - 1,  # the longer, the better
        path_constraints=(),
    )
    scp = Scp(Transcription(problem, 4, free_terminal_time=True))
    result = scp.run(problem.pack())
    assert result.status is ScpStatus.SOLVER_FAILURE
    assert "it lacks a bound or a trust-region weight, above all for" in result.message


def chain(states: int, *, dense: bool) -> OptimalControlProblem:
    """States that each push the one before, or each all others."""
    matrix = ca.DM(np.random.default_rng(0).standard_normal((states, states)) / states)

    def rates(x: ca.SX, u: ca.SX, p: Any) -> ca.SX:
        push = ca.vertcat(ca.SX(states - 1, 1), u)
        return ca.mtimes(matrix, x) + push if dense else ca.vertcat(x[1:], u) - 0.1 * ca.sin(x)

    variable = CART.states[0]
    return replace(
        CART,
        states=tuple(replace(variable, name=f"x{n}") for n in range(states)),
        parameters=(CART.parameters[0], Parameter("start", (1.0,) * states, "m", "")),
        dynamics=rates,
        initial_state=lambda p: p["start"],
        final_state={},
        running_cost=lambda x, u, p: ca.sumsqr(x) + ca.sumsqr(u),
        path_constraints=(),
        initial_guess=lambda p, intervals: InitialGuess(
            ca.MX.ones(states, intervals + 1), ca.MX(1, intervals + 1)
        ),
    )


def test_500_states() -> None:
    problem = chain(500, dense=False)
    result = Scp(Transcription(problem, 4)).run(problem.pack())
    assert result.status is ScpStatus.CONVERGED, result.message
    with pytest.raises(InvalidInputError, match=r"Jacobian of dynamics: got 105802, .*100000"):
        Transcription(chain(230, dense=True), 4)


def test_a_problem_without_a_cost_needs_something_that_fixes_the_controls() -> None:
    feasibility = replace(CART, running_cost=None)
    for nothing in (feasibility, replace(CART, running_cost=lambda x, u, p: 0.0)):
        with pytest.raises(InvalidInputError, match=r"no cost at all.*trust_region_control.*force"):
            Transcription(nothing, 4)
    problem = replace(feasibility, trust_region_control=(1.0,))
    scp = Scp(Transcription(problem, 8))
    result = scp.run(problem.pack())
    assert result.status is ScpStatus.CONVERGED, result.message
    assert np.abs(result.iterations[-1].defects).max() < 1e-6
    prox = CostTerm("prox", lambda at, reference, p: (at.u[0] - reference.u[0]) ** 2, Where.NODE)
    Transcription(replace(feasibility, cost_terms=(prox,)), 4)

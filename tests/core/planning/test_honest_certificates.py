"""Declarations that could make a certificate say more than is true."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import casadi as ca
import pytest
from core.toy_problems import cart

from dscp_core.errors import InvalidInputError
from dscp_core.planning.plan import PlanOutcome, PlanStatus
from dscp_core.planning.planner import Planner, PlannerSettings
from dscp_core.problem.declaration import (
    Miss,
    OptimalControlProblem,
    PathConstraint,
    StagePoint,
    Where,
)


def plan(problem: OptimalControlProblem, intervals: int = 20) -> PlanOutcome:
    return Planner(problem, PlannerSettings.suited(problem, intervals=intervals)).plan()


def limited(**changes: Any) -> OptimalControlProblem:
    limit = PathConstraint("speed", lambda at, p: at.x[1] - 0.6, 1.0, "m/s", **changes)
    return replace(cart(), path_constraints=(limit,))


def test_a_constraint_at_interval_means_is_checked_along_the_flight() -> None:
    # On four intervals, 0.6 m/s in the means leaves more than that at a node.
    outcome = plan(limited(where=Where.MEAN), intervals=4)
    assert outcome.certificate is not None
    assert outcome.certificate.value("speed") > 0.01
    assert outcome.status is PlanStatus.NOT_CERTIFIED
    assert any(r.startswith("speed 0.19") for r in outcome.certificate.reasons)


def test_the_interval_length_in_a_constraint_is_the_plans() -> None:
    def duration(at: StagePoint, p: Any) -> ca.SX:
        return 20 * at.step - 1.5

    limit = PathConstraint("duration", duration, 1.0, "s")
    bounds = {"free_terminal_time": True, "terminal_time_bounds": lambda p: (0.5, 5.0)}
    outcome = plan(replace(cart(), path_constraints=(limit,), **bounds))
    assert outcome.certificate is not None
    assert outcome.certificate.value("duration") == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("off", [-1.0, 1.0])
def test_a_negative_miss_is_none(off: float) -> None:
    signed = Miss("position", lambda x, p: x[0] - p["target"][0] + off, "m", 0.01)
    outcome = plan(replace(cart(), misses=(signed,)))
    assert outcome.status is PlanStatus.NOT_CERTIFIED
    said = "is negative" if off < 0.0 else "exceeds 0.01"
    assert outcome.certificate is not None
    assert said in outcome.certificate.reasons[0]


def raising(values: Any) -> float:
    raise RuntimeError("no tolerance today")


@pytest.mark.parametrize(
    ("tolerance", "message"),
    [
        (raising, "no tolerance today"),
        (lambda values: values["nope"], "parameter 'nope'"),
        (lambda values: math.nan, "got nan, expected >= 0"),
        (lambda values: -1.0, "got -1.0, expected >= 0"),
        (lambda values: None, "got None, expected >= 0"),
        (lambda values: "1", "got '1', expected >= 0"),
        (lambda values: ca.SX.sym("a"), "got SX"),
    ],
)
def test_a_tolerance_that_is_no_number_is_refused_before_any_plan(
    tolerance: Callable[[Any], Any], message: str
) -> None:
    with pytest.raises(InvalidInputError, match=f"tolerance of constraint speed.*{message}"):
        Planner(limited(tolerance=tolerance))


def test_an_infinite_tolerance_certifies_nothing() -> None:
    with pytest.raises(InvalidInputError, match=r"tolerance of constraint speed: got inf"):
        plan(limited(tolerance=lambda values: math.inf))


@pytest.mark.parametrize("bounds", [(5.0, 1.0), (0.0, 5.0), (-1.0, 5.0)])
def test_bounds_of_the_terminal_time_in_the_wrong_order(bounds: tuple[float, float]) -> None:
    with pytest.raises(InvalidInputError, match=r"terminal_time_bounds.*0 < least <= greatest"):
        Planner(replace(cart(), terminal_time_bounds=lambda p: bounds))


def leaving(*_: Any) -> Any:
    raise SystemExit(0)


def test_functions_that_raise_are_named() -> None:
    refused = plan(replace(cart(), check_state=lambda state, values: 1 / 0))
    assert refused.status is PlanStatus.INVALID_STATE
    assert "check_state: got 'ZeroDivisionError" in refused.message
    with pytest.raises(InvalidInputError, match="dynamics: got 'SystemExit"):
        Planner(replace(cart(), dynamics=leaving))
    unreachable = replace(
        cart(),
        path_constraints=(PathConstraint("never", lambda at, p: 1.0, 1.0, "1"),),
        free_terminal_time=True,
        terminal_time_bounds=lambda p: (0.5, 5.0),
    )
    for guess, message in ((leaving, "SystemExit"), (lambda state, values: math.nan, "nan")):
        with pytest.raises(InvalidInputError, match=f"terminal_time_guess: got .*{message}"):
            plan(replace(unreachable, terminal_time_guess=guess))

"""One honest line about every plan."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest

from dscp_core import Planner, PlannerSettings, PlanStatus, ScpOptions, problems
from dscp_core.scp.stopping import StoppingRule
from dscp_core.scp.trace import ScpStatus


def planner(**options: object) -> Planner:
    problem = problems.get("powered_descent")
    return Planner(problem, PlannerSettings(options=ScpOptions(**options)))  # type: ignore[arg-type]


def test_a_certified_converged_plan_says_both() -> None:
    outcome = planner().plan()
    assert outcome.certified
    assert outcome.converged
    assert re.fullmatch(
        r"certified, converged: terminal time 32.81 s \(fixed\), cost -31760.37 kg, "
        r"at most 0\.\d+ kg to gain",
        outcome.headline,
    )


def test_a_certified_plan_at_the_iteration_limit_says_that_it_is_not_converged() -> None:
    outcome = planner(max_iterations=4).plan()
    assert outcome.status is PlanStatus.CERTIFIED
    assert outcome.stopped is ScpStatus.ITERATION_LIMIT
    assert not outcome.converged
    assert outcome.headline.startswith("certified, NOT CONVERGED (iteration limit): ")
    assert re.search(r", cost -31760\.\d+ kg, at most [\d.]+ kg to gain$", outcome.headline)


@pytest.mark.parametrize(
    ("gain", "words"),
    [
        (None, "unknown how much to gain"),
        (0.9951, "at most 1 kg to gain"),
        (0.00331, "at most 0.0034 kg to gain"),
        (292.3, "at most 300 kg to gain"),
        (12345.0, "at most 13000 kg to gain"),
    ],
)
def test_what_is_to_gain_is_rounded_up(gain: float | None, words: str) -> None:
    assert replace(planner().plan(), cost_to_gain=gain).headline.endswith(f" kg, {words}")


def test_where_nothing_is_feasible_what_is_to_gain_is_unknown() -> None:
    outcome = Planner(problems.get("powered_descent"), parameters={"terminal_time": 31.0}).plan()
    assert outcome.plan is not None
    assert outcome.cost_to_gain is None
    assert planner().plan(deadline_s=1e-4).cost_to_gain is None


def test_a_fixed_number_of_iterations_is_no_convergence() -> None:
    outcome = planner(fixed_iterations=12).plan()
    assert outcome.certified
    assert not outcome.converged
    assert "convergence NOT TESTED" in outcome.headline


@pytest.mark.parametrize("limit", [1, 2, 3])
def test_the_rule_of_the_paper_cannot_make_it_lie(limit: int) -> None:
    # So loose that the first iteration ends it, where the dynamics do not hold yet.
    outcome = planner(
        stopping=StoppingRule.COST_CHANGE, cost_tolerance=1.0, max_iterations=limit
    ).plan()
    assert outcome.stopped is ScpStatus.CONVERGED or not outcome.converged
    assert outcome.max_defect <= 1e-5 or not outcome.converged
    assert outcome.converged or ", converged" not in outcome.headline


def test_an_infeasible_case_is_not_called_a_plan() -> None:
    outcome = Planner(problems.get("powered_descent"), parameters={"terminal_time": 31.0}).plan()
    assert outcome.status is PlanStatus.INFEASIBLE
    assert not outcome.converged
    assert outcome.headline.startswith("INFEASIBLE: ")
    assert "\n" not in replace(outcome, message="two\nlines").headline


def test_a_refused_state_has_no_iterations() -> None:
    made = planner()
    state = made.initial_state.copy()
    state[0] = -50.0
    outcome = made.plan(state)
    assert outcome.stopped is None
    assert outcome.headline.startswith("NO PLAN (invalid state): x: got")


def test_a_deadline_is_named() -> None:
    outcome = planner().plan(deadline_s=1e-4)
    assert not outcome.converged
    assert outcome.headline.startswith("NO PLAN (deadline): ")


def test_the_outcome_says_what_it_was_planned_with() -> None:
    made = planner()
    state = made.initial_state.copy()
    state[6] = 37000.0
    outcome = made.plan(state)
    assert outcome.parameters["initial_mass"] == 37000.0
    assert outcome.parameters["terminal_time"] == 32.81
    assert outcome.cost_unit == "kg"

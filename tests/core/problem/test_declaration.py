from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from core.toy_problems import cart

from dscp_core import problems
from dscp_core.errors import InvalidInputError
from dscp_core.problem.declaration import CostTerm, OptimalControlProblem, Variable
from dscp_core.transcription.transcription import Transcription


@pytest.mark.parametrize("scale", [0.0, -1.0, float("nan")])
def test_scale_is_positive(scale: float) -> None:
    with pytest.raises(InvalidInputError, match="scale of mass"):
        Variable("mass", "kg", scale, "")


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("virtual_control_scale", (1.0,)),
        ("trust_region_state", (1.0, 1.0, 1.0)),
        ("trust_region_control", (1.0, 1.0)),
        ("control_states", (0, 1)),
    ],
)
def test_sizes_fit_states_and_controls(field: str, value: tuple[float, ...]) -> None:
    changes: dict[str, Any] = {field: value}
    with pytest.raises(InvalidInputError, match=field) as caught:
        replace(cart(), **changes)
    assert caught.value.value == value


def test_final_state_names_a_state() -> None:
    final: Mapping[str, Any] = {"height": lambda p: p["target"][0]}
    with pytest.raises(InvalidInputError, match="height"):
        replace(cart(), final_state=final)


def test_terminal_time_is_a_parameter() -> None:
    others = tuple(p for p in cart().parameters if p.name != "terminal_time")
    with pytest.raises(InvalidInputError, match="terminal_time"):
        replace(cart(), parameters=others)


def test_algorithm_parameters_come_last_and_take_the_declared_defaults() -> None:
    problem = replace(
        cart(), trust_region_state=(1.0, 2.0), trust_region_step=3.0, virtual_control_weight=4.0
    )
    assert problem.table.names[-3:] == (
        "trust_region_state",
        "trust_region_control",
        "trust_region_step",
    )
    np.testing.assert_array_equal(problem.table.pack()[-4:], [1.0, 2.0, 0.0, 3.0])
    relaxed = replace(problem, virtual_control_scale=(0.0, 1.0))
    assert relaxed.table.names[-1] == "virtual_control_weight"
    assert relaxed.table.pack()[-1] == 4.0
    with pytest.raises(InvalidInputError, match="trust_region_state"):
        relaxed.table.pack({"trust_region_state": [-1.0, 0.0]})


def test_cost_terms_are_quadratic() -> None:
    quartic = CostTerm("effort", lambda at, reference, p: (at.u[0] - reference.u[0]) ** 4)
    with pytest.raises(InvalidInputError, match="cost term effort"):
        Transcription(replace(cart(), cost_terms=(quartic,)), 4)


@pytest.mark.parametrize("intervals", [1, 0, -3])
def test_least_number_of_intervals(intervals: int) -> None:
    with pytest.raises(InvalidInputError, match="intervals"):
        Transcription(cart(), intervals)


def test_problems_by_name() -> None:
    assert problems.names() == ("powered_descent", "entry")
    assert problems.formulations("entry") == ("quadratic", "printed_per_second", "printed")
    assert problems.formulations("powered_descent") == ("convergent", "printed")
    default, named = problems.get("powered_descent"), problems.get("powered_descent", "convergent")
    assert [c.name for c in default.cone_constraints] == [c.name for c in named.cone_constraints]
    with pytest.raises(InvalidInputError, match="problem: got 'ascent'"):
        problems.get("ascent")
    with pytest.raises(InvalidInputError, match="one of convergent, printed"):
        problems.get("powered_descent", "fast")


@pytest.mark.parametrize(
    ("name", "formulation"), [(n, f) for n in problems.names() for f in problems.formulations(n)]
)
def test_problems_declare_units_and_sources(name: str, formulation: str) -> None:
    problem: OptimalControlProblem = problems.get(name, formulation)
    assert all(p.unit and p.description for p in problem.table.parameters)
    assert all(p.source for p in problem.parameters)
    assert all(v.unit and v.scale > 0.0 for v in (*problem.states, *problem.controls))
    for p in problem.table.parameters:
        p.validate(p.default)
    nx, nu = len(problem.states), len(problem.controls)
    x, u = ca.SX.sym("x", nx), ca.SX.sym("u", nu)
    values = problem.table.unpack(problem.table.pack())
    rates = problem.dynamics(x, u, values)
    assert rates.shape == (nx, 1)
    # Each control acts on its own state.
    acts = ca.DM(ca.jacobian(rates, u).sparsity(), 1).full()
    assert all(acts[state, i] for i, state in enumerate(problem.control_states))

"""What is refused when a declaration is made."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import casadi as ca
import pytest
from core.toy_problems import cart

from dscp_core.errors import InvalidInputError
from dscp_core.problem.declaration import (
    ConeConstraint,
    CostTerm,
    Miss,
    PathConstraint,
    Variable,
)
from dscp_core.problem.extras import Extras
from dscp_core.problem.parameters import Parameter
from dscp_core.problem.tracing import known_values

CART = cart()


def limit(name: str = "limit", scale: Any = 1.0, **changes: Any) -> PathConstraint:
    return PathConstraint(name, lambda at, p: at.u[0], scale, "N", **changes)


def cone(name: str) -> ConeConstraint:
    return ConeConstraint(name, lambda at, p: ca.vertcat(1.0, at.u), 1.0, "N")


def term(name: str) -> CostTerm:
    return CostTerm(name, lambda at, reference, p: at.u[0] - reference.u[0])


def parameters(*more: Parameter, without: str = "") -> tuple[Parameter, ...]:
    return (*(p for p in CART.parameters if p.name != without), *more)


@pytest.mark.parametrize("scale", [0.0, -1.0, math.nan, math.inf, "1", None, True])
def test_scales_are_positive_numbers(scale: Any) -> None:
    makers: tuple[Callable[[], Any], ...] = (
        lambda: Variable("force", "N", scale, ""),
        lambda: limit("force", scale),
        lambda: ConeConstraint("force", lambda at, p: at.x, scale, "N"),
    )
    for make in makers:
        with pytest.raises(InvalidInputError, match=r"scale of (constraint )?force.*> 0") as caught:
            make()
        assert caught.value.value is scale


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Variable("", "m", 1.0, ""), "name of a variable: got ''"),
        (lambda: Variable(3, "m", 1.0, ""), "name of a variable: got 3"),  # type: ignore[arg-type]
        (lambda: Variable("x", None, 1.0, ""), "unit of x: got None"),  # type: ignore[arg-type]
        (lambda: Parameter("mass", 1.0, 3, ""), "unit of parameter mass"),  # type: ignore[arg-type]
        (lambda: Parameter("mass", 1.0, "kg", "", 2.0, 0.0), "lower of parameter mass: got 2.0"),
        (lambda: limit(where="node"), "where of constraint limit: got 'node', expected of type W"),
        (lambda: limit(skip_first="no"), "skip_first of constraint limit: got 'no'"),
        (lambda: CostTerm("drag", term("t").expression, "node"), "where of cost term drag"),  # type: ignore[arg-type]
        (lambda: Miss("m\tm", lambda x, p: x[0], "m", 1.0), r"name of a miss: got 'm\\tm'"),
        (lambda: Extras(figure=3), "figure of extras: got 3, expected a function"),  # type: ignore[arg-type]
        (lambda: Extras(guidance=3), "guidance of extras: got 3, expected a function"),  # type: ignore[arg-type]
        (lambda: Extras(messages=3), "messages of extras: got 3, expected of"),  # type: ignore[arg-type]
    ],
)
def test_parts_of_another_type_are_refused(make: Callable[[], Any], message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        make()


def test_tolerances_are_not_negative() -> None:
    with pytest.raises(InvalidInputError, match=r"tolerance of constraint force: got -1"):
        limit("force", tolerance=-1.0)
    with pytest.raises(InvalidInputError, match=r"tolerance of miss distance: got nan"):
        Miss("distance", lambda x, p: x[0], "m", math.nan)
    grows = limit(tolerance=lambda values: values["mass"])
    assert grows.accepted(CART.table, known_values(CART.table, CART.pack({"mass": 3.0}))) == 3.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"states": (CART.states[0],) * 2}, "states and controls: got 'position'"),
        ({"controls": (Variable("speed", "m", 1.0, ""),)}, "states and controls: got 'speed'"),
        ({"parameters": (*CART.parameters, CART.parameters[3])}, r"parameters: got \['mass'\]"),
        (
            {"parameters": parameters(Parameter("trust_region_state", 1.0, "1", ""))},
            r"parameters: got \['trust_region_state'\]",
        ),
        ({"cone_constraints": (cone("force_max"),)}, "constraints and misses: got 'force_max'"),
        (
            {"misses": (Miss("force_max", lambda x, p: x[0], "m", 1.0),)},
            "constraints and misses: got 'force_max'",
        ),
        ({"path_constraints": (limit("terminal_time"),)}, "constraints: got 'terminal_time'"),
        ({"cost_terms": (term("prox"), term("prox"))}, "cost_terms: got 'prox'"),
        ({"cost_terms": (term("running_cost"),)}, "cost_terms: got 'running_cost'.*reserved"),
        ({"states": ()}, r"states: got \(\), expected at least one Variable"),
        ({"controls": ()}, r"controls: got \(\), expected at least one Variable"),
        ({"states": CART.states[0]}, "states: got Variable.*a tuple of Variable"),
        ({"states": ("position", "speed")}, r"states\[0\]: got 'position', expected a Variable"),
        ({"path_constraints": (cone("c"),)}, r"path_constraints\[0\].*a PathConstraint"),
        ({"cone_constraints": (limit(),)}, r"cone_constraints\[0\].*a ConeConstraint"),
        ({"dynamics": None}, "dynamics: got None, expected a function"),
        ({"running_cost": 1.0}, r"running_cost: got 1.0, expected a function"),
        ({"final_state": {"speed": 0.0}}, r"final_state speed: got 0.0, expected a function"),
        ({"final_state": ("speed",)}, r"final_state: got \('speed',\), expected a mapping"),
        ({"parameters": parameters(without="terminal_time")}, "got 'terminal_time'"),
        (
            {
                "parameters": parameters(
                    Parameter("terminal_time", 0.0, "s", ""), without="terminal_time"
                )
            },
            r"terminal_time: got 0.0, expected > 0",
        ),
        (
            {
                "parameters": parameters(
                    Parameter("terminal_time", (1.0, 2.0), "s", ""), without="terminal_time"
                )
            },
            r"terminal_time: got \(1.0, 2.0\), expected a number",
        ),
        (
            {"parameters": parameters(Parameter("wind", math.nan, "m/s", ""))},
            "wind: got nan, expected finite",
        ),
        (
            {"parameters": parameters(Parameter("wind", 3.0, "m/s", "", upper=2.0))},
            r"wind: got 3.0, expected \[-inf, 2\] m/s",
        ),
        ({"initial_state_parameters": ("start", "mass")}, "2 components, one per state, not 3"),
        ({"initial_state_parameters": ("start", "start")}, "each name once"),
        ({"initial_state_parameters": ("begin",)}, "got 'begin', expected a known name"),
        ({"least_time_parameters": {"weight": 1.0}}, "got 'weight', expected a known name"),
        ({"control_states": (2,)}, r"control_states: got \[2\], expected \[0, 1\]"),
        ({"control_states": (1.0,)}, r"control_states: got \[1.0\], expected \[0, 1\]"),
        ({"initial_state_parameters": "start"}, "got 'start', expected a tuple of str"),
        ({"name": ""}, "name: got '', expected text in one line"),
        ({"name": "two\nlines"}, r"name: got 'two\\nlines', expected text in one line"),
        ({"name": None}, "name: got None, expected of type str"),
        ({"cost_unit": None}, "cost_unit: got None, expected of type str"),
        ({"quadrature": "trapezoid"}, "quadrature: got 'trapezoid', expected of type Quadrature"),
        ({"free_terminal_time": "no"}, "free_terminal_time: got 'no', expected of type bool"),
        ({"extras": 3}, "extras: got 3, expected of type Extras"),
        ({"vehicle_tables": 3}, "vehicle_tables: got 3, expected a mapping"),
        ({"vehicle_tables": {"table": 3}}, "vehicle_tables table: got 3, expected a function"),
        ({"least_time_parameters": ["mass"]}, "least_time_parameters: got .*, expected a mapping"),
        ({"cost_scale": 0.0}, "cost_scale: got 0.0, expected > 0"),
        ({"cost_magnitude": -1.0}, "cost_magnitude: got -1.0, expected > 0"),
        ({"cost_tolerance": math.inf}, "cost_tolerance: got inf, expected > 0"),
        ({"trust_region_control": (-1.0,)}, r"trust_region_control\[0\]: got -1.0"),
        ({"trust_region_step": -1.0}, "trust_region_step: got -1.0"),
        ({"virtual_control_scale": (1.0, -1.0)}, r"virtual_control_scale\[1\]: got -1.0"),
        ({"virtual_control_scale": (1.0, 1.0)}, "virtual_control_weight: got 0.0, expected > 0"),
        ({"default_intervals": 1}, "default_intervals: got 1, expected >= 2"),
    ],
)
def test_refused_by_name(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        replace(CART, **changes)


def test_lists_will_do() -> None:
    problem = replace(CART, states=list(CART.states), trust_region_state=[1.0, 2.0])
    assert problem.states == CART.states
    assert problem.trust_region_state == (1.0, 2.0)


def test_infinite_values_are_for_parameters_that_may_be_infinite() -> None:
    bound = Parameter("speed_max", math.inf, "m/s", "", infinite=True)
    problem = replace(CART, parameters=parameters(bound))
    assert problem.pack()[problem.table.slice("speed_max")] == math.inf
    with pytest.raises(InvalidInputError, match="speed_max: got nan, expected no NaN"):
        problem.pack({"speed_max": math.nan})
    with pytest.raises(InvalidInputError, match="speed_max: got inf, expected finite"):
        replace(CART, parameters=parameters(replace(bound, infinite=False)))

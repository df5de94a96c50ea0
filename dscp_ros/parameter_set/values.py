"""The node's parameters in a set: checked as the node itself checks them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dscp_core import problems
from dscp_core.planning.planner import PlannerSettings
from dscp_core.problem.declaration import OptimalControlProblem
from dscp_ros.planner.declaration import NodeParameter
from dscp_ros.planner.parameter_files import check_parameter_names, read_file
from dscp_ros.planner.parameters import (
    PROBLEM,
    NodeSettings,
    formulation_parameter,
    node_settings,
    parameter_table,
)

NODE = "/planner"
"""Any name will do: the section of a set is for every node."""


@dataclass(frozen=True)
class CheckedValues:
    """Values of a parameter file and what they mean.

    Attributes:
        problem: The problem that they chose.
        formulation: Its formulation.
        given: The values, by flat name.
        values: The same with the node's defaults where none is given.
        settings: Settings of the node that has them, the defaults elsewhere.
    """

    problem: OptimalControlProblem
    formulation: str
    given: Mapping[str, Any]
    values: Mapping[str, Any]
    settings: NodeSettings

    @property
    def planner(self) -> PlannerSettings:
        """Settings of the planner."""
        return self.settings.planner

    @property
    def parameters(self) -> dict[str, Any]:
        """Every parameter of the problem by name, SI, in the core's axes."""
        return dict(self.problem.table.unpack(self.problem.pack(self.planner.parameters)))

    @property
    def vehicle(self) -> dict[str, float | list[float]]:
        """Those of them that fix the optimum."""
        return self.problem.vehicle_of(self.parameters)


def read_values(path: Path) -> CheckedValues:
    """Values of one parameter file.

    Raises:
        InvalidInputError: The file is unreadable, or a name, type or value is wrong.
    """
    return check_values(read_file(str(path), NODE))


def check_values(given: Mapping[str, Any]) -> CheckedValues:
    """Check names, types, bounds, and what the problem makes of the values together.

    Args:
        given: Node parameters by flat name, in message axes.

    Raises:
        InvalidInputError: A name, type or value is wrong.
    """
    chosen = _checked(PROBLEM, given)
    formulation = formulation_parameter(chosen)
    problem = problems.get(chosen, _checked(formulation, given))
    table = {p.name: p for p in (PROBLEM, formulation, *parameter_table(problem))}
    check_parameter_names(list(given), list(table))
    values = {name: _checked(parameter, given) for name, parameter in table.items()}
    settings = node_settings(problem, values)
    return CheckedValues(problem, values[formulation.name], dict(given), values, settings)


def _checked(parameter: NodeParameter, given: Mapping[str, Any]) -> Any:
    value = given.get(parameter.name, parameter.default)
    parameter.check_type(value)
    parameter.check(value)
    return value

"""The node's parameters in a set: checked as the node itself checks them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dscp_core.errors import InvalidInputError
from dscp_core.planning.planner import PlannerSettings
from dscp_core.problem.declaration import OptimalControlProblem
from dscp_ros.planner.choice import ProblemChoice, is_file
from dscp_ros.planner.declaration import NodeParameter
from dscp_ros.planner.parameter_files import check_parameter_names, read_file
from dscp_ros.planner.parameters import (
    FORMULATION,
    PROBLEM,
    NodeSettings,
    formulation_parameters,
    node_settings,
    parameter_table,
)

NODE = "/planner"
"""Any name will do: the section of a set is for every node."""


@dataclass(frozen=True)
class CheckedValues:
    """Values of a parameter file and what they mean.

    Attributes:
        choice: The problem that they chose.
        problem: Its declaration.
        formulation: Its formulation; empty where there is one form only.
        given: The values, by flat name.
        values: The same with the node's defaults where none is given.
        settings: Settings of the node that has them, the defaults elsewhere.
    """

    choice: ProblemChoice
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
    def vehicle(self) -> dict[str, Any]:
        """Those of them that fix the optimum."""
        return self.problem.vehicle_of(self.parameters)


def read_values(path: Path, problem: Any, choice: ProblemChoice | None = None) -> CheckedValues:
    """Values of the parameter file of a set.

    Args:
        path: The file.
        problem: Name of the problem by the set's provenance.
        choice: The problem where the file names none, as that of a problem from a Python file.

    Raises:
        InvalidInputError: The file is unreadable, a name, type or value is wrong, it names a Python
            file, or its problem is another one.
    """
    given = read_file(str(path), NODE)
    bound = f"{problem!r}, as in the provenance"
    if PROBLEM.name in given:
        refuse_file(given[PROBLEM.name])
        choice = ProblemChoice.read(_checked(PROBLEM, given))
    else:
        choice = choice or ProblemChoice.read(str(PROBLEM.default))
        bound += "; the set names no problem, so name it where you use the set"
    if choice.name != problem:
        raise InvalidInputError(PROBLEM.name, choice.name, bound)
    return check_values(given, choice)


def refuse_file(problem: Any) -> None:
    """Refuse data that name code to run.

    Raises:
        InvalidInputError: The name of a problem is that of a Python file.
    """
    if is_file(str(problem)):
        raise InvalidInputError(
            PROBLEM.name, problem, "a known name: a parameter set does not name a file to run"
        )


def check_values(given: Mapping[str, Any], choice: ProblemChoice | None = None) -> CheckedValues:
    """Check names, types, bounds, and what the problem makes of the values together.

    Args:
        given: Node parameters by flat name, in message axes.
        choice: The problem, if it was chosen already; else the values do.

    Raises:
        InvalidInputError: A name, type or value is wrong.
    """
    choice = choice or ProblemChoice.read(_checked(PROBLEM, given))
    forms = formulation_parameters(choice.family.formulations)
    formulation = "".join(_checked(parameter, given) for parameter in forms)
    problem = choice.make(formulation)
    table = {p.name: p for p in (PROBLEM, *forms, *parameter_table(problem))}
    check_parameter_names(list(given), list(table))
    values = {name: _checked(parameter, given) for name, parameter in table.items()}
    settings = node_settings(problem, values)
    return CheckedValues(choice, problem, formulation, dict(given), values, settings)


def chosen_names(choice: ProblemChoice, formulation: str) -> dict[str, str]:
    """Node parameters that say in a set which problem it is for.

    A problem from a Python file is named where the set is used, never in the set.
    """
    names = {} if choice.is_file else {PROBLEM.name: choice.text}
    return {**names, FORMULATION: formulation} if formulation else names


def _checked(parameter: NodeParameter, given: Mapping[str, Any]) -> Any:
    value = given.get(parameter.name, parameter.default)
    parameter.check_type(value)
    parameter.check(value)
    return value

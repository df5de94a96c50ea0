"""Declares the parameters on the node, guards their changes, and hands out settings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.exceptions import (
    InvalidParameterTypeException,
    InvalidParameterValueException,
    ParameterUninitializedException,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from dscp_core import problems
from dscp_core.errors import InvalidInputError
from dscp_ros.planner.parameter_files import (
    ParameterArguments,
    check_node_names,
    check_parameter_names,
    read_parameters,
)
from dscp_ros.planner.parameters import (
    PROBLEM,
    NodeParameter,
    NodeSettings,
    formulation_parameter,
    node_settings,
    parameter_table,
)


@dataclass(frozen=True)
class FileChange:
    """Content of the parameter files, checked but not taken over.

    Attributes:
        settings: Settings that would result.
        values: Values that would be set.
    """

    settings: NodeSettings
    values: Mapping[str, Any]


class ParameterServer:
    """The node's parameters.

    Attributes:
        problem: Declaration of the problem that the parameters chose.
        settings: Settings of the current values; replaced as a whole when a value changes.
    """

    def __init__(self, node: Node, arguments: ParameterArguments) -> None:
        """Declare every parameter and read its first value.

        Args:
            node: Node to declare them on.
            arguments: Where the node's command line takes parameters from.

        Raises:
            InvalidInputError: A misspelt node or parameter name, or a bad value.
        """
        self._node = node
        self._arguments = arguments
        check_node_names(arguments, node.get_fully_qualified_name())
        self._table: dict[str, NodeParameter] = {}
        problem_name = self._declare(PROBLEM)
        self._formulation = self._declare(formulation_parameter(problem_name))
        self.problem = problems.get(problem_name, self._formulation)
        for parameter in parameter_table(self.problem):
            self._declare(parameter)
        # rclpy offers no public way to what the command line and files gave; it ignores names
        # that are not declared.
        given: Mapping[str, Any] = node._parameter_overrides
        check_parameter_names(list(given), list(node.get_parameters_by_prefix("")))
        self.settings = self._settings_of(self._values())
        self._on_change: Callable[[NodeSettings], None] | None = None
        node.add_on_set_parameters_callback(self._validate)
        node.add_post_set_parameters_callback(self._apply)

    def on_change(self, callback: Callable[[NodeSettings], None]) -> None:
        """Call back with the new settings whenever a parameter has changed."""
        self._on_change = callback

    def reread_files(self) -> FileChange:
        """What the parameter files hold now; nothing is changed yet.

        Raises:
            InvalidInputError: A file or value is bad, or it changes a read-only parameter.
        """
        given = read_parameters(self._arguments, self._node.get_fully_qualified_name())
        check_parameter_names(list(given), list(self._node.get_parameters_by_prefix("")))
        current = self._values()
        read = {name: value for name, value in given.items() if name in self._table}
        for name, value in read.items():
            parameter = self._table[name]
            _check_type(parameter, value)
            if parameter.read_only and value != current[name]:
                raise InvalidInputError(name, value, f"read-only, {current[name]!r}: restart")
        return FileChange(
            settings=self._settings_of(self._merged(read)),
            values={n: v for n, v in read.items() if not self._table[n].read_only},
        )

    def commit(self, change: FileChange) -> None:
        """Take over what the parameter files hold.

        Raises:
            InvalidInputError: A parameter was refused after all.
        """
        if not change.values:
            return
        result = self._node.set_parameters_atomically(
            [Parameter(name, value=value) for name, value in change.values.items()]
        )
        if not result.successful:
            raise InvalidInputError("parameter files", self._arguments.files, result.reason)

    def _declare(self, parameter: NodeParameter) -> Any:
        """Declare one parameter and return its checked value."""
        try:
            self._node.declare_parameter(parameter.name, parameter.default, parameter.descriptor())
            value = _plain(self._node.get_parameter(parameter.name).value)
        except InvalidParameterTypeException as error:
            given = self._node._parameter_overrides[parameter.name].value
            raise InvalidInputError(parameter.name, given, _type_text(parameter)) from error
        except InvalidParameterValueException as error:
            given = self._node._parameter_overrides[parameter.name].value
            bound = f"[{parameter.lower:g}, {parameter.upper:g}] {parameter.unit}".rstrip()
            raise InvalidInputError(parameter.name, given, bound) from error
        except ParameterUninitializedException:
            value = None
        parameter.check(value)
        self._table[parameter.name] = parameter
        return value

    def _values(self) -> dict[str, Any]:
        return {name: _plain(self._node.get_parameter(name).value) for name in self._table}

    def _merged(self, changes: Mapping[str, Any]) -> dict[str, Any]:
        """Current values with changes, which have to pass their own checks.

        Raises:
            InvalidInputError: A value is out of bounds.
        """
        known = {name: _plain(value) for name, value in changes.items() if name in self._table}
        for name, value in known.items():
            self._table[name].check(value)
        return self._values() | known

    def _settings_of(self, values: Mapping[str, Any]) -> NodeSettings:
        return node_settings(self.problem, self._formulation, values)

    def _validate(self, changes: Sequence[Parameter]) -> SetParametersResult:
        """Accept or refuse a set of changes as a whole; the reason names the parameter."""
        try:
            self._settings_of(self._merged({p.name: p.value for p in changes}))
        except InvalidInputError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply(self, _changes: Sequence[Parameter]) -> None:
        self.settings = self._settings_of(self._values())
        if self._on_change is not None:
            self._on_change(self.settings)


def _check_type(parameter: NodeParameter, value: Any) -> None:
    """Check a YAML value's type as rcl does at the start.

    Raises:
        InvalidInputError: The type is not that of the default.
    """
    same = type(value) is type(parameter.default)
    if isinstance(value, list):
        same = same and all(type(item) is float for item in value)
    if not same:
        raise InvalidInputError(parameter.name, value, _type_text(parameter))


def _plain(value: Any) -> Any:
    """Python numbers and lists in place of the arrays that rclpy returns."""
    return value if isinstance(value, str | bool | int | float | None) else list(value)


def _type_text(parameter: NodeParameter) -> str:
    default = parameter.default
    if isinstance(default, bool):
        return "true or false"
    if isinstance(default, int):
        return "a whole number"
    if isinstance(default, float):
        return "a number with a point, such as 1.0"
    if isinstance(default, str):
        return "a text"
    return f"{len(default)} numbers, each with a point, such as 1.0"

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

from dscp_core.errors import DscpError, InvalidInputError
from dscp_core.planning.planner import TerminalTime
from dscp_core.problem.declaration import OptimalControlProblem
from dscp_ros.planner.choice import ProblemChoice, is_file
from dscp_ros.planner.declaration import NodeParameter
from dscp_ros.planner.parameter_files import (
    ParameterArguments,
    check_node_names,
    check_parameter_names,
)
from dscp_ros.planner.parameter_sources import ParameterSources, named_problem, read_sources
from dscp_ros.planner.parameters import (
    NETWORK,
    PROBLEM,
    NodeSettings,
    formulation_parameters,
    node_settings,
    parameter_table,
)
from dscp_ros.planner.predictors import Predictors
from dscp_ros.planner.session import PlannerSetup


@dataclass(frozen=True)
class FileChange:
    """Content of the parameter files, checked but not taken over.

    Attributes:
        setup: What the planner would be made of.
        values: Values that would be set.
        origin: Where they come from.
    """

    setup: PlannerSetup
    values: Mapping[str, Any]
    origin: _Origin


@dataclass(frozen=True)
class _Origin:
    """What was read of the files, and of the networks that they name."""

    sources: ParameterSources
    predictors: Predictors


Own = Callable[[OptimalControlProblem], Sequence[NodeParameter]]
"""Parameters that a node has beside the planner's."""


def _no_more(_problem: OptimalControlProblem) -> Sequence[NodeParameter]:
    return ()


class ParameterServer:
    """The node's parameters.

    Attributes:
        problem: Declaration of the problem that the parameters chose.
        settings: Settings of the current values; replaced as a whole when a value changes.
        setup: What the planner is made of by these settings; likewise.
    """

    def __init__(self, node: Node, arguments: ParameterArguments, own: Own = _no_more) -> None:
        """Declare every parameter and read its first value.

        Args:
            node: Node to declare them on.
            arguments: Where the node's command line takes parameters from.
            own: What the node has beside the planner's.

        Raises:
            InvalidInputError: A misspelt node or parameter name, or a bad value.
            ParameterSetError: A file's parameter set is damaged, or of another vehicle.
            NetworkFileError: The terminal-time network is damaged.
        """
        self._node = node
        self._arguments = arguments
        check_node_names(arguments, node.get_fully_qualified_name())
        self._table: dict[str, NodeParameter] = {}
        self._choice = self._read_choice()
        forms = formulation_parameters(self._choice.family.formulations)
        self.problem = self._choice.make("".join(self._declare(form) for form in forms))
        for parameter in (*own(self.problem), *parameter_table(self.problem)):
            self._declare(parameter)
        # rclpy offers no public way to what the command line and files gave; it ignores names
        # that are not declared.
        given: Mapping[str, Any] = node._parameter_overrides
        self._origin = self._read()
        check_parameter_names(list(given), list(node.get_parameters_by_prefix("")))
        self._take_over(self._values())
        self._origin.sources.check_vehicle(self._vehicle(self.settings))
        self._on_change: Callable[[], None] | None = None
        node.add_on_set_parameters_callback(self._validate)
        node.add_post_set_parameters_callback(self._apply)

    @property
    def values(self) -> Mapping[str, Any]:
        """Current values by name."""
        return self._values()

    def on_change(self, callback: Callable[[], None]) -> None:
        """Call back whenever a parameter has changed."""
        self._on_change = callback

    def reread_files(self) -> FileChange:
        """What the parameter files hold now; nothing is changed yet.

        Raises:
            InvalidInputError: A file or value is bad, or it changes a read-only parameter.
            ParameterSetError: A file's parameter set is damaged, or of another vehicle.
            NetworkFileError: The terminal-time network is damaged.
        """
        origin = self._read()
        given = origin.sources.values
        check_parameter_names(list(given), list(self._node.get_parameters_by_prefix("")))
        current = self._values()
        read = {name: value for name, value in given.items() if name in self._table}
        for name, value in read.items():
            parameter = self._table[name]
            parameter.check_type(value)
            if parameter.read_only and value != current[name]:
                raise InvalidInputError(name, value, f"read-only, {current[name]!r}: restart")
        read |= self._dropped(given, current)
        values = self._merged(read)
        settings = self._settings_of(values)
        origin.sources.check_vehicle(self._vehicle(settings))
        return FileChange(
            setup=self._setup_of(settings, values, origin),
            values={n: v for n, v in read.items() if not self._table[n].read_only},
            origin=origin,
        )

    def commit(self, change: FileChange) -> None:
        """Take over what the parameter files hold.

        Raises:
            InvalidInputError: A parameter was refused after all; everything stays as it was.
        """
        before, self._origin = self._origin, change.origin
        result = self._node.set_parameters_atomically(
            [Parameter(name, value=value) for name, value in change.values.items()]
        )
        if not result.successful:
            self._origin = before
            raise InvalidInputError("parameter files", self._arguments.files, result.reason)
        self._take_over(self._values())

    def _dropped(self, given: Mapping[str, Any], current: Mapping[str, Any]) -> dict[str, Any]:
        """Defaults of what the files gave and give no more; what was set otherwise stays."""
        before = self._origin.sources.values
        return {
            name: _plain(parameter.default)
            for name, parameter in self._table.items()
            if not parameter.read_only
            and name in before
            and name not in given
            and current[name] == _plain(before[name])
        }

    def _read_choice(self) -> ProblemChoice:
        """The problem. Its file is run, so that a parameter set must not have named one.

        Raises:
            InvalidInputError: Nothing is known by its name, or what was found is no problem.
            ParameterSetError: A parameter set names a Python file.
        """
        text = self._declare(PROBLEM)
        named = named_problem(self._arguments, self._node.get_fully_qualified_name())
        by_file = self._arguments.files and PROBLEM.name not in self._arguments.names
        if by_file and is_file(text) and named != text:  # rcl has read another file than this
            raise InvalidInputError(PROBLEM.name, text, f"{named!r}, as in the files by now")
        return ProblemChoice.read(text)

    def _read(self) -> _Origin:
        """Read the files; that of the problem is not run again."""
        node_name = self._node.get_fully_qualified_name()
        sources = read_sources(self._arguments, node_name, self._choice)
        sources.check_problem(self.problem.name)
        return _Origin(sources, Predictors(self.problem.extras.network, sources.network))

    def _declare(self, parameter: NodeParameter) -> Any:
        """Declare one parameter and return its checked value."""
        try:
            self._node.declare_parameter(parameter.name, parameter.default, parameter.descriptor())
            value = _plain(self._node.get_parameter(parameter.name).value)
        except InvalidParameterTypeException as error:
            raise InvalidInputError(
                parameter.name, self._first_value(parameter), parameter.type_text
            ) from error
        except InvalidParameterValueException as error:
            bound = f"[{parameter.lower:g}, {parameter.upper:g}] {parameter.unit}".rstrip()
            raise InvalidInputError(parameter.name, self._first_value(parameter), bound) from error
        except ParameterUninitializedException:
            value = None
        parameter.check(value)
        self._table[parameter.name] = parameter
        return value

    def _first_value(self, parameter: NodeParameter) -> Any:
        """Value that was refused: the command line's or a file's, else the default."""
        given = self._node._parameter_overrides.get(parameter.name)
        return parameter.default if given is None else given.value

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
        return node_settings(self.problem, values)

    def _setup_of(
        self, settings: NodeSettings, values: Mapping[str, Any], origin: _Origin
    ) -> PlannerSetup:
        """What the planner is made of.

        Raises:
            InvalidInputError: The network is missing, or of another vehicle.
            NetworkFileError: It is damaged.
        """
        vehicle = self._vehicle(settings)
        predictor = None
        if settings.planner.terminal_time is TerminalTime.PREDICTED:
            predictor = origin.predictors.predictor(values[NETWORK], vehicle)
        return PlannerSetup(
            self.problem, settings.planner, predictor, origin.sources.label(values, vehicle)
        )

    def _vehicle(self, settings: NodeSettings) -> dict[str, Any]:
        """The parameters that fix the optimum, by name, SI, in the core's axes."""
        packed = self.problem.pack(settings.planner.parameters)
        return self.problem.vehicle_of(self.problem.table.unpack(packed))

    def _take_over(self, values: Mapping[str, Any]) -> None:
        settings = self._settings_of(values)
        self.setup = self._setup_of(settings, values, self._origin)
        self.settings = settings

    def _validate(self, changes: Sequence[Parameter]) -> SetParametersResult:
        """Accept or refuse a set of changes as a whole; the reason names the parameter."""
        try:
            values = self._merged({p.name: p.value for p in changes})
            self._setup_of(self._settings_of(values), values, self._origin)
        except DscpError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply(self, _changes: Sequence[Parameter]) -> None:
        self._take_over(self._values())
        if self._on_change is not None:
            self._on_change()


def _plain(value: Any) -> Any:
    """Python numbers and lists in place of the arrays that rclpy returns."""
    return value if isinstance(value, str | bool | int | float | None) else list(value)

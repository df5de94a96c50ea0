"""Parameter files and sets as they were at one moment, and who they say made a plan."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dscp_core.errors import InvalidInputError
from dscp_ros.parameter_set import (
    ParameterSet,
    ParameterSetError,
    directory_of,
    lies_in_set,
    load,
)
from dscp_ros.parameter_set.values import refuse_file
from dscp_ros.planner.choice import ProblemChoice
from dscp_ros.planner.declaration import VEHICLE_PREFIX
from dscp_ros.planner.parameter_files import ParameterArguments, read_file
from dscp_ros.planner.parameters import NETWORK, PROBLEM
from dscp_ros.planner.predictors import NamedNetwork

NO_SET = "none"
"""Stands in reports for the label of a parameter set."""


@dataclass(frozen=True)
class ParameterSources:
    """What the parameter files of the command line hold.

    Attributes:
        values: Node parameters by flat name, but for those that the command line sets itself.
        sets: Those of the files that belong to parameter sets, in order.
        network: What they say of the network, or None.
    """

    values: Mapping[str, Any]
    sets: tuple[ParameterSet, ...]
    network: NamedNetwork | None

    def check_problem(self, problem: str) -> None:
        """Refuse a problem that a set was not made for.

        Raises:
            ParameterSetError: A set is of another problem.
        """
        for one in self.sets:
            if one.problem != problem:
                raise ParameterSetError(
                    f"{one.directory}: for the problem {one.problem}, not for {problem}"
                )

    def check_vehicle(self, vehicle: Mapping[str, Any]) -> None:
        """Refuse a vehicle that a set was not made for.

        Args:
            vehicle: What `OptimalControlProblem.vehicle_of` gives.

        Raises:
            ParameterSetError: A set is of another vehicle.
        """
        for parameter_set in self.sets:
            parameter_set.check_vehicle(vehicle)

    def label(self, values: Mapping[str, Any], vehicle: Mapping[str, Any]) -> str:
        """Names the sets for reports, with what of them does not count (any more).

        Args:
            values: Node parameters in use.
            vehicle: What `OptimalControlProblem.vehicle_of` gives.
        """
        labels = []
        for one in self.sets:
            changed = _differing(one.values, values)
            fixed = (VEHICLE_PREFIX + name for name in _differing(one.vehicle, vehicle))
            changed += [name for name in fixed if name not in changed]
            labels.append(f"{one.label} (changed: {', '.join(changed)})" if changed else one.label)
        return " + ".join(labels) or NO_SET


def named_problem(arguments: ParameterArguments, node_name: str) -> str | None:
    """The problem that the parameter files name, later ones winning; nothing is run.

    Args:
        arguments: Parameter sources of the command line.
        node_name: Fully qualified name of the node.

    Raises:
        InvalidInputError: A file is missing, no YAML, or no parameter file.
        ParameterSetError: A parameter set names a Python file.
    """
    named = None
    for path in arguments.files:
        found = read_file(path, node_name).get(PROBLEM.name)
        if found is not None and lies_in_set(path):
            try:
                refuse_file(found)
            except InvalidInputError as error:
                raise ParameterSetError(f"{path}: {error}") from None
        named = named if found is None else str(found)
    return named


def read_sources(
    arguments: ParameterArguments, node_name: str, choice: ProblemChoice | None = None
) -> ParameterSources:
    """Read the parameter files, later ones winning.

    Args:
        arguments: Parameter sources of the command line.
        node_name: Fully qualified name of the node.
        choice: The problem, for sets that do not name a known one.

    Raises:
        InvalidInputError: A file is missing, no YAML, or no parameter file.
        ParameterSetError: A file belongs to a set that is not what its provenance says.
    """
    values: dict[str, Any] = {}
    sets: list[ParameterSet] = []
    network = None
    for path in arguments.files:
        folder = directory_of(path)
        if folder is None:
            found: Mapping[str, Any] = read_file(path, node_name)
            own = None
        else:
            sets.append(load(folder, choice))
            found, own = sets[-1].values, sets[-1].terminal_time_network
        values.update(found)
        if NETWORK in found:
            network = NamedNetwork(str(found[NETWORK]), Path(path).parent, own)
    kept = {name: value for name, value in values.items() if name not in arguments.names}
    return ParameterSources(kept, tuple(sets), network if NETWORK in kept else None)


def _differing(expected: Mapping[str, Any], given: Mapping[str, Any]) -> list[str]:
    return [name for name, value in expected.items() if _plain(given.get(name)) != _plain(value)]


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, Sequence) and not isinstance(value, str) else value

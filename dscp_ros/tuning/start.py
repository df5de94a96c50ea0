"""What a tuning starts from: the vehicle and planner settings of parameter files, and a network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dscp_core.errors import InvalidInputError
from dscp_core.planning.planner import TerminalTime
from dscp_core.planning.terminal_time_network import TerminalTimeNetwork
from dscp_core.tuning.quantities import TunedParameter
from dscp_ros.parameter_set.values import CheckedValues, check_values
from dscp_ros.planner.choice import ProblemChoice
from dscp_ros.planner.parameter_files import ParameterArguments, check_node_names
from dscp_ros.planner.parameter_sources import ParameterSources, named_problem, read_sources
from dscp_ros.planner.parameters import NETWORK, PROBLEM
from msg_adapters.layout import StateLayout, problem_layout

_SOURCE = "terminal_time_source"
_SHIPPED = "shipped"


@dataclass(frozen=True)
class Start:
    """Where a tuning starts.

    Attributes:
        values: Node parameters and what they mean.
        network: Terminal-time network, where the terminal time is predicted.
        origin: Parameter sets and network files, for the provenance.
        notes: What was decided without being asked.
    """

    values: CheckedValues
    network: TerminalTimeNetwork | None
    origin: dict[str, Any]
    notes: tuple[str, ...] = ()

    @property
    def layout(self) -> StateLayout:
        """Order of the problem's state in messages."""
        return problem_layout(self.values.problem)


def check_tuned(start: Start, tuned: Sequence[TunedParameter]) -> None:
    """Refuse quantities that would leave a network with another vehicle than its own.

    Raises:
        InvalidInputError: The vehicle is tuned and its terminal-time network is not.
    """
    vehicle = [one.label for one in tuned if one.name in start.values.vehicle]
    if vehicle and start.network is not None and not any(one.is_network for one in tuned):
        raise InvalidInputError(
            "parameters",
            ",".join(vehicle),
            f"together with network: the present one is of one vehicle; or {_SOURCE} free",
        )


def read_start(
    files: Sequence[Path],
    node: str,
    *,
    problem: str | None = None,
    network: Path | None = None,
    tunes_network: bool = False,
) -> Start:
    """Read the settings to start from; the node's defaults where the files say nothing.

    Args:
        files: Parameter files of the node; later ones win. One of a parameter set is checked as a
            whole.
        node: Name of the node that they are for.
        problem: Problem, where the files do not name it: a known name, or ``FILE.py:NAME``.
        network: File of the terminal-time network; it makes the terminal time predicted.
        tunes_network: Whether a network is tuned, which makes the terminal time predicted too.

    Raises:
        InvalidInputError: A file, name or value is bad, or a network that was named is of another
            vehicle and is not tuned.
        ParameterSetError: A set is damaged or was changed.
        NetworkFileError: The network is damaged.
        FileNotFoundError: There is no such network.
    """
    arguments = ParameterArguments(tuple(map(str, files)), frozenset(), ())
    check_node_names(arguments, node)
    named = named_problem(arguments, node)
    if problem is not None and named not in (None, problem):
        raise InvalidInputError("--problem", problem, f"{named}, as in the files")
    choice = ProblemChoice.read(problem or named or str(PROBLEM.default))
    sources = read_sources(arguments, node, choice)
    sources.check_problem(choice.name)
    given = dict(sources.values)
    values = check_values(given, choice)
    sources.check_vehicle(values.vehicle)
    notes: tuple[str, ...] = ()
    source = values.planner.terminal_time
    if (network or tunes_network) and source is not TerminalTime.PREDICTED:
        if values.problem.extras.network is None:
            raise InvalidInputError("network", values.problem.name, "a problem that has networks")
        values = check_values({**given, _SOURCE: TerminalTime.PREDICTED.value}, choice)
        notes = (f"{_SOURCE} is predicted, for the network; it was {source.value}",)
    origin: dict[str, Any] = {
        "parameter_files": [str(file) for file in files],
        "parameter_sets": [found.label for found in sources.sets],
    }
    if values.planner.terminal_time is not TerminalTime.PREDICTED:
        return Start(values, None, origin, notes)
    loaded = _network(values.problem.extras.network, sources, network)
    origin["network"] = str(network or values.given.get(NETWORK) or _SHIPPED)
    try:
        loaded.check_vehicle(values.vehicle)
    except InvalidInputError as error:
        if tunes_network:
            notes = (*notes, f"the network starts from one of another vehicle: {error}")
        elif origin["network"] == _SHIPPED:
            free = check_values({**given, _SOURCE: TerminalTime.FREE.value}, choice)
            note = (
                f"{_SOURCE} is free, as the node has it without a network of the vehicle: {error}"
            )
            return Start(free, None, {**origin, "network": None}, (*notes, note))
        else:
            raise
    return Start(values, loaded, origin, notes)


def _network(
    shipped: Path | None, sources: ParameterSources, given: Path | None
) -> TerminalTimeNetwork:
    """The network that was given, or the one that the node would take."""
    named = sources.network
    if given is not None:
        return TerminalTimeNetwork.load(given)
    if named is None or not named.text:
        if shipped is None:
            raise InvalidInputError(NETWORK, None, "the file of a network")
        return TerminalTimeNetwork.load(shipped)
    return named.network or TerminalTimeNetwork.load(named.folder / named.text)

"""Reading a parameter set: nothing of it is used before all of it is checked."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dscp_core.errors import DscpError, InvalidInputError
from dscp_core.planning.terminal_time_network import TerminalTimeNetwork
from dscp_ros.parameter_set.errors import ParameterSetError
from dscp_ros.parameter_set.format import (
    NETWORK_FILE,
    PARAMETERS_FILE,
    PROVENANCE_FILE,
    file_digest,
    identifier,
    read_provenance,
)
from dscp_ros.parameter_set.values import CheckedValues, read_values
from dscp_ros.planner.choice import ProblemChoice
from dscp_ros.planner.parameters import NETWORK

_ATTEMPTS = 3
"""Of reading a set that is replaced meanwhile."""


@dataclass(frozen=True)
class ParameterSet:
    """A parameter set whose checks have passed.

    Attributes:
        directory: Where it is.
        identifier: Short checksum of parameters and network.
        problem: Name of the problem.
        formulation: Its formulation; empty where there is one form only.
        values: Node parameters by flat name, as in the file.
        network: File of the terminal-time network, or None.
        terminal_time_network: The same, as it was when it was checked.
        vehicle: The parameters that fix the optimum, SI, in the core's axes.
        provenance: Where the set comes from.
    """

    directory: Path
    identifier: str
    problem: str
    formulation: str
    values: Mapping[str, Any]
    network: Path | None
    terminal_time_network: TerminalTimeNetwork | None
    vehicle: Mapping[str, Any]
    provenance: Mapping[str, Any]

    @property
    def label(self) -> str:
        """Name for reports."""
        return f"{self.directory.absolute().name}@{self.identifier}"

    def check_vehicle(self, vehicle: Mapping[str, Any]) -> None:
        """Refuse a vehicle that the set was not made for.

        Args:
            vehicle: What `OptimalControlProblem.vehicle_of` gives.

        Raises:
            ParameterSetError: One that fixes the optimum has another value.
        """
        _check_vehicle(self.vehicle, vehicle, str(self.directory))


def directory_of(parameter_file: str | Path) -> Path | None:
    """The set that a parameter file belongs to: the one whose provenance stands beside it."""
    path = Path(parameter_file)
    if path.name == PARAMETERS_FILE and os.path.lexists(path.parent / PROVENANCE_FILE):
        return path.parent
    return None


def lies_in_set(file: str | Path) -> bool:
    """Whether a file, of any name and behind any link, has the provenance of a set beside it."""
    places = (Path(file), Path(file).resolve())
    return any(os.path.lexists(place.parent / PROVENANCE_FILE) for place in places)


def load(directory: str | Path, choice: ProblemChoice | None = None) -> ParameterSet:
    """Read a set, as it is at one moment, even if another one takes its place meanwhile.

    Args:
        directory: Where it is.
        choice: The problem of a set that does not name a known one: its problem is from a Python
            file, which a set does not name.

    Raises:
        ParameterSetError: A file is missing, damaged, changed, or does not fit the others.
    """
    directory = Path(directory)
    for attempt in range(1, _ATTEMPTS + 1):
        try:
            handle = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
        except OSError as error:
            raise ParameterSetError(f"{directory}: no parameter set ({error.strerror})") from None
        try:
            # The path of the open directory goes on naming it when it is moved.
            return _load(Path(f"/proc/self/fd/{handle}"), directory, choice)
        except ParameterSetError:
            if attempt == _ATTEMPTS or not _replaced(handle, directory):
                raise
        finally:
            os.close(handle)
    raise AssertionError("unreachable")


def _replaced(handle: int, directory: Path) -> bool:
    """Whether the directory that is open is no longer the one of that name."""
    try:
        return not os.path.samestat(os.fstat(handle), os.stat(directory))
    except FileNotFoundError:
        return True


def _load(snapshot: Path, directory: Path, choice: ProblemChoice | None) -> ParameterSet:
    try:
        provenance = read_provenance(snapshot / PROVENANCE_FILE)
        digests = _check_files(snapshot, provenance)
        values = read_values(snapshot / PARAMETERS_FILE, provenance.get("problem"), choice)
        _check_agreement(snapshot, provenance, values)
        network = _network(snapshot, values) if NETWORK_FILE in digests else None
    except DscpError as error:
        message = str(error).replace(str(snapshot), str(directory))
        prefix = "" if message.startswith(str(directory)) else f"{directory}: "
        raise ParameterSetError(prefix + message) from None
    return ParameterSet(
        directory=directory,
        identifier=identifier(digests),
        problem=values.problem.name,
        formulation=values.formulation,
        values=values.given,
        network=None if network is None else directory / NETWORK_FILE,
        terminal_time_network=network,
        vehicle=values.vehicle,
        provenance=provenance,
    )


def _check_files(snapshot: Path, provenance: Mapping[str, Any]) -> dict[str, str]:
    """Compare the checksums; returns them by file name."""
    files = provenance.get("files")
    if not isinstance(files, dict) or not (
        {PARAMETERS_FILE} <= set(files) <= {PARAMETERS_FILE, NETWORK_FILE}
    ):
        raise ParameterSetError(
            f"{snapshot / PROVENANCE_FILE}: files {files!r}, expected checksums of "
            f"{PARAMETERS_FILE} and, if there is one, {NETWORK_FILE}"
        )
    for name, expected in files.items():
        if file_digest(snapshot / name) != expected:
            raise ParameterSetError(
                f"{snapshot / name}: content and checksum differ; the file was changed"
            )
    return dict(files)


def _check_agreement(snapshot: Path, provenance: Mapping[str, Any], values: CheckedValues) -> None:
    """Refuse parameters that are not those that the provenance tells of."""
    formulation = provenance.get("formulation")
    if formulation != values.formulation:
        bound = f"{formulation!r}, as in the provenance"
        raise InvalidInputError("formulation", values.formulation, bound)
    vehicle = provenance.get("vehicle")
    if not isinstance(vehicle, dict):
        raise ParameterSetError(f"{snapshot / PROVENANCE_FILE}: vehicle {vehicle!r}, no mapping")
    _check_vehicle(vehicle, values.vehicle, str(snapshot))
    named = values.given.get(NETWORK, "")
    expected = NETWORK_FILE if NETWORK_FILE in provenance["files"] else ""
    if named != expected:
        raise InvalidInputError(NETWORK, named, f"{expected!r}: a set names its own file, or none")


def _network(snapshot: Path, values: CheckedValues) -> TerminalTimeNetwork:
    try:
        return TerminalTimeNetwork.load(snapshot / NETWORK_FILE, values.vehicle)
    except FileNotFoundError:
        raise ParameterSetError(f"{snapshot / NETWORK_FILE}: not readable") from None


def _check_vehicle(
    expected: Mapping[str, Any], given: Mapping[str, float | list[float]], where: str
) -> None:
    differing = [
        f"{name} {given.get(name)!r} instead of {expected.get(name)!r}"
        for name in sorted(set(expected) | set(given))
        if expected.get(name) != given.get(name)
    ]
    if differing:
        raise ParameterSetError(f"{where}: of another vehicle: {', '.join(differing)}")

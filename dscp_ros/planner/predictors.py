"""Which terminal-time network the planner gets, if any."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from numpy.typing import NDArray

from dscp_core.errors import InvalidInputError
from dscp_core.planning.planner import TerminalTimePredictor
from dscp_core.planning.terminal_time_network import TerminalTimeNetwork
from dscp_ros.planner.parameters import NETWORK


@dataclass(frozen=True)
class NamedNetwork:
    """What a parameter file says of the network.

    Attributes:
        text: As in the file.
        folder: Folder that a relative path is relative to.
        network: The network itself, if it is one of a parameter set.
    """

    text: str
    folder: Path
    network: TerminalTimeNetwork | None = None


@dataclass(frozen=True)
class Unsuited:
    """Stands for the shipped network where the vehicle is not the one that it was trained for.

    Attributes:
        field: What differs.
        value: Its value.
        bound: That of the network's vehicle.
    """

    field: str
    value: object
    bound: str

    def predict(self, state: NDArray[Any]) -> NoReturn:
        """Refuse every state.

        Raises:
            InvalidInputError: Always.
        """
        raise InvalidInputError(self.field, self.value, self.bound)


class Predictors:
    """Networks by name. Each is read once: a file that changes takes effect with a new object."""

    def __init__(self, shipped: Path | None, named: NamedNetwork | None) -> None:
        """Start with nothing read.

        Args:
            shipped: The network that the problem brings, if any.
            named: What the last parameter file that names a network says of it.
        """
        self._shipped = shipped
        self._named = named
        self._read: dict[Path, TerminalTimeNetwork] = {}

    def predictor(self, text: str, vehicle: Mapping[str, Any]) -> TerminalTimePredictor:
        """The predictor that a value of the parameter means.

        Args:
            text: Its value.
            vehicle: What `OptimalControlProblem.vehicle_of` gives.

        Raises:
            InvalidInputError: There is no such file, or the network is of another vehicle.
            NetworkFileError: The file is damaged, or is no network.
        """
        if text:
            network = self._network(text)
            network.check_vehicle(vehicle)
            return network
        if self._shipped is None:
            raise InvalidInputError(NETWORK, text, "the file of a network")
        network = self._from(self._shipped)
        try:
            network.check_vehicle(vehicle)
        except InvalidInputError as error:
            return Unsuited(error.field, error.value, error.bound)
        return network

    def _network(self, text: str) -> TerminalTimeNetwork:
        named = self._named
        if named is None or named.text != text:
            return self._from(Path(text))
        return named.network or self._from(named.folder / text)

    def _from(self, path: Path) -> TerminalTimeNetwork:
        if path not in self._read:
            try:
                self._read[path] = TerminalTimeNetwork.load(path)
            except OSError as error:
                bound = f"a readable file ({error.strerror})"
                raise InvalidInputError(NETWORK, str(path), bound) from None
        return self._read[path]

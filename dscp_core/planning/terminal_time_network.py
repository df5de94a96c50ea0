"""A network that predicts the optimal terminal time of a landing vehicle (section 4.1.3).

Evaluated in NumPy, stored as safetensors: neither needs PyTorch.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dscp_core.errors import DscpError, InvalidInputError
from dscp_core.files import replace_file

Array = NDArray[np.float64]

FORMAT = "dscp_terminal_time_network"
VERSION = 1

_STATES = ("x", "y", "z", "vx", "vy", "vz", "mass")
_UNITS = ("m", "m", "m", "m/s", "m/s", "m/s", "kg")


class NetworkFileError(DscpError):
    """A network file that is damaged, or is none."""


class FeatureMap(Enum):
    """Inputs of the network.

    STATE: position and velocity. AXISYMMETRIC: x, vx, and the lateral r.r, v.v, r.v, which are
    all that matters, smoothly, where the problem is symmetric about the vertical.
    """

    STATE = "state"
    AXISYMMETRIC = "axisymmetric"

    @property
    def size(self) -> int:
        """Number of features."""
        return 6 if self is FeatureMap.STATE else 5

    def __call__(self, states: Array) -> Array:
        """Features (..., size) of states (..., 7), SI."""
        if self is FeatureMap.STATE:
            return states[..., :6]
        r, v = states[..., 1:3], states[..., 4:6]
        return np.stack(
            [
                states[..., 0],
                states[..., 3],
                np.sum(r * r, axis=-1),
                np.sum(v * v, axis=-1),
                np.sum(r * v, axis=-1),
            ],
            axis=-1,
        )


@dataclass(frozen=True, eq=False)
class NetworkData:
    """Everything that defines a network.

    Attributes:
        features: Its inputs.
        feature_center: (F,) subtracted from the features.
        feature_scale: (F,) divides them afterwards.
        weights: One (outputs, inputs) matrix per layer; tanh between layers, sigmoid at the end.
        biases: One (outputs,) vector per layer.
        interval_s: Least and greatest terminal time, to which the sigmoid is mapped.
        lower: (7,) least state that it is valid for, SI.
        upper: (7,) greatest one.
        vehicle: Values of the parameters that fix the optimum, SI.
        intervals: Number of intervals of the discretisation whose optimum was learnt.
        provenance: How it was made, for the reader.
    """

    features: FeatureMap
    feature_center: Array
    feature_scale: Array
    weights: tuple[Array, ...]
    biases: tuple[Array, ...]
    interval_s: tuple[float, float]
    lower: Array
    upper: Array
    vehicle: Mapping[str, Any]
    intervals: int
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        size = self.features.size
        _check_array("feature_center", self.feature_center, (size,))
        _check_array("feature_scale", self.feature_scale, (size,))
        if not np.all(self.feature_scale > 0.0):
            raise InvalidInputError("feature_scale", self.feature_scale.tolist(), "> 0")
        _check_array("lower", self.lower, (7,))
        _check_array("upper", self.upper, (7,))
        if not np.all(self.lower <= self.upper):
            raise InvalidInputError("lower", self.lower.tolist(), f"<= {self.upper.tolist()}")
        if not self.weights or len(self.weights) != len(self.biases):
            raise InvalidInputError(
                "layers",
                f"{len(self.weights)} weights, {len(self.biases)} biases",
                "one of each per layer",
            )
        for number, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            last = number == len(self.weights) - 1
            outputs = 1 if last else weight.shape[0]
            _check_array(f"layer {number} weight", weight, (outputs, size))
            _check_array(f"layer {number} bias", bias, (outputs,))
            size = outputs
        low, high = self.interval_s
        if not (math.isfinite(low) and math.isfinite(high) and 0.0 < low < high):
            raise InvalidInputError("interval_s", self.interval_s, "0 < low < high")
        if self.intervals < 2:
            raise InvalidInputError("intervals", self.intervals, ">= 2")


class TerminalTimeNetwork:
    """A `dscp_core.planning.planner.TerminalTimePredictor`."""

    def __init__(self, data: NetworkData) -> None:
        self.data = data
        low, high = data.interval_s
        self._middle, self._half = 0.5 * (low + high), 0.5 * (high - low)

    @staticmethod
    def load(path: str | Path, vehicle: Mapping[str, Any] | None = None) -> TerminalTimeNetwork:
        """Read a network.

        Args:
            path: Its file.
            vehicle: What `OptimalControlProblem.vehicle_of` gives, which it must have been trained
                for; not checked when None.

        Raises:
            FileNotFoundError: There is no such file.
            NetworkFileError: The file is damaged, or is no network.
            InvalidInputError: The network is of another vehicle.
        """
        network = TerminalTimeNetwork(_read(Path(path)))
        if vehicle is not None:
            network.check_vehicle(vehicle)
        return network

    def save(self, path: str | Path) -> None:
        """Write the network, atomically.

        Raises:
            FileWriteError: The file cannot be written.
        """
        from safetensors.numpy import save

        data = self.data
        tensors = {
            "feature_center": data.feature_center,
            "feature_scale": data.feature_scale,
            "interval_s": np.array(data.interval_s),
            "lower": data.lower,
            "upper": data.upper,
        }
        for number, (weight, bias) in enumerate(zip(data.weights, data.biases, strict=True)):
            tensors[f"layers.{number}.weight"] = weight
            tensors[f"layers.{number}.bias"] = bias
        tensors = {name: np.ascontiguousarray(tensor) for name, tensor in tensors.items()}
        document: dict[str, Any] = {
            "format": FORMAT,
            "version": VERSION,
            "features": data.features.value,
            "intervals": data.intervals,
            "vehicle": dict(data.vehicle),
            "provenance": dict(data.provenance),
        }
        document["sha256"] = _digest(tensors, document)
        # One key: safetensors writes several in any order, and equal networks give equal files.
        replace_file(Path(path), save(tensors, {"document": json.dumps(document, sort_keys=True)}))

    def predict(self, state: Array) -> float:
        """Terminal time in seconds for a state (7,), SI.

        Raises:
            InvalidInputError: The state is outside the box that the network is valid for.
        """
        state = np.asarray(state, dtype=np.float64)
        if state.shape != (len(_STATES),):
            raise InvalidInputError("state", f"shape {state.shape}", f"shape ({len(_STATES)},)")
        if not self.covers(state):
            inside = (state >= self.data.lower) & (state <= self.data.upper)
            worst = int(np.flatnonzero(~inside)[0])
            raise InvalidInputError(
                _STATES[worst],
                float(state[worst]),
                f"[{self.data.lower[worst]:g}, {self.data.upper[worst]:g}] {_UNITS[worst]}, "
                "which the terminal-time network was trained for",
            )
        return float(self.evaluate(state))

    def covers(self, state: Array) -> bool:
        """Whether a state (7,) lies in the box that the network is valid for."""
        return bool(np.all(state >= self.data.lower) and np.all(state <= self.data.upper))

    def evaluate(self, states: Array) -> Array:
        """Terminal times (...,) of states (..., 7), without asking whether it is valid there."""
        data = self.data
        values = (data.features(states) - data.feature_center) / data.feature_scale
        for weight, bias in zip(data.weights[:-1], data.biases[:-1], strict=True):
            values = np.tanh(values @ weight.T + bias)
        logit = (values @ data.weights[-1].T + data.biases[-1])[..., 0]
        # The sigmoid of section 4.1.3, mapped to the interval: 2 sigmoid(a) - 1 = tanh(a / 2).
        return np.asarray(self._middle + self._half * np.tanh(0.5 * logit))

    def check_vehicle(self, vehicle: Mapping[str, Any]) -> None:
        """Refuse parameters that the network was not trained for.

        Args:
            vehicle: What `OptimalControlProblem.vehicle_of` gives.

        Raises:
            InvalidInputError: One that fixes the optimum has another value.
        """
        given, mine = vehicle, self.data.vehicle
        names = sorted(given.keys() | mine.keys())
        differing = [name for name in names if mine.get(name) != given.get(name)]
        if differing:
            first, *others = differing
            also = f"; {', '.join(others)} differ too" if others else ""
            raise InvalidInputError(
                first,
                given.get(first),
                f"{mine.get(first)!r}, which the terminal-time network was trained for{also}",
            )


def _read(path: Path) -> NetworkData:
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise FileNotFoundError(2, "No such file", str(path))
    try:
        with safe_open(path, framework="numpy") as file:
            names = file.keys()
            metadata = dict(file.metadata() or {})
            tensors = {name: np.asarray(file.get_tensor(name)) for name in names}
    except (SafetensorError, TypeError) as error:
        raise NetworkFileError(f"{path}: no readable safetensors file ({error})") from None
    try:
        document = json.loads(metadata.get("document", "{}"))
    except json.JSONDecodeError as error:
        raise NetworkFileError(f"{path}: {error}") from None
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise NetworkFileError(f"{path}: no terminal-time network")
    if document.get("version") != VERSION:
        raise NetworkFileError(
            f"{path}: version {document.get('version')} of the format, version {VERSION} expected"
        )
    if document.pop("sha256", None) != _digest(tensors, document):
        raise NetworkFileError(f"{path}: content and checksum differ; the file was changed")
    try:
        return _assemble(tensors, document)
    except (KeyError, TypeError, ValueError) as error:
        raise NetworkFileError(f"{path}: {error}") from error


def _assemble(tensors: dict[str, Array], document: Mapping[str, Any]) -> NetworkData:
    layers = sum(name.endswith(".weight") for name in tensors)
    names = [f"layers.{number}" for number in range(layers)]
    expected = {"feature_center", "feature_scale", "interval_s", "lower", "upper"}
    expected |= {f"{name}.{part}" for name in names for part in ("weight", "bias")}
    if set(tensors) != expected:
        raise ValueError(f"tensors {sorted(tensors)}, {sorted(expected)} expected")
    _check_array("interval_s", tensors["interval_s"], (2,))
    low, high = tensors["interval_s"].tolist()
    return NetworkData(
        features=FeatureMap(document["features"]),
        feature_center=tensors["feature_center"],
        feature_scale=tensors["feature_scale"],
        weights=tuple(tensors[f"{name}.weight"] for name in names),
        biases=tuple(tensors[f"{name}.bias"] for name in names),
        interval_s=(low, high),
        lower=tensors["lower"],
        upper=tensors["upper"],
        vehicle=document["vehicle"],
        intervals=int(document["intervals"]),
        provenance=document["provenance"],
    )


def _check_array(name: str, array: Array, shape: tuple[int, ...]) -> None:
    if array.shape != shape or array.dtype != np.float64:
        raise InvalidInputError(name, f"{array.dtype} {array.shape}", f"float64 {shape}")
    if not np.all(np.isfinite(array)):
        raise InvalidInputError(name, "NaN or Inf", "finite")


def _digest(tensors: Mapping[str, Array], document: Mapping[str, Any]) -> str:
    digest = hashlib.sha256(json.dumps(document, sort_keys=True).encode())
    for name in sorted(tensors):
        digest.update(f"{name}:{tensors[name].dtype}:{tensors[name].shape}\n".encode())
        digest.update(np.ascontiguousarray(tensors[name]).tobytes())
    return digest.hexdigest()

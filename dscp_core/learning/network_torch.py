"""The terminal-time network in PyTorch, for training (section 4.1.3)."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from dscp_core.planning.terminal_time_network import FeatureMap, NetworkData

Array = NDArray[np.float64]


class TorchNetwork(torch.nn.Module):
    """Fully connected layers, tanh between them, a sigmoid mapped to an interval of seconds.

    In double precision on the CPU. Attributes are those of `NetworkData`.
    """

    def __init__(
        self,
        features: FeatureMap,
        hidden: Sequence[int],
        interval_s: tuple[float, float],
        samples: Array,
        seed: int,
    ) -> None:
        """Make a network with random weights.

        Args:
            features: Its inputs.
            hidden: Neurons of every hidden layer.
            interval_s: Least and greatest terminal time.
            samples: (n, 7) states whose features are mapped to [-1, 1].
            seed: Of the weights.
        """
        super().__init__()
        values = features(samples)
        low, high = values.min(axis=0), values.max(axis=0)
        self.features = features
        self.feature_center = 0.5 * (low + high)
        self.feature_scale = np.maximum(0.5 * (high - low), 1e-12)
        self.interval_s = interval_s
        generator = torch.Generator().manual_seed(seed)
        sizes = [features.size, *hidden, 1]
        self.layers = torch.nn.ModuleList(
            torch.nn.Linear(inputs, outputs, dtype=torch.float64)
            for inputs, outputs in itertools.pairwise(sizes)
        )
        for layer in self._linear():
            torch.nn.init.xavier_uniform_(layer.weight, generator=generator)
            torch.nn.init.zeros_(layer.bias)

    def inputs(self, states: Array) -> torch.Tensor:
        """Normalised features (n, F) of states (n, 7)."""
        return torch.from_numpy((self.features(states) - self.feature_center) / self.feature_scale)

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        """Terminal times (n,) in seconds of normalised features (n, F)."""
        *hidden, last = self._linear()
        values = inputs
        for layer in hidden:
            values = torch.tanh(layer(values))
        low, high = self.interval_s
        return low + (high - low) * torch.sigmoid(last(values)[:, 0])

    def layer_derivatives(
        self, inputs: torch.Tensor
    ) -> tuple[list[torch.Tensor], list[torch.Tensor], torch.Tensor]:
        """What a prediction's derivatives by all weights are products of.

        Args:
            inputs: (n, F) normalised features.

        Returns:
            Per layer its inputs (n, i), per layer the derivatives (n, o) of the terminal times by
            its outputs before the activation, and the terminal times (n,).
        """
        *hidden, last = self._linear()
        values = [inputs]
        for layer in hidden:
            values.append(torch.tanh(layer(values[-1])))
        low, high = self.interval_s
        share = torch.sigmoid(last(values[-1]))
        slopes = [(high - low) * share * (1.0 - share)]
        for layer, value in zip((last, *reversed(hidden[1:])), reversed(values[1:]), strict=True):
            slopes.append((slopes[-1] @ layer.weight) * (1.0 - value**2))
        return values, slopes[::-1], low + (high - low) * share[:, 0]

    def start_at(self, time_s: float) -> None:
        """Set the last bias so that predictions lie around a terminal time."""
        low, high = self.interval_s
        share = min(max((time_s - low) / (high - low), 0.01), 0.99)
        with torch.no_grad():
            self._linear()[-1].bias.fill_(float(np.log(share / (1.0 - share))))

    def predict(self, states: Array) -> Array:
        """Terminal times (n,) in seconds of states (n, 7)."""
        with torch.no_grad():
            return np.asarray(self(self.inputs(states)).numpy())

    def tensors(self) -> dict[str, Array]:
        """Copies of the weights by name."""
        return {name: value.numpy().copy() for name, value in self.state_dict().items()}

    def set_tensors(self, tensors: Mapping[str, Array]) -> None:
        """Inverse of `tensors`."""
        self.load_state_dict({name: torch.from_numpy(tensors[name]) for name in self.state_dict()})

    def export(
        self,
        *,
        lower: Array,
        upper: Array,
        vehicle: Mapping[str, Any],
        intervals: int,
        provenance: Mapping[str, Any],
    ) -> NetworkData:
        """The network for evaluation without PyTorch; arguments as in `NetworkData`."""
        layers = [
            (layer.weight.detach().numpy().copy(), layer.bias.detach().numpy().copy())
            for layer in self._linear()
        ]
        return NetworkData(
            features=self.features,
            feature_center=self.feature_center,
            feature_scale=self.feature_scale,
            weights=tuple(weight for weight, _ in layers),
            biases=tuple(bias for _, bias in layers),
            interval_s=self.interval_s,
            lower=lower,
            upper=upper,
            vehicle=vehicle,
            intervals=intervals,
            provenance=provenance,
        )

    def _linear(self) -> list[torch.nn.Linear]:
        return [layer for layer in self.layers if isinstance(layer, torch.nn.Linear)]

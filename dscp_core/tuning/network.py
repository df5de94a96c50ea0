"""Between the network as it is stored and the network as it is trained."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from dscp_core.learning.network_torch import TorchNetwork
from dscp_core.planning.terminal_time_network import NetworkData, TerminalTimeNetwork


def trainable(data: NetworkData) -> TorchNetwork:
    """A network in PyTorch that predicts the same."""
    network = TorchNetwork(
        data.features,
        [weight.shape[0] for weight in data.weights[:-1]],
        data.interval_s,
        np.stack([data.lower, data.upper]),
        seed=0,
    )
    network.feature_center, network.feature_scale = data.feature_center, data.feature_scale
    tensors = {}
    for number, (weight, bias) in enumerate(zip(data.weights, data.biases, strict=True)):
        tensors[f"layers.{number}.weight"] = weight
        tensors[f"layers.{number}.bias"] = bias
    network.set_tensors(tensors)
    return network


def exported(
    network: TorchNetwork, origin: NetworkData, vehicle: Mapping[str, Any], provenance: Any
) -> TerminalTimeNetwork:
    """The tuned network, valid where the original was.

    Args:
        network: Tuned.
        origin: What it was made from.
        vehicle: What `OptimalControlProblem.vehicle_of` gives for the tuned parameters.
        provenance: Of the tuning, JSON.
    """
    return TerminalTimeNetwork(
        network.export(
            lower=origin.lower,
            upper=origin.upper,
            vehicle=vehicle,
            intervals=origin.intervals,
            provenance={**origin.provenance, "tuning": provenance},
        )
    )

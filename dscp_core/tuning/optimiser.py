"""PyTorch's optimisers, and their state as arrays and JSON for a checkpoint."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from dscp_core.learning.network_torch import TorchNetwork
from dscp_core.tuning.settings import ADAM, TuningSettings

_TENSOR = "__tensor__"
_PREFIX = "optimiser."


def make_optimiser(
    settings: TuningSettings, point: torch.nn.Parameter, network: TorchNetwork | None
) -> torch.optim.Optimizer:
    """Optimiser of the point (D,) and, where it is given, of the network's weights."""
    weights = [] if network is None else list(network.parameters())
    if settings.optimiser == ADAM:
        groups: list[dict[str, Any]] = [{"params": [point], "lr": settings.rate}]
        if weights:
            groups.append({"params": weights, "lr": settings.network_learning_rate})
        for group in groups:
            group["initial_lr"] = group["lr"]
        return torch.optim.Adam(groups)
    return torch.optim.LBFGS(
        [point, *weights],
        lr=settings.rate,
        max_iter=1,
        tolerance_grad=1e-12,
        tolerance_change=1e-14,
        line_search_fn="strong_wolfe",
    )


def anneal(optimiser: torch.optim.Optimizer, share_done: float) -> None:
    """Set Adam's rates to their place on half a cosine from the first rate to zero."""
    for group in optimiser.param_groups:
        group["lr"] = group["initial_lr"] * 0.5 * (1.0 + math.cos(math.pi * share_done))


def state_of(
    optimiser: torch.optim.Optimizer,
) -> tuple[dict[str, NDArray[Any]], Any]:
    """Tensors by name, and the rest as JSON holds it."""
    arrays: dict[str, NDArray[Any]] = {}
    return arrays, _encode(optimiser.state_dict()["state"], arrays)


def restore(
    optimiser: torch.optim.Optimizer, arrays: Mapping[str, NDArray[Any]], document: Any
) -> None:
    """Inverse of `state_of`."""
    state = {int(number): entry for number, entry in _decode(document, arrays).items()}
    optimiser.load_state_dict({**optimiser.state_dict(), "state": state})


def _encode(value: Any, arrays: dict[str, NDArray[Any]]) -> Any:
    if isinstance(value, torch.Tensor):
        name = f"{_PREFIX}{len(arrays)}"
        arrays[name] = value.detach().numpy().copy()
        return {_TENSOR: name}
    if isinstance(value, dict):
        return {str(key): _encode(entry, arrays) for key, entry in value.items()}
    if isinstance(value, list):
        return [_encode(entry, arrays) for entry in value]
    return float(value) if isinstance(value, np.floating) else value


def _decode(value: Any, arrays: Mapping[str, NDArray[Any]]) -> Any:
    if isinstance(value, dict):
        if _TENSOR in value:
            return torch.from_numpy(np.array(arrays[value[_TENSOR]]))
        return {key: _decode(entry, arrays) for key, entry in value.items()}
    if isinstance(value, list):
        return [_decode(entry, arrays) for entry in value]
    return value

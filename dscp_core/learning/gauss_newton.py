"""Gauss-Newton fit of the terminal-time network.

Weighted least squares with damped Gauss-Newton steps on batches. With the Jacobian J (n, P) of a
batch's predictions by all weights, a step is J' (J J' + n damping I)^-1 r; J J' follows from the
layers' inputs and back-propagated derivatives without J itself, so that thousands of weights
cost no more than an (n, n) factorisation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from dscp_core.errors import DscpError
from dscp_core.learning.network_torch import TorchNetwork
from dscp_core.learning.recipes import Fit

Array = NDArray[np.float64]

_DAMPING_SHARE = 0.2


class FitError(DscpError):
    """A fit whose numbers are no longer finite."""


@dataclass(frozen=True, eq=False)
class Targets:
    """What to fit.

    Attributes:
        inputs: (n, F) normalised features.
        times_s: (n,) wanted terminal times.
        weights: (n,) of the squared errors.
    """

    inputs: torch.Tensor
    times_s: torch.Tensor
    weights: torch.Tensor


class GaussNewton:
    """Gauss-Newton steps on batches, each damped towards a share of the one before.

    The step is the least-squares solution of J d = r with the penalty
    ``n damping |d - momentum d_before|^2``, which keeps what earlier batches have found where
    this one is silent, and another one on the weights themselves.
    """

    def __init__(self, network: TorchNetwork, settings: Fit) -> None:
        """Prepare.

        Args:
            network: Changed by every step.
            settings: How to step.
        """
        self._network = network
        self._settings = settings
        self.number = 0
        """Steps done."""
        size = sum(parameter.numel() for parameter in network.parameters())
        self.last = np.zeros(size)
        """(P,) last step, before its length was applied."""

    @property
    def done(self) -> bool:
        """Whether all steps are done."""
        return self.number >= self._settings.steps

    @torch.no_grad()
    def step(self, targets: Targets, rng: np.random.Generator) -> float:
        """One step.

        Args:
            targets: All of them.
            rng: Draws the batch.

        Returns:
            Weighted mean squared error of the batch before the step, s^2.

        Raises:
            FitError: The step is not finite; the network is unchanged.
        """
        count = min(self._settings.batch, len(targets.times_s))
        batch = torch.from_numpy(rng.choice(len(targets.times_s), count, replace=False))
        start = torch.nn.utils.parameters_to_vector(self._network.parameters())
        loss, direction = self._direction(targets, batch, start)
        if not torch.isfinite(direction).all():
            raise FitError(f"step {self.number + 1} of the fit: not finite")
        torch.nn.utils.vector_to_parameters(
            start + self.length * direction, self._network.parameters()
        )
        self.last = direction.numpy()
        self.number += 1
        return loss

    @property
    def length(self) -> float:
        """Share of the next step that is taken."""
        left = 1.0 - self.number / self._settings.steps
        return self._settings.step_length * min(1.0, 2.0 * left)

    def _damping(self) -> float:
        first, last = self._settings.damping
        share = min(1.0, self.number / (_DAMPING_SHARE * self._settings.steps))
        return float(first * (last / first) ** share)

    def _direction(
        self, targets: Targets, batch: torch.Tensor, start: torch.Tensor
    ) -> tuple[float, torch.Tensor]:
        inputs, slopes, times = self._network.layer_derivatives(targets.inputs[batch])
        weights = targets.weights[batch]
        root = torch.sqrt(weights / torch.mean(weights))
        residual = root * (targets.times_s[batch] - times)
        slopes = [root[:, None] * slope for slope in slopes]
        # Both penalties, n damping |d - momentum last|^2 and n decay |d + weights|^2, are one.
        damping, decay = self._damping(), self._settings.weight_decay
        kept = damping * self._settings.momentum * torch.from_numpy(self.last) - decay * start
        kept /= damping + decay
        gram = torch.zeros(len(batch), len(batch), dtype=torch.float64)
        explained = torch.zeros(len(batch), dtype=torch.float64)
        done = 0
        for value, slope in zip(inputs, slopes, strict=True):
            gram += (value @ value.T + 1.0) * (slope @ slope.T)
            size = slope.shape[1] * value.shape[1]
            weight = kept[done : done + size].view(slope.shape[1], value.shape[1])
            bias = kept[done + size : done + size + slope.shape[1]]
            explained += torch.sum((value @ weight.T + bias) * slope, dim=1)
            done += size + slope.shape[1]
        gram.diagonal().add_((damping + decay) * len(batch))
        factor, refused = torch.linalg.cholesky_ex(gram)
        if refused:
            raise FitError(f"step {self.number + 1} of the fit: J J' is not positive definite")
        solved = torch.cholesky_solve((residual - explained)[:, None], factor)
        parts = []
        for value, slope in zip(inputs, slopes, strict=True):
            weighted = slope * solved
            parts += [(weighted.T @ value).ravel(), weighted.sum(dim=0)]
        return float(torch.mean(residual**2)), kept + torch.cat(parts)

"""The user's own loss: a Python function of torch tensors, given as FILE.py:FUNCTION."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray

from dscp_core.gradients.losses import LossGradient
from dscp_core.problem.declaration import TERMINAL_TIME
from dscp_core.scp.scp import ScpResult
from dscp_core.transcription.transcription import Transcription
from dscp_core.tuning.errors import TuningError
from dscp_core.tuning.user_function import UserFunction

Array = NDArray[np.float64]


class UserLoss:
    """Loss of the final trajectory by the user's function; see `dscp_core.gradients.losses.Loss`.

    The function is called with states (N+1, nx), controls (N+1, nu) and the terminal time (), SI,
    double precision, and returns a scalar that autograd can differentiate.
    """

    def __init__(self, function: UserFunction) -> None:
        torch.set_num_threads(1)
        self._where = f"{function.file}:{function.name}"
        self._function = function.load()

    def value(self, transcription: Transcription, trace: ScpResult) -> float:
        """See `Loss.value`.

        Raises:
            TuningError: The function fails, or returns no scalar.
        """
        return float(self._call(*_arguments(transcription, trace)).detach())

    def gradient(self, transcription: Transcription, trace: ScpResult) -> LossGradient:
        """See `Loss.gradient`.

        Raises:
            TuningError: The function fails, or returns no scalar that depends on its arguments.
        """
        layout = transcription.layout
        arguments = _arguments(transcription, trace)
        loss = self._call(*arguments)
        if not loss.requires_grad:
            raise TuningError(f"{self._where}: the result does not depend on the trajectory")
        pulled = torch.autograd.grad(loss, arguments, allow_unused=True)
        states, controls, time = (
            np.zeros(a.shape) if g is None else g.numpy()
            for a, g in zip(arguments, pulled, strict=True)
        )
        decisions = np.zeros((len(trace.iterations), layout.size))
        parameters = np.zeros(transcription.table.size)
        nodes = np.hstack([states * layout.state_scale, controls * layout.control_scale])
        decisions[-1, layout.offset : layout.reference_size] = nodes.ravel()
        if layout.free_terminal_time:
            decisions[-1, 0] = time * layout.time_scale
        else:
            parameters[transcription.table.slice(TERMINAL_TIME)] = time
        return LossGradient(decisions, parameters)

    def _call(self, *arguments: torch.Tensor) -> torch.Tensor:
        try:
            loss = self._function(*arguments)
        except Exception as error:  # noqa: BLE001 - the user's code may raise anything
            raise TuningError(f"{self._where}: {type(error).__name__}: {error}") from None
        if not isinstance(loss, torch.Tensor) or loss.numel() != 1:
            raise TuningError(f"{self._where}: returned {loss!r}, no scalar tensor")
        return loss.reshape(())


def _arguments(
    transcription: Transcription, trace: ScpResult
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    layout, final = transcription.layout, trace.final_reference
    time = transcription.terminal_time(final, trace.parameters)
    if not math.isfinite(time):
        raise TuningError("the terminal time is not finite")
    arrays = (layout.states(final), layout.controls(final), np.array(time))
    states, controls, time_s = (torch.from_numpy(a.copy()).requires_grad_() for a in arrays)
    return states, controls, time_s

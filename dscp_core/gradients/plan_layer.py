"""A PyTorch layer from the parameters of plans to a scalar of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from dscp_core.errors import InvalidInputError
from dscp_core.gradients.gradient import Gradient, Method
from dscp_core.gradients.losses import Loss
from dscp_core.gradients.run import of_plan, settle
from dscp_core.gradients.samples import SampleReport
from dscp_core.gradients.torch_layer import LossLayer
from dscp_core.problem.declaration import TERMINAL_TIME
from dscp_core.scp.scp import Scp, ScpResult, ScpStatus

Array = NDArray[np.float64]


class PlanLayer(LossLayer):
    """A scalar of plans as a function of named parameters; `Planner.layer` makes it.

    A sample without a feasible plan has the loss NaN and the gradient zero, and harms no other:
    ``loss.nansum()`` leaves it out.

    Attributes:
        samples: What became of every sample of the last call: certified or not, converged or not
            with what there is to gain, and why the iterations stopped. Its backward pass completes
            them with the verdict on their gradients.

    Example:
        >>> import torch
        >>> from dscp_core import Planner, problems
        >>> planner = Planner(problems.get("powered_descent"))
        >>> layer = planner.layer("mass", inputs=("terminal_time",))
        >>> time = torch.tensor([33.0, 25.0], requires_grad=True)
        >>> loss = layer(terminal_time=time)
        >>> loss.nansum().backward()
        >>> [sample.status.name for sample in layer.samples], torch.isnan(loss).tolist()
        (['CONVERGED', 'INFEASIBLE'], [False, True])
    """

    def __init__(
        self,
        scp: Scp,
        inputs: Sequence[str],
        loss: Loss,
        parameters: Array,
        method: Method,
        certify: Callable[[ScpResult], bool],
    ) -> None:
        """Choose inputs and loss.

        Args:
            scp: The loop to run, with polished subproblems.
            inputs: Names of parameters, or ``"initial_state"``.
            loss: Scalar of a trace.
            parameters: Packed values of all others, SI.
            method: How to differentiate.
            certify: Whether the last trajectory of a run can be flown.

        Raises:
            InvalidInputError: Unknown parameter, or a terminal time that is a decision.
        """
        problem = scp.transcription.problem
        super().__init__(scp, inputs, problem.table.unpack(parameters), method)
        if scp.transcription.layout.free_terminal_time and TERMINAL_TIME in inputs:
            raise InvalidInputError(
                "inputs", TERMINAL_TIME, "other parameters: it is free, a decision of the solver"
            )
        self._loss, self._certify = loss, certify
        self.samples: tuple[SampleReport, ...] = ()

    def forward(self, **inputs: torch.Tensor) -> torch.Tensor:
        """Plan every sample.

        Args:
            **inputs: One tensor per named input, SI: (B, size), or (B,) for a scalar.

        Returns:
            (B,) losses; NaN for a sample without a feasible plan.

        Raises:
            InvalidInputError: A name or a shape does not fit. Bad values fail their sample only.
        """
        outputs, _, self.samples = self._solve(inputs, None)
        usable = torch.tensor([sample.usable for sample in self.samples], dtype=torch.bool)
        return torch.where(usable, outputs[:, 0], torch.nan)

    def run(self, parameters: Array, reference: Array | None) -> tuple[ScpResult | None, str]:
        """Trace of one sample, checked as `Planner.plan` checks it, or why there is none."""
        problem = self.transcription.problem
        try:
            problem.require_consistent(parameters)
            problem.require_start(self.transcription.initial_state(parameters), parameters)
        except InvalidInputError as error:
            return None, str(error)
        trace, message = super().run(parameters, reference)
        if trace is None or self._method is Method.UNROLLED or not trace.succeeded:
            return trace, message
        settled = settle(self._scp, parameters, trace.final_reference)
        if not settled.succeeded:
            return settled, settled.message
        return replace(settled, status=trace.status), message

    def certified(self, trace: ScpResult) -> bool | None:
        """Whether the trajectory, flown with the true dynamics, passes every check."""
        return self._certify(trace)

    def usable(self, trace: ScpResult) -> bool:
        """Whether a run has a loss and a gradient: not where it found no feasible trajectory."""
        return super().usable(trace) and trace.status is not ScpStatus.INFEASIBLE

    def differentiate(self, trace: ScpResult, loss: Loss) -> Gradient:
        """Gradient of the loss, trusted only where the run ended with a plan."""
        return of_plan(self._scp, trace, loss, self._method)

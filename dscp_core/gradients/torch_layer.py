"""PyTorch layers over the NumPy core: a batch of parameters in, losses or trajectories out.

Everything runs in double precision on the CPU, one sample after another. A sample that fails
harms no other: its outputs and its gradient are zero, and its report says why.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.autograd.function import once_differentiable

from dscp_core.errors import InvalidInputError
from dscp_core.gradients.gradient import Gradient, Method, parts, positions
from dscp_core.gradients.losses import Loss, SeedLoss
from dscp_core.gradients.run import DifferentiationError, implicit, unrolled
from dscp_core.gradients.samples import SampleReport, report_of
from dscp_core.problem import checks
from dscp_core.problem.declaration import TERMINAL_TIME
from dscp_core.problem.parameters import Value
from dscp_core.scp.scp import Scp, ScpResult, ScpStatus
from dscp_core.transcription.transcription import Transcription

Array = NDArray[np.float64]

_WITHOUT_GRADIENT = (
    ScpStatus.DEADLINE,
    ScpStatus.SUBPROBLEM_INFEASIBLE,
    ScpStatus.SOLVER_FAILURE,
)


@dataclass(frozen=True)
class LossBatch:
    """Losses of a batch.

    Attributes:
        values: (B,).
        samples: One report per sample; the backward pass completes them.
    """

    values: torch.Tensor
    samples: tuple[SampleReport, ...]


@dataclass(frozen=True)
class TrajectoryBatch:
    """Final trajectories of a batch, SI.

    Attributes:
        states: (B, N+1, nx).
        controls: (B, N+1, nu).
        terminal_time_s: (B,).
        samples: One report per sample; the backward pass completes them.
    """

    states: torch.Tensor
    controls: torch.Tensor
    terminal_time_s: torch.Tensor
    samples: tuple[SampleReport, ...]


class DscpLayer(torch.nn.Module, ABC):
    """What the layers share: named inputs, and one differentiable run per sample."""

    def __init__(
        self,
        scp: Scp,
        inputs: Sequence[str],
        parameters: Mapping[str, Value] | None,
        method: Method,
    ) -> None:
        super().__init__()
        problem = scp.transcription.problem
        self._scp = scp
        self._method = checks.choice("method", method, Method)
        self._positions = {name: positions(problem, name) for name in inputs}
        self._parts = tuple(part for name in inputs for part in parts(problem, name))
        if not inputs or len(set(self._parts)) != len(self._parts):
            raise InvalidInputError("inputs", tuple(inputs), "one or more names, each given once")
        self._base = torch.from_numpy(problem.table.pack(parameters))

    @property
    def transcription(self) -> Transcription:
        """The transcription whose parameters are the inputs."""
        return self._scp.transcription

    @abstractmethod
    def output_size(self) -> int:
        """Length M of a sample's output."""

    @property
    def scp(self) -> Scp:
        """The loop that runs."""
        return self._scp

    def certified(self, trace: ScpResult) -> bool | None:
        """Whether the trajectory of a usable run passes its certificate; None where it has none."""
        return None

    @abstractmethod
    def output(self, trace: ScpResult) -> Array:
        """(M,) output of a usable trace."""

    @abstractmethod
    def loss_of(self, cotangent: Array) -> tuple[Loss, float]:
        """A loss and a factor, whose product has the gradient of ``cotangent . output``."""

    def run(self, parameters: Array, reference: Array | None) -> tuple[ScpResult | None, str]:
        """Trace of one sample and its message, or None and why it never started."""
        table = self._scp.transcription.table
        try:
            for name in self._parts:
                table[name].validate(parameters[table.slice(name)])
            trace = self._scp.run(parameters, reference)
        except InvalidInputError as error:
            return None, str(error)
        return trace, trace.message

    def usable(self, trace: ScpResult) -> bool:
        """Whether a run has an output and a gradient."""
        return bool(trace.iterations) and trace.status not in _WITHOUT_GRADIENT

    def differentiate(self, trace: ScpResult, loss: Loss) -> Gradient:
        """Gradient of a loss of a usable trace.

        Raises:
            DifferentiationError: There is none.
        """
        compute = unrolled if self._method is Method.UNROLLED else implicit
        return compute(self._scp, trace, loss)

    def pull(self, trace: ScpResult, cotangent: Array) -> Gradient:
        """Gradient of ``cotangent . output`` for one sample.

        Raises:
            DifferentiationError: There is no finite gradient.
        """
        if not np.all(np.isfinite(cotangent)):
            raise DifferentiationError("the gradient that reached the layer is not finite")
        loss, factor = self.loss_of(cotangent)
        gradient = self.differentiate(trace, loss)
        pulled = replace(
            gradient,
            parameters=factor * gradient.parameters,
            initial_reference=factor * gradient.initial_reference,
        )
        if not (
            np.isfinite(pulled.parameters).all() and np.isfinite(pulled.initial_reference).all()
        ):
            raise DifferentiationError("the gradient is not finite")
        return pulled

    def _solve(
        self, inputs: Mapping[str, torch.Tensor], initial_reference: torch.Tensor | None
    ) -> tuple[torch.Tensor, torch.Tensor, tuple[SampleReport, ...]]:
        """Outputs (B, M), packed parameters (B, P) and reports."""
        packed = self._packed(inputs)
        if initial_reference is not None:
            shape = (packed.shape[0], self._scp.transcription.layout.reference_size)
            initial_reference = _matrix("initial_reference", initial_reference, shape)
        reports: list[SampleReport] = []
        outputs = _Solve.apply(self, reports, packed, initial_reference)  # type: ignore[no-untyped-call]
        return outputs, packed, tuple(reports)

    def _packed(self, inputs: Mapping[str, torch.Tensor]) -> torch.Tensor:
        if set(inputs) != set(self._positions):
            raise InvalidInputError("inputs", sorted(inputs), f"exactly {sorted(self._positions)}")
        for name, tensor in inputs.items():
            if not isinstance(tensor, torch.Tensor) or tensor.is_complex():
                raise InvalidInputError(name, tensor, "a tensor of real numbers")
        first = next(iter(inputs.values()))
        batch = first.shape[0] if first.dim() else 1
        packed = self._base.expand(batch, -1)
        for name, where in self._positions.items():
            flat = where.size == 1 and inputs[name].dim() == 1
            tensor = inputs[name][:, None] if flat else inputs[name]
            matrix = _matrix(name, tensor, (batch, where.size))
            packed = packed.index_copy(1, torch.from_numpy(where), matrix)
        return packed


class _Solve(torch.autograd.Function):
    """(packed parameters, initial references) -> outputs, sample by sample."""

    @staticmethod
    def forward(
        ctx: Any,
        layer: DscpLayer,
        reports: list[SampleReport],
        packed: torch.Tensor,
        initial_reference: torch.Tensor | None,
    ) -> torch.Tensor:
        parameters = packed.detach().numpy()
        references = None if initial_reference is None else initial_reference.detach().numpy()
        outputs = np.zeros((parameters.shape[0], layer.output_size()))
        traces: list[ScpResult | None] = []
        for sample, row in enumerate(parameters):
            trace, message = layer.run(row, None if references is None else references[sample])
            usable = trace is not None and layer.usable(trace)
            if trace is not None and usable:
                outputs[sample] = layer.output(trace)
            traces.append(trace if usable else None)
            certified = None if trace is None or not usable else layer.certified(trace)
            reports.append(report_of(layer.scp, trace, message, usable, certified))
        ctx.layer, ctx.reports, ctx.traces = layer, reports, traces
        return torch.from_numpy(outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_output: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        layer: DscpLayer = ctx.layer
        layout, table = layer.transcription.layout, layer.transcription.table
        cotangents = grad_output.numpy()
        parameters = np.zeros((len(ctx.traces), table.size))
        references = np.zeros((len(ctx.traces), layout.reference_size))
        for sample, (trace, report) in enumerate(zip(ctx.traces, ctx.reports, strict=True)):
            if trace is None:
                report.trusted, report.reasons = False, (f"zero gradient: {report.message}",)
                continue
            try:
                gradient = layer.pull(trace, cotangents[sample])
            except DifferentiationError as error:
                report.trusted, report.reasons = False, (f"zero gradient: {error}",)
                continue
            parameters[sample] = gradient.parameters
            references[sample] = gradient.initial_reference
            report.trusted, report.reasons = gradient.trusted, gradient.reasons
        given = ctx.needs_input_grad[3]
        return (
            None,
            None,
            torch.from_numpy(parameters),
            torch.from_numpy(references) if given else None,
        )


class LossLayer(DscpLayer):
    """What layers share whose output is one loss."""

    _loss: Loss

    def output_size(self) -> int:
        """One."""
        return 1

    def output(self, trace: ScpResult) -> Array:
        """(1,) the loss."""
        return np.array([self._loss.value(self.transcription, trace)])

    def loss_of(self, cotangent: Array) -> tuple[Loss, float]:
        """The loss and the cotangent."""
        return self._loss, float(cotangent[0])


class DscpLossLayer(LossLayer):
    """Loss of an SCP run as a function of named parameters.

    Example:
        >>> from dscp_core import CostLoss, DscpLossLayer, Planner, problems
        >>> planner = Planner(problems.get("powered_descent"))
        >>> layer = DscpLossLayer(planner.scp, ("terminal_time",), CostLoss())
        >>> import torch
        >>> batch = layer(terminal_time=torch.tensor([33.0]))
        >>> batch.values.shape, batch.samples[0].usable
        (torch.Size([1]), True)
    """

    def __init__(
        self,
        scp: Scp,
        inputs: Sequence[str],
        loss: Loss,
        *,
        parameters: Mapping[str, Value] | None = None,
        method: Method = Method.UNROLLED,
    ) -> None:
        """Choose inputs and loss.

        Args:
            scp: The loop to run; `ScpOptions.for_gradients` gives accurate gradients. Not for
                use from other threads meanwhile.
            inputs: Names of the parameters that `forward` takes.
            loss: Scalar of a trace.
            parameters: Values of other parameters that differ from the defaults, SI.
            method: How to differentiate.

        Raises:
            InvalidInputError: Unknown parameter, or an invalid value.
        """
        super().__init__(scp, inputs, parameters, method)
        self._loss = loss

    def forward(
        self, initial_reference: torch.Tensor | None = None, **inputs: torch.Tensor
    ) -> LossBatch:
        """Run every sample.

        Args:
            initial_reference: (B, R) scaled reference vectors to start from; None for the
                problem's initial guess.
            **inputs: One tensor per named parameter, (B, size) or (B,) for a scalar, SI.

        Raises:
            InvalidInputError: A name or a shape does not fit. Bad values fail their sample only.
        """
        outputs, _, reports = self._solve(inputs, initial_reference)
        return LossBatch(outputs[:, 0], reports)


class DscpTrajectoryLayer(DscpLayer):
    """Final trajectory of an SCP run as a function of named parameters.

    Example:
        >>> from dscp_core import DscpTrajectoryLayer, Planner, problems
        >>> planner = Planner(problems.get("powered_descent"))
        >>> layer = DscpTrajectoryLayer(planner.scp, ("terminal_time",))
        >>> import torch
        >>> layer(terminal_time=torch.tensor([33.0, 34.0])).states.shape
        torch.Size([2, 51, 7])
    """

    def __init__(
        self,
        scp: Scp,
        inputs: Sequence[str],
        *,
        parameters: Mapping[str, Value] | None = None,
        method: Method = Method.UNROLLED,
    ) -> None:
        """Choose inputs; arguments as for `DscpLossLayer`.

        Raises:
            InvalidInputError: Unknown parameter, or an invalid value.
        """
        super().__init__(scp, inputs, parameters, method)

    def forward(
        self, initial_reference: torch.Tensor | None = None, **inputs: torch.Tensor
    ) -> TrajectoryBatch:
        """Run every sample; arguments and errors as for `DscpLossLayer.forward`."""
        outputs, packed, reports = self._solve(inputs, initial_reference)
        layout = self.transcription.layout
        nodes = outputs[:, layout.offset :].reshape(
            outputs.shape[0], layout.intervals + 1, layout.nx + layout.nu
        )
        if layout.free_terminal_time:
            time_s = outputs[:, 0] * layout.time_scale
        else:
            given = packed[:, self.transcription.table.slice(TERMINAL_TIME).start]
            usable = torch.tensor([report.usable for report in reports], dtype=torch.bool)
            time_s = torch.where(usable, given, torch.zeros_like(given))
        return TrajectoryBatch(
            states=nodes[..., : layout.nx] * torch.from_numpy(layout.state_scale),
            controls=nodes[..., layout.nx :] * torch.from_numpy(layout.control_scale),
            terminal_time_s=time_s,
            samples=reports,
        )

    def output_size(self) -> int:
        """Length R of the reference vector."""
        return self.transcription.layout.reference_size

    def output(self, trace: ScpResult) -> Array:
        """(R,) the final reference vector, scaled."""
        return trace.final_reference

    def loss_of(self, cotangent: Array) -> tuple[Loss, float]:
        """The linear functional with this gradient."""
        return SeedLoss(cotangent), 1.0


def _matrix(name: str, tensor: torch.Tensor, shape: tuple[int, int]) -> torch.Tensor:
    """The tensor on the CPU in double precision.

    Raises:
        InvalidInputError: Another shape.
    """
    if tensor.shape != shape:
        raise InvalidInputError(name, f"shape {tuple(tensor.shape)}", f"shape {shape}")
    return tensor.to(device="cpu", dtype=torch.float64)

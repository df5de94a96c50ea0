"""Terminal miss of a plan that is flown under its own controls, and its derivatives."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dscp_core.errors import InvalidInputError
from dscp_core.gradients.losses import LossGradient
from dscp_core.problem.declaration import TERMINAL_TIME, named
from dscp_core.problem.flight import ControlHold
from dscp_core.problem.tracing import known_values
from dscp_core.scp.scp import ScpResult
from dscp_core.transcription.compiled import CompiledFunction
from dscp_core.transcription.transcription import Transcription

Array = NDArray[np.float64]


class MissLoss:
    """Root sum of squares of the problem's misses, each in units of what a certificate accepts.

    The true dynamics are flown from the first node under the planned controls by the classical
    Runge-Kutta method, to the plan's end, for there the miss is smooth; a certificate flies them
    independently, with error control, and to the problem's end event. What it accepts counts as
    constant. See `dscp_core.gradients.losses.Loss`.
    """

    def __init__(
        self,
        transcription: Transcription,
        hold: ControlHold = ControlHold.MEAN,
        *,
        substeps: int = 4,
    ) -> None:
        """Compile the flight and its reverse mode.

        Args:
            transcription: Of the problem whose plans are flown.
            hold: How the controls are flown between the nodes.
            substeps: Runge-Kutta steps per interval.

        Raises:
            InvalidInputError: The problem declares no misses.
        """
        problem, layout = transcription.problem, transcription.layout
        if not problem.end_checks:
            raise InvalidInputError("loss", "miss", f"a problem with misses, not {problem.name}")
        reference = ca.MX.sym("reference", layout.reference_size)
        packed = ca.MX.sym("p", problem.table.size)
        nodes = ca.reshape(reference[layout.offset :], layout.nx + layout.nu, -1)
        controls = nodes[layout.nx :, :] * ca.repmat(
            ca.DM(layout.control_scale), 1, layout.intervals + 1
        )
        time = (
            reference[0] * layout.time_scale
            if layout.free_terminal_time
            else packed[problem.table.slice(TERMINAL_TIME)]
        )
        step = time / layout.intervals
        ends = ca.vertcat(controls[:, :-1], controls[:, 1:])
        fly = _interval(transcription, hold, substeps).mapaccum("fly", layout.intervals)
        flown = fly(
            nodes[: layout.nx, 0],
            ends,
            ca.repmat(step, 1, layout.intervals),
            ca.repmat(packed, 1, layout.intervals),
        )
        accepted = ca.MX.sym("accepted", len(problem.end_checks))
        miss = _miss(transcription)(flown[:, -1], accepted, packed)
        inputs = [reference, accepted, packed]
        self._value = CompiledFunction("miss", inputs, [miss])
        self._gradient = CompiledFunction(
            "miss_gradient", inputs, [ca.gradient(miss, reference), ca.gradient(miss, packed)]
        )

    def value(self, transcription: Transcription, trace: ScpResult) -> float:
        """See `Loss.value`."""
        return float(self._value(*_arguments(transcription, trace))[0][0])

    def gradient(self, transcription: Transcription, trace: ScpResult) -> LossGradient:
        """See `Loss.gradient`."""
        reference, parameters = self._gradient(*_arguments(transcription, trace))
        decisions = np.zeros((len(trace.iterations), transcription.layout.size))
        decisions[-1, : reference.size] = reference
        return LossGradient(decisions, parameters)


def _interval(transcription: Transcription, hold: ControlHold, substeps: int) -> ca.Function:
    """Scaled state at the end of an interval from that at its start."""
    problem, layout = transcription.problem, transcription.layout
    scale = ca.DM(layout.state_scale)
    start, ends = ca.SX.sym("x", layout.nx), ca.SX.sym("u", 2 * layout.nu)
    step, packed = ca.SX.sym("step"), ca.SX.sym("p", problem.table.size)
    parameters = named(problem, packed)
    first, last = ends[: layout.nu], ends[layout.nu :]

    def control(share: float) -> ca.SX:
        if hold is ControlHold.MEAN:
            return (first + last) / 2
        return first + share * (last - first)

    def rates(x: ca.SX, share: float) -> ca.SX:
        return problem.dynamics(x * scale, control(share), parameters) / scale

    x, size = start, step / substeps
    for number in range(substeps):
        near, middle, far = ((number + part) / substeps for part in (0.0, 0.5, 1.0))
        k1 = rates(x, near)
        k2 = rates(x + size / 2 * k1, middle)
        k3 = rates(x + size / 2 * k2, middle)
        k4 = rates(x + size * k3, far)
        x = x + size / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return ca.Function("interval", [start, ends, step, packed], [x])


def _arguments(transcription: Transcription, trace: ScpResult) -> tuple[Array, Array, Array]:
    table, packed = transcription.table, trace.parameters
    values = known_values(table, packed)
    accepted = [m.accepted(table, values) for m in transcription.problem.end_checks]
    return trace.final_reference, np.array(accepted), packed


def _miss(transcription: Transcription) -> ca.Function:
    problem, layout = transcription.problem, transcription.layout
    x, packed = ca.SX.sym("x", layout.nx), ca.SX.sym("p", problem.table.size)
    accepted = ca.SX.sym("accepted", len(problem.end_checks))
    parameters = named(problem, packed)
    state = x * ca.DM(layout.state_scale)
    misses = ca.vertcat(*(m.expression(state, parameters) for m in problem.end_checks))
    return ca.Function("miss", [x, accepted, packed], [ca.norm_2(misses / accepted)])

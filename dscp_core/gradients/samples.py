"""What became of each sample of a batch."""

from __future__ import annotations

from dataclasses import dataclass

from dscp_core.scp.gain import cost_to_gain
from dscp_core.scp.scp import Scp, ScpResult, ScpStatus


@dataclass
class SampleReport:
    """What became of one sample of a batch.

    Attributes:
        status: Why its iterations stopped; None when they never started.
        message: In words, with the numbers.
        iterations: Completed SCP iterations.
        usable: Whether outputs and gradient mean something; they are zero otherwise. True also
            for a run that reached its iteration limit or kept virtual control: see `status`.
        certified: Whether the trajectory can be flown; None where it was not flown: a sample that
            is not usable, or a layer that was not made by a planner.
        converged: Whether the iterations stopped because nothing changed any more, at a trajectory
            that satisfies the dynamics.
        cost_to_gain: Estimate, from above, of what the trajectory costs more than a local optimum,
            in the unit of the problem's cost; None where it is unknown.
        trusted: Verdict on the gradient; None before the backward pass.
        reasons: Why the gradient is not trusted, or why it was set to zero.
    """

    status: ScpStatus | None
    message: str
    iterations: int
    usable: bool
    certified: bool | None
    converged: bool
    cost_to_gain: float | None
    trusted: bool | None = None
    reasons: tuple[str, ...] = ()


def report_of(
    scp: Scp, trace: ScpResult | None, message: str, usable: bool, certified: bool | None
) -> SampleReport:
    """Report of a sample's run, before the backward pass.

    Args:
        scp: The loop that ran.
        trace: Its trace, or None where it never started.
        message: In words.
        usable: Whether it has an output.
        certified: Verdict of a certificate, if there is one.
    """
    if trace is None:
        return SampleReport(None, message, 0, usable, certified, False, None)
    last = trace.iterations[-1] if trace.iterations else None
    return SampleReport(
        status=trace.status,
        message=message,
        iterations=len(trace.iterations),
        usable=usable,
        certified=certified,
        converged=trace.status is ScpStatus.CONVERGED
        and last is not None
        and scp.satisfies_dynamics(last),
        cost_to_gain=None if last is None or not usable else cost_to_gain(scp, last),
    )

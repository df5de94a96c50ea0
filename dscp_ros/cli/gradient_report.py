"""What `dscp gradient` finds out, and how it is told."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from dscp_core.gradients.differences import Difference, RunDifferences, relative_error
from dscp_core.gradients.losses import ConvergenceLoss, CostLoss, FinalStateLoss, Loss
from dscp_core.gradients.run import DifferentiationError, implicit, unrolled
from dscp_core.scp.scp import Scp, ScpResult, ScpStatus

LOSSES: dict[str, Loss] = {
    "final_mass": FinalStateLoss("mass", 1.0),
    "cost": CostLoss(),
    "convergence": ConvergenceLoss(),
}


@dataclass(frozen=True)
class ParameterGradient:
    """Gradient with respect to one parameter.

    Attributes:
        name: Name of the parameter.
        unit: Its unit.
        is_vector: Whether its values are sequences.
        values: Derivative per component and SI unit.
        differences: Finite difference per component; empty without a check.
    """

    name: str
    unit: str
    is_vector: bool
    values: tuple[float, ...]
    differences: tuple[Difference, ...] = ()

    @cached_property
    def relative_errors(self) -> tuple[float | None, ...]:
        """Disagreement per component, relative to the largest component."""
        found = [d.value for d in self.differences if d.value is not None]
        size = max(map(abs, (*self.values, *found)))
        pairs = zip(self.values, self.differences, strict=True)
        return tuple(relative_error(value, d, size) for value, d in pairs)

    def shaped(self, items: Sequence[Any]) -> Any:
        """A list for a vector parameter, the item itself for a scalar."""
        return list(items) if self.is_vector else items[0]

    def label(self, component: int) -> str:
        """Name of a component."""
        return f"{self.name}[{component}]" if self.is_vector else self.name

    def notes(self) -> list[str]:
        """What a reader of the comparison should know."""
        found = []
        for component, (d, error) in enumerate(
            zip(self.differences, self.relative_errors, strict=True)
        ):
            label = self.label(component)
            if d.value is None:
                found.append(f"{label}: no difference, {d.rejected} steps had runs that failed")
            elif error is None:
                found.append(
                    f"{label}: zero within the uncertainty {d.uncertainty:.1e} of the difference"
                )
            if d.crosses_active_set_change:
                found.append(
                    f"{label}: an active set changes {d.active_set_radius:.1e} {self.unit} away, "
                    f"within the step {d.step:.1e}: the derivative may jump there"
                )
        return found


@dataclass(frozen=True)
class GradientReport:
    """A gradient, its verdict and its check.

    Attributes:
        of: What was differentiated, a key of `LOSSES`.
        method: How.
        status: How the iterations ended.
        infeasible: Whether they ended without a feasible trajectory.
        iterations: Their number K.
        value: What was differentiated; None without a gradient.
        trusted: Whether the gradient can be relied upon.
        reasons: Why not.
        parameters: Gradients by parameter; empty where there is none.
    """

    of: str
    method: str
    status: str
    infeasible: bool
    iterations: int
    value: float | None
    trusted: bool
    reasons: tuple[str, ...]
    parameters: tuple[ParameterGradient, ...]

    @property
    def notes(self) -> list[str]:
        """Remarks on the check."""
        return [note for p in self.parameters if p.differences for note in p.notes()]

    def as_dict(self) -> dict[str, Any]:
        """The report by name, for JSON."""
        report: dict[str, Any] = {
            "of": self.of,
            "wrt": [p.name for p in self.parameters],
            "units": {p.name: p.unit for p in self.parameters},
            "method": self.method,
            "status": self.status,
            "iterations": self.iterations,
            "value": self.value,
            "gradient": self._by_name(lambda p: p.shaped(p.values)),
            "trusted": self.trusted,
            "reasons": self.reasons,
        }
        if not any(p.differences for p in self.parameters):
            return report
        return report | {
            "central_difference": self._by_name(
                lambda p: p.shaped([d.value for d in p.differences])
            ),
            "relative_error": self._by_name(lambda p: p.shaped(p.relative_errors)),
            "check": self._by_name(lambda p: p.shaped([_described(d) for d in p.differences])),
            "notes": self.notes,
        }

    def _by_name(self, pick: Callable[[ParameterGradient], Any]) -> Any:
        if not self.parameters:
            return None
        if len(self.parameters) == 1:
            return pick(self.parameters[0])
        return {p.name: pick(p) for p in self.parameters}


def differentiate(
    scp: Scp, trace: ScpResult, of: str, names: Sequence[str], method: str
) -> GradientReport:
    """Gradient of a run.

    Args:
        scp: The loop that made the trace, with options for gradients.
        trace: Its result.
        of: Key of `LOSSES`.
        names: Parameters.
        method: ``"unrolled"`` or ``"implicit"``.

    Raises:
        InvalidInputError: Unknown name, or a quantity that the method cannot differentiate.
    """
    infeasible = _infeasible(scp, trace, method)
    report = GradientReport(
        of=of,
        method=method,
        status="infeasible" if infeasible else trace.status.name.lower(),
        infeasible=infeasible,
        iterations=len(trace.iterations),
        value=None,
        trusted=False,
        reasons=(),
        parameters=(),
    )
    compute = unrolled if method == "unrolled" else implicit
    try:
        gradient = compute(scp, trace, LOSSES[of])
    except DifferentiationError as error:
        return replace(report, infeasible=True, reasons=(str(error),))
    reasons = gradient.reasons
    if infeasible:
        reasons += (f"no feasible trajectory: {trace.message}",)
    elif trace.status is ScpStatus.ITERATION_LIMIT:
        reasons += (f"not converged, so not the gradient of an optimum: {trace.message}",)
    table = scp.transcription.table
    parameters = tuple(
        ParameterGradient(
            name,
            table[name].unit,
            table[name].is_vector,
            tuple(gradient.parameters[table.slice(name)].tolist()),
        )
        for name in names
    )
    return replace(
        report,
        value=gradient.value,
        trusted=not reasons,
        reasons=reasons,
        parameters=parameters,
    )


def check(scp: Scp, trace: ScpResult, report: GradientReport, step: float | None) -> GradientReport:
    """The report with finite differences.

    Raises:
        InvalidInputError: A step that cannot be taken.
    """
    runs = RunDifferences(scp, trace, LOSSES[report.of])
    return replace(
        report,
        parameters=tuple(
            replace(
                p,
                differences=tuple(
                    runs.derivative(p.name, component, step=step)
                    for component in range(len(p.values))
                ),
            )
            for p in report.parameters
        ),
    )


def _infeasible(scp: Scp, trace: ScpResult, method: str) -> bool:
    """Whether iterations that were meant to converge left virtual control."""
    if trace.status in (ScpStatus.INFEASIBLE, ScpStatus.SUBPROBLEM_INFEASIBLE):
        return True
    if method != "implicit" or not trace.iterations:
        return False
    scale = scp.transcription.layout.state_scale
    left = float(np.max(np.abs(trace.iterations[-1].virtual_control) / scale))
    return left > scp.virtual_control_tolerance


def _described(difference: Difference) -> dict[str, Any]:
    return {
        "kind": difference.kind,
        "step": difference.step,
        "uncertainty": difference.uncertainty,
        "active_set_radius": difference.active_set_radius,
        "crosses_active_set_change": difference.crosses_active_set_change,
        "rejected_steps": difference.rejected,
    }

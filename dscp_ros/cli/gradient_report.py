"""What `dscp gradient` finds out, and how it is told."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from dscp_core.gradients.differences import Difference, RunDifferences, relative_error
from dscp_core.gradients.gradient import Gradient, Method
from dscp_core.gradients.quantities import Quantity
from dscp_core.gradients.run import DifferentiationError, of_plan
from dscp_core.scp.scp import Scp, ScpResult, ScpStatus


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
        of: What was differentiated.
        method: How.
        status: How the iterations ended.
        iterations: Their number K.
        gradient: The gradient; None where there is none.
        failure: Why there is none; else empty.
        parameters: Gradients by parameter; empty where there is none.
    """

    of: Quantity
    method: Method
    status: ScpStatus
    iterations: int
    gradient: Gradient | None
    failure: str
    parameters: tuple[ParameterGradient, ...]

    @property
    def infeasible(self) -> bool:
        """Whether the iterations ended without a feasible trajectory, or the way to one was asked.

        A few unrolled iterations that do not satisfy the dynamics yet have a gradient all the same.
        """
        if self.gradient is None or self.status is ScpStatus.INFEASIBLE:
            return True
        return self.method is Method.IMPLICIT and not self.gradient.feasible

    @property
    def trusted(self) -> bool:
        """Whether the gradient can be relied upon."""
        return self.gradient is not None and self.gradient.trusted

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why not."""
        return (self.failure,) if self.gradient is None else self.gradient.reasons

    @property
    def headline(self) -> str:
        """The gradient of what, of which run, and whether it can be trusted, in one line."""
        if self.gradient is not None:
            return self.gradient.headline
        return f"NO GRADIENT of {self.of.name}: {' '.join(self.failure.split())}"

    @property
    def notes(self) -> list[str]:
        """Remarks on the check."""
        return [note for p in self.parameters if p.differences for note in p.notes()]

    def as_dict(self) -> dict[str, Any]:
        """The report by name, for JSON."""
        gradient = self.gradient
        report: dict[str, Any] = {
            "headline": self.headline,
            "of": self.of.name,
            "unit": self.of.unit,
            "wrt": [p.name for p in self.parameters],
            "units": {p.name: p.unit for p in self.parameters},
            "method": self.method,
            "status": "infeasible" if self.infeasible and gradient else self.status,
            "feasible": gradient is not None and gradient.feasible,
            "converged": gradient is not None and gradient.converged,
            "iterations": self.iterations,
            "terminal_time_s": None if gradient is None else gradient.terminal_time_s,
            "terminal_time_source": None
            if gradient is None
            else ("free" if gradient.free_terminal_time else "fixed"),
            "value": None if gradient is None else gradient.value,
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
    scp: Scp, trace: ScpResult, of: Quantity, names: Sequence[str], method: Method
) -> GradientReport:
    """Gradient of a run.

    Args:
        scp: The loop that made the trace, with options for gradients.
        trace: Its result.
        of: What of it.
        names: Parameters.
        method: How.

    Raises:
        InvalidInputError: Unknown name, or a quantity that the method cannot differentiate.
    """
    gradient, failure = None, ""
    try:
        gradient = of_plan(scp, trace, of.loss, method)
    except DifferentiationError as error:
        failure = str(error)
    table = scp.transcription.table
    parameters = tuple(
        ParameterGradient(
            name,
            table[name].unit,
            table[name].is_vector,
            tuple(gradient.parameters[table.slice(name)].tolist()),
        )
        for name in names
        if gradient is not None
    )
    return GradientReport(
        of, method, trace.status, len(trace.iterations), gradient, failure, parameters
    )


def check(scp: Scp, trace: ScpResult, report: GradientReport, step: float | None) -> GradientReport:
    """The report with finite differences.

    Raises:
        InvalidInputError: A step that cannot be taken.
    """
    runs = RunDifferences(scp, trace, report.of.loss)
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


def _described(difference: Difference) -> dict[str, Any]:
    return {
        "kind": difference.kind,
        "step": difference.step,
        "uncertainty": difference.uncertainty,
        "active_set_radius": difference.active_set_radius,
        "crosses_active_set_change": difference.crosses_active_set_change,
        "rejected_steps": difference.rejected,
    }

"""What the planner reported in a log, in figures."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from dscp_core.planning.plan import PlanStatus
from msg_adapters.report import PlanReport

UNKNOWN_SET = "unknown"
"""Stands for the set of reports that name none: those of older nodes."""


@dataclass
class ReportSummary:
    """Figures of the reports of one log.

    Attributes:
        codes: Number of reports by the name of their code.
        parameter_sets: Number of attempts by the parameter set that they were made with.
        attempts: Reports of planning attempts.
        iterations: SCP iterations of all of them.
        solve_time_ms: Wall time of all of them.
    """

    codes: Counter[str] = field(default_factory=Counter)
    parameter_sets: Counter[str] = field(default_factory=Counter)
    attempts: int = 0
    iterations: int = 0
    solve_time_ms: float = 0.0

    def count(self, report: PlanReport) -> None:
        """Count one report."""
        self.codes[report.code_name] += 1
        if report.attempt is not None:
            self.attempts += 1
            self.parameter_sets[report.parameter_set or UNKNOWN_SET] += 1
            self.iterations += report.attempt.iterations
            self.solve_time_ms += report.attempt.solve_time_ms or 0.0

    @property
    def certified(self) -> int:
        """Attempts that gave a certified plan."""
        return self.codes[PlanStatus.CERTIFIED.name]

    def document(self) -> dict[str, Any]:
        """The figures for JSON; None where there was no attempt."""
        return {
            "codes": dict(self.codes),
            "parameter_sets": dict(self.parameter_sets),
            "attempts": self.attempts,
            "certified": self.certified,
            "mean_iterations": self.iterations / self.attempts if self.attempts else None,
            "mean_solve_time_ms": self.solve_time_ms / self.attempts if self.attempts else None,
        }

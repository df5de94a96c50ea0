"""What a recording of the planner says: counted from its reports, printed as a table."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dscp_core.planning.plan import PlanStatus
from dscp_ros.bag import BagReader
from dscp_ros.demo.session import REPORT, InputBag
from msg_adapters.report import PlanReport
from msg_adapters.report_message import report_from_message

_STAMP_MARGIN_NS = 60 * 10**9
"""How far a stamp may be outside of its bag: stale and future ones are."""
_MASS_SOURCE = "mass"
_NAME_WIDTH, _WIDTH = 32, 13

Row = tuple[str, list[str]]
"""Name, and a cell per column."""


@dataclass(frozen=True)
class Figures:
    """What became of some states.

    Attributes:
        name: Where they came from.
        states: States replayed.
        attempts: Reports of planning attempts.
        refusals: Reports of refused inputs.
    """

    name: str
    states: int
    attempts: tuple[PlanReport, ...]
    refusals: tuple[PlanReport, ...]

    @property
    def certified(self) -> int:
        """Attempts that ended with a certified plan."""
        return sum(report.code == PlanStatus.CERTIFIED for report in self.attempts)

    @property
    def superseded(self) -> int:
        """States that were neither planned from nor refused: a newer one came first."""
        refused = sum(report.source != _MASS_SOURCE for report in self.refusals)
        return self.states - len(self.attempts) - refused


def read_reports(recording: Path) -> list[PlanReport]:
    """Every report of a recording, in order.

    Raises:
        BagError: The recording cannot be read.
        RejectedInputError: A report cannot be understood.
    """
    with BagReader(recording, strict=True) as reader:
        return [report_from_message(message) for _, message in reader.decoded_messages([REPORT])]


def figures_of(bag: InputBag, reports: Iterable[PlanReport]) -> Figures:
    """Figures of one bag; its reports are known by the stamps of their inputs."""
    first_ns, last_ns = bag.start_ns - _STAMP_MARGIN_NS, bag.end_ns + _STAMP_MARGIN_NS
    own = [
        report
        for report in reports
        if report.input_stamp_ns is not None and first_ns <= report.input_stamp_ns <= last_ns
    ]
    return Figures(
        bag.name,
        bag.states,
        tuple(report for report in own if report.rejection is None),
        tuple(report for report in own if report.rejection is not None),
    )


def table(parts: Sequence[Figures]) -> str:
    """The table: a column per bag and one for all; then the refused inputs by cause."""
    everything = Figures(
        "all",
        sum(part.states for part in parts),
        tuple(report for part in parts for report in part.attempts),
        tuple(report for part in parts for report in part.refusals),
    )
    columns = [*parts, everything] if len(parts) > 1 else list(parts)
    rows = [
        ("", [_short(c.name) for c in columns]),
        ("states replayed", [str(c.states) for c in columns]),
        ("inputs refused", [str(len(c.refusals)) for c in columns]),
        ("superseded by a newer state", [str(c.superseded) for c in columns]),
        *attempt_rows(columns),
    ]
    sets = parameter_set_lines(everything.attempts)
    return "\n".join([*lines_of(rows), "", *sets, "", *_refusal_lines(everything.refusals)])


def attempt_rows(columns: Sequence[Figures]) -> list[Row]:
    """What became of the attempts, and what they took: a cell per column."""
    failures = sorted(
        {(r.code, r.code_name) for c in columns for r in c.attempts}
        - {(int(PlanStatus.CERTIFIED), PlanStatus.CERTIFIED.name)}
    )
    rows = [
        ("planning attempts", [str(len(c.attempts)) for c in columns]),
        ("  certified", [str(c.certified) for c in columns]),
    ]
    for code, name in failures:
        counts = [sum(r.code == code for r in c.attempts) for c in columns]
        rows.append((f"  {name} ({code})", [str(count) for count in counts]))
    return [
        *rows,
        ("iterations, mean / max", [_iterations(c) for c in columns]),
        ("planning, median / p99 [ms]", [_median_p99(_solve_times(c)) for c in columns]),
        ("latency, median / p99 [ms]", [_median_p99(_latencies(c)) for c in columns]),
        ("largest miss [m]", [_largest(c, "miss_position_m") for c in columns]),
        ("largest speed error [m/s]", [_largest(c, "miss_speed_m_s") for c in columns]),
    ]


def lines_of(rows: Sequence[Row]) -> list[str]:
    """Rows as lines of a table."""
    return [
        f"{name:<{_NAME_WIDTH}}" + "".join(f"{cell:>{_WIDTH}}" for cell in cells)
        for name, cells in rows
    ]


def parameter_set_lines(attempts: Sequence[PlanReport]) -> list[str]:
    """With which parameter sets the attempts were made."""
    counts = Counter(report.parameter_set or "not reported" for report in attempts)
    return [f"parameter set {name}: {count} attempts" for name, count in counts.items()]


def _refusal_lines(refusals: Sequence[PlanReport]) -> list[str]:
    if not refusals:
        return ["no input was refused"]
    lines = ["refused inputs", f"  {'code':<5} {'cause':<20} {'count':>5}  first one"]
    counts = Counter((report.code, report.code_name) for report in refusals)
    for (code, name), count in sorted(counts.items()):
        first = next(report.rejection for report in refusals if report.code == code)
        assert first is not None  # a refusal has its cause
        value = first.value or "(empty)"
        lines.append(
            f"  {code:<5} {name:<20} {count:>5}  {first.field}: {value}, not {first.bound}"
        )
    return lines


def _short(name: str) -> str:
    """Last word of a bag's name, cut to its column."""
    return name.removesuffix(".mcap").rpartition("_")[2][: _WIDTH - 1]


def _iterations(figures: Figures) -> str:
    counts = [r.attempt.iterations for r in figures.attempts if r.attempt is not None]
    return f"{np.mean(counts):.1f} / {max(counts)}" if counts else "-"


def _solve_times(figures: Figures) -> list[float]:
    attempts = (report.attempt for report in figures.attempts)
    return [a.solve_time_ms for a in attempts if a is not None and a.solve_time_ms is not None]


def _latencies(figures: Figures) -> list[float]:
    """From the arrival of a state to the publishing of its plan."""
    return [
        report.latency_ms
        for report in figures.attempts
        if report.published and report.latency_ms is not None
    ]


def _median_p99(values_ms: Sequence[float]) -> str:
    if not values_ms:
        return "-"
    median, p99 = np.percentile(values_ms, [50, 99])
    return f"{median:.0f} / {p99:.0f}"


def _largest(figures: Figures, name: str) -> str:
    """Largest value of a figure of the certificates that passed."""
    certificates = (report.certificate for report in figures.attempts if report.published)
    values = [c.values[name] for c in certificates if c is not None and name in c.values]
    return f"{max(values):.3f}" if values else "-"

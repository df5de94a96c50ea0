"""What a benchmark returns, as text for people and JSON for scripts."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

Cell = str | int | float


@dataclass(frozen=True)
class Target:
    """What a figure should be.

    Attributes:
        relation: ``"<="`` or ``">="``.
        bound: In the figure's unit.
    """

    relation: str
    bound: float

    def met_by(self, value: float) -> bool:
        """Whether a value is on the right side; NaN never is."""
        return value <= self.bound if self.relation == "<=" else value >= self.bound


@dataclass(frozen=True)
class Figure:
    """One measured number.

    Attributes:
        what: What was measured.
        value: The number; NaN if it could not be measured.
        unit: Its unit; ``"1"`` for a pure number.
        target: What it should be, or None.
    """

    what: str
    value: float
    unit: str = "1"
    target: Target | None = None

    @property
    def met(self) -> bool | None:
        """Whether the target is met; None without one."""
        return None if self.target is None else self.target.met_by(self.value)


@dataclass(frozen=True)
class Table:
    """Numbers that belong together.

    Attributes:
        title: What they are, with unit.
        header: Names of the columns.
        rows: One cell per column.
    """

    title: str
    header: tuple[str, ...]
    rows: list[tuple[Cell, ...]]


@dataclass
class Report:
    """Outcome of one benchmark.

    Attributes:
        name: Name of the benchmark.
        figures: Numbers beside their targets.
        tables: Breakdowns.
        notes: How it was measured, and what else to know.
        seconds: Wall time of the benchmark.
        core_share: CPU time of the process over its wall time; well below 1 on a machine that
            others use too, where wall times are too long.
    """

    name: str
    figures: list[Figure] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    seconds: float = math.nan
    core_share: float = math.nan

    def add(
        self, what: str, value: float, unit: str = "1", target: tuple[str, float] | None = None
    ) -> None:
        """Append a figure."""
        self.figures.append(
            Figure(what, float(value), unit, None if target is None else Target(*target))
        )

    def text(self) -> str:
        """For a terminal."""
        lines = [f"== {self.name}  ({self.seconds:.0f} s, {self.core_share:.0%} of a core)"]
        lines += _aligned(
            ("figure", "measured", "target", ""),
            [(f.what, _with_unit(f.value, f.unit), _target(f), _mark(f)) for f in self.figures],
        )
        for table in self.tables:
            lines += ["", f"-- {table.title}", *_aligned(table.header, table.rows)]
        lines += ["", *(f"   {note}" for note in self.notes)] if self.notes else []
        return "\n".join(lines)

    def write(self, folder: Path) -> Path:
        """Write ``NAME.json`` and return its path."""
        content = asdict(self)
        for entry, figure in zip(content["figures"], self.figures, strict=True):
            entry["met"] = figure.met
        path = folder / f"{self.name}.json"
        path.write_text(json.dumps(_finite(content), indent=2) + "\n", encoding="utf-8")
        return path


def _with_unit(value: float, unit: str) -> str:
    if unit in ("%", "s"):
        return f"{value:.6g} {unit}"
    return _cell(value) if unit == "1" else f"{_cell(value)} {unit}"


def _target(figure: Figure) -> str:
    if figure.target is None:
        return ""
    return f"{figure.target.relation} {_with_unit(figure.target.bound, figure.unit)}"


def _mark(figure: Figure) -> str:
    return {None: "", True: "met", False: "MISSED"}[figure.met]


def _cell(value: Cell) -> str:
    if not isinstance(value, float):
        return str(value)
    if math.isfinite(value) and 0.01 <= abs(value) < 1e6:
        return f"{value:.4g}" if abs(value) < 1e4 else f"{value:.8g}"
    return f"{value:.2g}"


def _aligned(header: Sequence[str], rows: Sequence[Sequence[Cell]]) -> list[str]:
    """Lines of a table; columns of text to the left, of numbers to the right."""
    cells = [tuple(header), *(tuple(_cell(value) for value in row) for row in rows)]
    lines = [""] * len(cells)
    for i in range(len(header)):
        width = max(len(row[i]) for row in cells)
        numbers = any(not isinstance(row[i], str) for row in rows)
        for number, row in enumerate(cells):
            lines[number] += "  " + (row[i].rjust(width) if numbers else row[i].ljust(width))
    return [f" {line}".rstrip() for line in lines]


def _finite(value: Any) -> Any:
    """JSON has no NaN and no infinity: both become null."""
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value

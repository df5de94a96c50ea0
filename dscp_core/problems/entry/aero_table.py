"""Aerodynamic coefficients from a table of a vehicle file, fitted by the model's polynomials."""

from __future__ import annotations

import csv
import itertools
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dscp_core.errors import InvalidInputError
from dscp_core.problem.parameters import Value

Array = NDArray[np.float64]

COLUMNS = ("angle_of_attack", "mach", "lift", "drag")

_WORST_FIT = 0.05
"""Of the largest coefficient in the table; beyond, the polynomials are another vehicle's."""
_NAMED_GAPS = 3


def read_aerodynamic_table(path: Path) -> dict[str, Value]:
    """Coefficients that fit a table best, by least squares.

    Args:
        path: CSV file with the columns of `COLUMNS`: angle of attack in rad, Mach number, C_L and
            C_D; one row for every pair of the angles and Mach numbers that occur.

    Returns:
        ``lift_coefficients`` and ``drag_coefficients``.

    Raises:
        InvalidInputError: The file cannot be read, a number is missing or is none, a pair is
            missing or there twice, or the polynomials do not fit.
    """
    rows = _read(path)
    alpha, mach, lift, drag = rows.T
    _check_grid(path, alpha, mach)
    bases = {
        "lift": (np.column_stack([alpha, alpha**2, alpha * mach]), lift),
        "drag": (np.column_stack([np.ones_like(mach), mach, alpha**2, mach**2]), drag),
    }
    return {f"{n}_coefficients": _fit(path, n, basis, c) for n, (basis, c) in bases.items()}


def _read(path: Path) -> Array:
    """(rows, 4) numbers in the order of `COLUMNS`."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            header, records = reader.fieldnames or (), list(reader)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InvalidInputError(
            "aerodynamic_table", str(path), f"a readable file ({error})"
        ) from None
    if sorted(header) != sorted(COLUMNS):
        raise InvalidInputError(f"columns of {path}", list(header), ", ".join(COLUMNS))
    numbers = np.array(
        [[_number(path, i, r, c) for c in COLUMNS] for i, r in enumerate(records, 2)]
    )
    if not numbers.size:
        raise InvalidInputError(f"rows of {path}", 0, ">= 1")
    return numbers


def _number(path: Path, line: int, record: dict[str, str], column: str) -> float:
    text = record[column]
    try:
        value = float(text)
    except (TypeError, ValueError):
        value = np.nan
    if not np.isfinite(value):
        raise InvalidInputError(f"{column} in line {line} of {path}", text, "a finite number")
    return value


def _check_grid(path: Path, alpha: Array, mach: Array) -> None:
    """Every pair of the angles and Mach numbers exactly once."""
    counts = Counter(zip(alpha.tolist(), mach.tolist(), strict=True))
    grid = itertools.product(np.unique(alpha).tolist(), np.unique(mach).tolist())
    gaps = [pair for pair in grid if pair not in counts]
    twice = [pair for pair, count in counts.items() if count > 1]
    for found, what in ((gaps, "no gap"), (twice, "each once")):
        if found:
            raise InvalidInputError(f"rows of {path}", _named(found), f"(angle, Mach): {what}")


def _named(pairs: Sequence[tuple[float, float]]) -> str:
    shown = ", ".join(f"({a:g} rad, Mach {m:g})" for a, m in pairs[:_NAMED_GAPS])
    more = len(pairs) - _NAMED_GAPS
    return f"{shown} and {more} more" if more > 0 else shown


def _fit(path: Path, name: str, basis: Array, values: Array) -> tuple[float, ...]:
    found, _, rank, _ = np.linalg.lstsq(basis, values)
    if rank < basis.shape[1]:
        bound = f"points enough for {basis.shape[1]} coefficients"
        raise InvalidInputError(f"{name} in {path}", f"{len(values)} rows of rank {rank}", bound)
    largest = float(np.abs(values).max())
    worst = float(np.abs(basis @ found - values).max())
    if worst > _WORST_FIT * largest:
        bound = f"within {_WORST_FIT:.0%} of the largest, {largest:.3g}"
        raise InvalidInputError(f"{name} in {path}", f"{worst:.3g} off its best polynomial", bound)
    return tuple(found.tolist())

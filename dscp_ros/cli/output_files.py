"""Files that commands write: complete, or not there."""

from __future__ import annotations

import contextlib
import csv
import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dscp_core.errors import InvalidInputError
from dscp_ros.cli.arguments import json_ready

if TYPE_CHECKING:
    from dscp_core.problem.declaration import OptimalControlProblem
    from dscp_core.problem.trajectory import Plan


def check_folder(path: Path, option: str = "--output") -> None:
    """Refuses a place for files that is a file itself, or in one.

    Raises:
        InvalidInputError: It is.
    """
    there = next(part for part in (path, *path.absolute().parents) if os.path.lexists(part))
    if not there.is_dir():
        raise InvalidInputError(option, str(path), "a directory")


def check_output_path(option: str, path: Path, suffixes: tuple[str, ...]) -> None:
    """Refuses a path that cannot be written to, before the work is done.

    Raises:
        InvalidInputError: Another suffix, a missing directory, or a directory.
    """
    if path.suffix.lower() not in suffixes:
        raise InvalidInputError(option, str(path), f"a file name ending in {' or '.join(suffixes)}")
    if path.is_dir():
        raise InvalidInputError(option, str(path), "a file, not a directory")
    if not path.parent.is_dir():
        raise InvalidInputError(option, str(path), "a file in an existing directory")


@contextlib.contextmanager
def complete_file(path: Path) -> Iterator[Path]:
    """Gives a temporary path beside ``path``, which replaces ``path`` if the block succeeds.

    Raises:
        OSError: The file cannot be written or moved.
    """
    partial = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
    try:
        yield partial
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def write_csv(path: Path, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Writes a table; an empty cell stands for None.

    Raises:
        OSError: The file cannot be written.
    """
    with complete_file(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows(rows)


def write_trajectory(
    path: Path, plan: Plan, problem: OptimalControlProblem, description: Mapping[str, Any]
) -> None:
    """Writes a plan as CSV, one row per node, or as JSON with its description.

    Raises:
        OSError: The file cannot be written.
    """
    states = [with_unit(s.name, s.unit) for s in problem.states]
    controls = [with_unit(c.name, c.unit) for c in problem.controls]
    if path.suffix.lower() == ".csv":
        nodes = zip(
            plan.times_s.tolist(), plan.states.tolist(), plan.controls.tolist(), strict=True
        )
        write_csv(path, ("time_s", *states, *controls), ((t, *x, *u) for t, x, u in nodes))
        return
    content = {
        **description,
        "trajectory": {
            "state_columns": states,
            "control_columns": controls,
            "times_s": plan.times_s,
            "states": plan.states,
            "controls": plan.controls,
            "state_rates": plan.state_rates,
        },
    }
    with complete_file(path) as partial:
        partial.write_text(json.dumps(json_ready(content), allow_nan=False), encoding="utf-8")


def with_unit(name: str, unit: str) -> str:
    """A key or column that tells its unit, such as ``speed_m_s``."""
    suffix = re.sub(r"[^a-z0-9]+", "_", unit.lower().replace("^", "")).strip("_")
    return name if suffix in ("", "1") else f"{name}_{suffix}"

"""Training the terminal-time network: error against wall time, the paper's recipe and ours."""

from __future__ import annotations

import math
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.report import Cell, Report, Table
from dscp_core.learning.checkpoint import CHECKPOINT_FILE, Checkpoint
from dscp_core.workers.choice import available_cores

VERTICAL, HORIZONTAL = 3e-4, 4e-4
"""What the paper reached: greatest relative error on its two profiles."""

TIME_TARGET_S = 1200.0
QUICK_BUDGET_S, BUDGET_S = 120.0, 600.0
QUICK = ("--labels", "1024", "--steps", "150", "--rounds", "0")
ROWS = 12
POLL_S = 1.0
ERRORS = {
    "validation_mean": "mean",
    "validation_p99": "p99",
    "vertical_max": "vertical",
    "horizontal_max": "horizontal",
}
"""Of a history entry: mean and p99 on the validation set, greatest on the profiles."""

COMMAND = "import sys; from dscp_ros.cli.main import main; sys.exit(main())"

History = Sequence[Mapping[str, Any]]


def measure(*, quick: bool) -> Report:
    """Run both recipes for the same wall time, ours until it is as accurate as the paper."""
    report = Report("training")
    budget_s = QUICK_BUDGET_S if quick else BUDGET_S
    ours, ours_s = _train(budget_s, "default", QUICK if quick else (), until_accurate=True)
    theirs, theirs_s = _train(budget_s, "paper", ())
    for label, history, target in (
        ("default recipe", ours, ("<=", TIME_TARGET_S)),
        ("paper's recipe", theirs, None),
    ):
        reached = accurate_after_s(history)
        report.add(f"{label}: time to the paper's accuracy", reached, "s", target)
        for key, name in ERRORS.items():
            report.add(f"{label}: least error, {name}", _least(history, key))
    report.tables.append(_curve(ours, theirs, max(ours_s, theirs_s)))
    report.notes += [
        f"both as `dscp train terminal-time` on {available_cores()} cores, at most {budget_s:.0f} "
        "s each (the default recipe until it is as accurate as the paper); wall time and history "
        "include labelling the validation set (512 states) and the profiles (49 states each)",
        f"the paper's accuracy: greatest relative error {VERTICAL:g} on the vertical and "
        f"{HORIZONTAL:g} on the horizontal profile; nan: not within this time",
    ]
    if quick:
        report.notes.append(f"the default recipe with {' '.join(QUICK)}, to be quick")
    return report


def accurate_after_s(history: History) -> float:
    """Wall time after which both profiles are as accurate as the paper's; NaN if never."""
    for entry in history:
        if entry["vertical_max"] < VERTICAL and entry["horizontal_max"] < HORIZONTAL:
            return float(entry["elapsed_s"])
    return math.nan


def _train(
    budget_s: float, recipe: str, options: Sequence[str], *, until_accurate: bool = False
) -> tuple[History, float]:
    """History of a training that is ended after a while, and how long it ran."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-c", COMMAND, "train", "terminal-time"]
        started = time.monotonic()
        process = subprocess.Popen(
            [*command, "--json", "--recipe", recipe, "--output", folder, *options],
            stdout=subprocess.DEVNULL,
        )
        try:
            while process.poll() is None and time.monotonic() - started < budget_s:
                time.sleep(POLL_S)
                if until_accurate and math.isfinite(accurate_after_s(_history(folder))):
                    break
        finally:
            process.send_signal(signal.SIGINT)
            process.wait()
        return _history(folder), time.monotonic() - started


def _history(folder: str) -> History:
    path = Path(folder) / CHECKPOINT_FILE
    if not path.exists():
        return []
    history: History = Checkpoint.load(path).document["history"]
    return history


def _curve(ours: History, theirs: History, seconds: float) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for number in range(1, ROWS + 1):
        moment = number * seconds / ROWS
        rows.append((round(moment), *_at(ours, moment), *_at(theirs, moment)))
    return Table(
        "relative error after so many seconds of wall time: ours | the paper's recipe",
        ("s", *ERRORS.values(), *(f"| {name}" for name in ERRORS.values()), "| failures"),
        [(*row, _failures(theirs, float(row[0]))) for row in rows],
    )


def _at(history: History, moment: float) -> tuple[float, ...]:
    """Errors of the last network before a moment."""
    known = [entry for entry in history if entry["elapsed_s"] <= moment]
    return tuple(float(known[-1][key]) if known else math.nan for key in ERRORS)


def _failures(history: History, moment: float) -> Cell:
    known = [entry for entry in history if entry["elapsed_s"] <= moment]
    return int(known[-1]["failures"]) if known else "-"


def _least(history: History, key: str) -> float:
    return min((float(entry[key]) for entry in history), default=math.nan)

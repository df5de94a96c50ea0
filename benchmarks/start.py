"""CPU time of fresh interpreters: what a user waits for before anything is computed."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np

from benchmarks.report import Report

_COMMAND = "import sys; from dscp_ros.cli.main import main; sys.exit(main({}))"
_PLAN = """
from dscp_core import Planner, problems
planner = Planner(problems.get("powered_descent"))
outcome = planner.plan()
"""
_GRADIENT = f"""{_PLAN}
gradient = planner.gradient("cost", at=outcome)
gradient["specific_impulse"]
"""
_LAYER = f"""{_PLAN}
import torch
layer = planner.layer("cost", inputs=("initial_state", "terminal_time"))
x = torch.tensor(planner.initial_state[None], requires_grad=True)
layer(initial_state=x, terminal_time=torch.tensor([32.81])).sum().backward()
"""

# What runs, and its target in seconds of CPU.
_CASES: tuple[tuple[str, str, float | None], ...] = (
    ("an empty program", "", None),
    ("import dscp_core", "import dscp_core", 0.3),
    ("from dscp_core import Planner", "from dscp_core import Planner", None),
    ("dscp --help", _COMMAND.format(["--help"]), 0.1),
    ("dscp plan --help", _COMMAND.format(["plan", "--help"]), None),
    ("a certified plan, four lines of Python", _PLAN, None),
    ("and its gradient by name, two more", _GRADIENT, None),
    ("a plan through torch, backwards", _LAYER, None),
    ("dscp plan powered_descent", _COMMAND.format(["plan", "powered_descent"]), None),
)


def measure(*, quick: bool) -> Report:
    """Run every case in processes of its own.

    Args:
        quick: Fewer repetitions.
    """
    report = Report("start")
    repetitions = 3 if quick else 15
    for what, code, target in _CASES:
        times = [_cpu_seconds(code) for _ in range(repetitions)]
        bound = None if target is None else ("<=", target)
        report.add(f"{what}, CPU", float(np.median(times)), "s", bound)
    report.notes.append(f"median of {repetitions} processes, user and system time, disk cache warm")
    return report


def _cpu_seconds(code: str) -> float:
    """User and system time of an interpreter that runs the code."""
    before = os.times()
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)
    after = os.times()
    return (
        after.children_user - before.children_user + after.children_system - before.children_system
    )

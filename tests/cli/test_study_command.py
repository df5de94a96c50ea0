"""`dscp study terminal-time`, and the differences that it compares with."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dscp_core import problems
from dscp_core.errors import InvalidInputError
from dscp_core.gradients.differences import RunDifferences
from dscp_core.gradients.losses import FinalStateLoss
from dscp_core.planning.planner import Planner, PlannerSettings
from dscp_core.scp.scp import ScpOptions, ScpStatus
from dscp_core.studies import (
    surface_to_mass,
    surface_to_mass_figures,
    trust_region,
    trust_region_cases,
)
from dscp_core.studies.terminal_time import Sweep, SweepPoint, run_sweep, summarise
from dscp_core.studies.terminal_time_figure import sweep_figure
from dscp_core.studies.trust_region_cases import CASES
from dscp_ros.cli import ExitCode
from dscp_ros.cli.main import main

COARSE = PlannerSettings(intervals=20)
"""Fewer intervals: a third of the time, and all the same branches."""


def refuse(constant: str) -> None:
    raise AssertionError(f"{constant} is not JSON")


def test_sweep_prints_and_writes_what_it_found(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    directory = tmp_path / "new" / "study"
    arguments = ["--from", "32.0", "--to", "33.2", "--step", "0.6", "--jobs", "1"]
    code = main(["study", "terminal-time", *arguments, "--output", str(directory), "--json"])
    assert code == ExitCode.OK
    summary = json.loads(capsys.readouterr().out, parse_constant=refuse)
    assert summary["points"] == 3
    assert summary["infeasible_s"] == [32.0, 32.0]
    # CasADi + IPOPT on the same discretised problem: 32.8103 s, 31760.30 kg, least 32.0487 s.
    assert summary["free_optimum_s"] == pytest.approx(32.8103, abs=0.005)
    assert summary["free_final_mass_kg"] == pytest.approx(31760.30, abs=0.006)
    assert summary["least_feasible_s"] == pytest.approx(32.0487, abs=1e-4)
    # The gradient is nearly linear in time: interpolation over 0.6 s is good to its curvature.
    assert summary["gradient_zero_s"] == pytest.approx(32.8103, abs=0.05)
    assert summary["max_relative_error"] < 1e-6
    assert summary["unflagged_gross_errors"] == 0

    with Path(summary["csv"]).open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [float(row["terminal_time_s"]) for row in rows] == [32.0, 32.6, 33.2]
    assert [row["status"] for row in rows] == ["infeasible", "converged", "converged"]
    assert rows[0]["trusted"] == "False"
    assert "nan" not in Path(summary["csv"]).read_text(encoding="utf-8").lower()
    assert Path(summary["figure"]).read_bytes().startswith(b"\x89PNG")
    assert {path.name for path in directory.iterdir()} == {
        "terminal_time.csv",
        "terminal_time.png",
    }


def test_trust_region_prints_and_writes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trust_region, "QUICK_POINTS", (2, 2))
    monkeypatch.setattr(trust_region_cases, "PAPER_INTERVALS", 12)
    arguments = ["study", "trust-region", "--quick", "--output", str(tmp_path / "new"), "--json"]
    assert main(arguments) == ExitCode.OK
    summary = json.loads(capsys.readouterr().out, parse_constant=refuse)
    assert summary["points"] == 4
    assert [case["case"] for case in summary["cases"]] == ["case1", "case2", "case3", "case4"]
    assert summary["resumed"] == 0
    assert len(summary["files"]) == 8
    assert all(Path(file).stat().st_size > 0 for file in summary["files"])
    with Path(summary["files"][0]).open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    corners = [("1.0", "-1.0"), ("1.0", "2.0"), ("2.0", "-1.0"), ("2.0", "2.0")]
    assert [(row["log_gamma"], row["log_control"]) for row in rows] == corners

    monkeypatch.setattr(trust_region_cases, "PAPER_INTERVALS", 13)
    assert main(arguments) == ExitCode.BAD_INPUT
    error = json.loads(capsys.readouterr().out)["error"]
    assert "intervals 12 there, 13 here" in error["message"]


def test_surface_to_mass_prints_and_writes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # One case and few intervals: the numbers mean nothing, and take a second.
    paper = {("case4", 12): surface_to_mass.PAPER["case4", 100]}
    for module in (surface_to_mass, surface_to_mass_figures):
        monkeypatch.setattr(module, "PAPER", paper)
        monkeypatch.setattr(module, "CASES", CASES[3:])
    monkeypatch.setattr(surface_to_mass, "QUICK_POINTS", {12: 3})
    arguments = ["study", "surface-to-mass", "--quick", "--output", str(tmp_path)]
    assert main([*arguments, "--json"]) == ExitCode.OK
    document = json.loads(capsys.readouterr().out, parse_constant=refuse)
    (row,) = document["rows"]
    assert (row["case"], row["intervals"]) == ("case4", 12)
    assert set(row["gradient_correlation"]) == {"equal_k", "sweep", "sweep_all"}
    assert {"optimal_ratio", "optimal_cost", "mean_iterations", "std_iterations"} <= set(row)
    assert len(document["files"]) == 4
    assert document["resumed"] == 0
    assert main(arguments) == ExitCode.OK
    captured = capsys.readouterr()
    assert "4 results of an earlier run used" in captured.err
    assert "case4" in captured.out


@pytest.mark.parametrize("study", ["trust-region", "surface-to-mass"])
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--jobs", "0"], "--jobs"),
        (["--output", __file__], "--output"),
        (["--ray", "nowhere"], "HOST:PORT"),
    ],
)
def test_bad_input_of_the_entry_studies(
    study: str,
    arguments: list[str],
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["study", study, *arguments]) == ExitCode.BAD_INPUT
    assert words in capsys.readouterr().err


def test_processes_agree_with_one_process() -> None:
    sweep = Sweep(32.5, 33.3, 0.2, settings=COARSE)
    done: list[int] = []
    together = run_sweep(sweep, jobs=2, report=done.append)
    alone = run_sweep(sweep, jobs=1)
    assert sum(done) == len(together) == len(alone) == 5
    assert [p.terminal_time_s for p in together] == list(sweep.times_s)
    for one, other in zip(together, alone, strict=True):
        assert one.iterations == other.iterations
        # A solver keeps some state from point to point, and the points are shared out.
        assert one.gradient_kg_s == pytest.approx(other.gradient_kg_s, rel=1e-7)


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        (["--from", "nan"], "start_s"),
        (["--from", "0.5"], "terminal_time"),
        (["--to", "601"], "terminal_time"),
        (["--from", "33", "--to", "32"], "stop_s"),
        (["--step", "0"], "step_s"),
        (["--step", "1e-9"], "step_s"),
        (["--step", "0.1", "--quick"], "--step"),
        (["--jobs", "0"], "jobs"),
        (["--output", __file__], "--output"),
    ],
)
def test_bad_input_names_the_field(
    arguments: list[str],
    field: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["study", "terminal-time", *arguments, "--json"]) == ExitCode.BAD_INPUT
    assert json.loads(capsys.readouterr().out)["error"]["field"] == field


def test_times_include_both_ends() -> None:
    assert Sweep(32.0, 34.0, 0.01).times_s[-1] == 34.0
    assert len(Sweep(32.0, 34.0, 0.01).times_s) == 201
    assert Sweep(32.0, 32.0, 0.5).times_s == (32.0,)


def point(time_s: float, **changes: Any) -> SweepPoint:
    made = SweepPoint(
        terminal_time_s=time_s,
        status=ScpStatus.CONVERGED,
        iterations=6,
        final_mass_kg=31760.0 - (time_s - 33.0) ** 2,
        virtual_control=1e-8,
        gradient_kg_s=-2.0 * (time_s - 33.0),
        trusted=True,
        central_difference_kg_s=-2.0 * (time_s - 33.0),
        uncertainty_kg_s=1e-8,
        across_kink=False,
        relative_error=1e-9,
        reasons=(),
    )
    return replace(made, **changes)


def test_summary_counts_what_the_verdict_missed() -> None:
    points = [
        point(32.0, status=ScpStatus.INFEASIBLE, trusted=False, gradient_kg_s=math.nan),
        point(32.08, relative_error=0.5),  # below the reliable range: counted as unflagged only
        point(32.5, relative_error=2e-3),
        point(32.9, relative_error=0.7, trusted=False),
        point(33.3, relative_error=math.nan, iterations=9),
        point(33.4, relative_error=1e-2, across_kink=True, iterations=9),
    ]
    summary = summarise(Sweep(settings=COARSE), points)
    assert summary.unflagged_gross_errors == 3  # whether a kink explains it or not
    assert summary.regular_share == pytest.approx(3.0 / 4.0)
    assert summary.mean_iterations == pytest.approx(7.5)
    assert summary.compared == 1
    assert summary.across_kink == 1
    assert summary.max_relative_error == 2e-3
    assert summary.max_relative_error_at_s == 32.5
    assert summary.best_swept_s == 32.9
    assert summary.gradient_zero_s == pytest.approx(33.0)
    assert summary.infeasible_s == (32.0, 32.0)


@pytest.mark.filterwarnings("error")
def test_figure_of_a_sweep_without_any_plan(tmp_path: Path) -> None:
    lost = [
        point(
            time_s,
            status=ScpStatus.SUBPROBLEM_INFEASIBLE,
            trusted=False,
            final_mass_kg=math.nan,
            gradient_kg_s=math.nan,
            relative_error=math.nan,
        )
        for time_s in (5.0, 6.0)
    ]
    path = tmp_path / "sweep.png"
    sweep_figure(lost, summarise(Sweep(settings=COARSE), lost)).savefig(path)
    assert path.stat().st_size > 1000


@pytest.fixture(scope="module")
def runs() -> RunDifferences:
    planner = Planner(
        problems.get("powered_descent"), replace(COARSE, options=ScpOptions.for_gradients())
    )
    trace = planner.scp.run(planner.parameters)
    assert trace.status is ScpStatus.CONVERGED
    return RunDifferences(planner.scp, trace, FinalStateLoss("mass"))


def test_difference_does_not_depend_on_its_step(runs: RunDifferences) -> None:
    found = [runs.derivative("specific_impulse", step=step) for step in (None, 1e-2, 1e-3)]
    values = [difference.value for difference in found]
    assert None not in values
    # d m_N / d Isp is about 20 kg/s; 3e-11 kg of rounding over 1e-3 s leave 1e-8 of it.
    np.testing.assert_allclose(values, values[0], rtol=1e-7)
    for difference, step in zip(found[1:], (1e-2, 1e-3), strict=True):
        assert difference.step <= step
        assert difference.uncertainty < 1e-5


def test_difference_refuses_what_cannot_be_stepped(runs: RunDifferences) -> None:
    with pytest.raises(InvalidInputError, match="known name"):
        runs.derivative("warp_factor")
    with pytest.raises(InvalidInputError, match="finite and > 0"):
        runs.derivative("gravity", step=-1.0)
    with pytest.raises(InvalidInputError, match=r"terminal_time_min"):
        runs.derivative("terminal_time_min", step=1e6)  # unused, so no active set shortens it

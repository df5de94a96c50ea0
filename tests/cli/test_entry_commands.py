"""`dscp plan entry` and `dscp gradient entry`."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import pytest

from dscp_ros.cli import ExitCode
from dscp_ros.cli.main import main

VEHICLE = Path(__file__).parents[2] / "config" / "vehicles" / "entry_heavy_glider.yaml"


def answer(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, dict[str, Any]]:
    code = main([*arguments, "--json"])
    return code, json.loads(capsys.readouterr().out)


def test_default_is_the_papers_case(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    table, figure = tmp_path / "plan.csv", tmp_path / "plan.png"
    code, plan = answer(capsys, "plan", "entry", "--output", str(table), "--plot", str(figure))
    assert code == ExitCode.OK
    assert plan["status"] == "certified"
    assert (plan["formulation"], plan["intervals"]) == ("quadratic", 100)
    assert plan["terminal_time_source"] == "free"
    assert plan["terminal_time_s"] == pytest.approx(2712.7, abs=2.0)
    assert plan["cost"] == pytest.approx(0.03572, abs=1e-5)
    assert plan["headline"].startswith("certified, converged: terminal time 2713 s (free), cost ")
    assert plan["final_speed_m_s"] == pytest.approx(2016.3, abs=1.0)
    # Facts of a vehicle that loses mass.
    assert "final_mass_kg" not in plan
    assert "mass_used_kg" not in plan["certificate"]
    assert plan["certificate"]["miss_position_m"] < 500.0
    assert plan["iterations"] <= 12
    with table.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 101
    assert float(rows[0]["radius_m"]) == pytest.approx(6449.1e3)
    assert float(rows[-1]["longitude_rad"]) == pytest.approx(2.0943951, abs=1e-6)
    assert figure.read_bytes().startswith(b"\x89PNG")


def test_text_names_the_cost(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", "entry", "--vehicle", str(VEHICLE), "--intervals", "60"]) == ExitCode.OK
    text = capsys.readouterr().out
    assert "entry (quadratic, 60 intervals): certified" in text
    assert "cost" in text
    assert "kg" not in text


@pytest.mark.parametrize(
    ("assignment", "name"),
    [
        ("initial_speed=0", "initial_speed"),
        ("initial_radius=6.3e6", "radius"),
        ("initial_bank_angle=1.2", "bank_angle"),
        ("initial_longitude=120", "initial_longitude"),
        ("initial_latitude=nan", "initial_latitude"),
        ("drag_coefficients=0.1,-0.02,2.4", "drag_coefficients"),
        ("drag_coefficient=0.1", "drag_coefficients"),
    ],
)
def test_bad_input(capsys: pytest.CaptureFixture[str], assignment: str, name: str) -> None:
    assert main(["plan", "entry", "--set", assignment]) == ExitCode.BAD_INPUT
    assert name in capsys.readouterr().err


def test_target_out_of_reach_is_no_plan(capsys: pytest.CaptureFixture[str]) -> None:
    code, plan = answer(capsys, "plan", "entry", "--set", "final_longitude=3.1")
    assert code == ExitCode.NO_PLAN
    assert plan["status"] == "infeasible"
    assert plan["least_feasible_terminal_time_s"] is None


def test_gradient_at_fixed_iterations(capsys: pytest.CaptureFixture[str]) -> None:
    code, found = answer(
        capsys,
        *("gradient", "entry", "--formulation", "printed", "--iterations", "5"),
        *("--discretisation", "midpoint"),
        *("--of", "cost", "--wrt", "surface_to_mass_ratio", "--check"),
    )
    assert code == ExitCode.OK
    assert found["trusted"] is True
    assert found["relative_error"] < 1e-4
    assert found["value"] == pytest.approx(0.03583, abs=1e-5)


def test_gradient_of_a_mass_that_is_no_state(capsys: pytest.CaptureFixture[str]) -> None:
    code = main(["gradient", "entry", "--of", "final_mass", "--wrt", "mass"])
    assert code == ExitCode.BAD_INPUT
    assert "mass" in capsys.readouterr().err

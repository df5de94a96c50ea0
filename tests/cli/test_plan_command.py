"""`dscp plan`: one case without ROS."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from dscp_ros.cli import ExitCode
from dscp_ros.cli.main import main
from dscp_ros.cli.output_files import complete_file

VEHICLES = Path(__file__).parents[2] / "config" / "vehicles"
LANDERS = [path for path in sorted(VEHICLES.glob("*.yaml")) if "entry" not in path.stem]
# An independent solution of the same discretised problem (CasADi + IPOPT).
OPTIMAL_TIME_S = 32.8099
OPTIMAL_MASS_KG = 31760.368
LEAST_TIME_S = 32.0482

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def refuse(constant: str) -> None:
    raise AssertionError(f"{constant} is not JSON")


@pytest.fixture
def plan(capsys: pytest.CaptureFixture[str]) -> Any:
    """Runs `dscp plan powered_descent ... --json`; returns exit code and parsed answer."""

    def run(*arguments: str) -> tuple[int, dict[str, Any]]:
        code = main(["plan", "powered_descent", *arguments, "--json"])
        return code, json.loads(capsys.readouterr().out, parse_constant=refuse)

    return run


def test_default_is_the_papers_case(plan: Any) -> None:
    code, answer = plan()
    assert code == ExitCode.OK
    assert answer["status"] == "certified"
    assert (answer["certified"], answer["converged"]) == (True, True)
    assert answer["headline"].startswith("certified, converged: terminal time 32.81 s (fixed)")
    assert answer["terminal_time_s"] == 32.81
    # 3e-4 s from the optimum cost 3e-6 kg; the rest is the reference's last printed digit.
    assert answer["final_mass_kg"] == pytest.approx(OPTIMAL_MASS_KG, abs=0.006)
    assert answer["cost"] == pytest.approx(-answer["final_mass_kg"])
    assert 2 <= answer["iterations"] <= 10
    assert answer["solve_time_ms"] > answer["solver_time_ms"] > 0.0
    assert answer["virtual_control"] < 1e-6
    assert answer["least_feasible_terminal_time_s"] is None
    certificate = answer["certificate"]
    assert certificate["passed"] is True
    assert certificate["reasons"] == []
    assert 0.0 < certificate["miss_position_m"] < 1.0
    names = {check["name"] for check in certificate["checks"]}
    assert {"miss_position", "thrust_min", "thrust_max", "pointing", "glideslope"} <= names
    burnt = answer["parameters"]["initial_mass"] - answer["final_mass_kg"]
    # The flight burns what the plan says.
    assert certificate["mass_used_kg"] == pytest.approx(burnt, abs=0.01)


def test_free_terminal_time_finds_the_optimum(plan: Any) -> None:
    code, answer = plan("--free-terminal-time", "--set", "terminal_time=36", "--solver", "qoco")
    assert code == ExitCode.OK
    assert answer["terminal_time_source"] == "free"
    assert answer["solver"] == "qoco"
    assert answer["terminal_time_s"] == pytest.approx(OPTIMAL_TIME_S, abs=0.005)
    assert answer["final_mass_kg"] == pytest.approx(OPTIMAL_MASS_KG, abs=0.006)


@pytest.mark.parametrize("time_s", [1.0, 20.0, 32.0, 32.04])
def test_too_short_a_time_is_infeasible_and_the_least_is_named(plan: Any, time_s: float) -> None:
    code, answer = plan("--set", f"terminal_time={time_s}")
    assert code == ExitCode.NO_PLAN
    assert answer["status"] == "infeasible"
    assert answer["certified"] is False
    assert answer["terminal_time_s"] == time_s
    # The reference's last printed digit, and virtual control of 1e-6 left by the penalty.
    assert answer["least_feasible_terminal_time_s"] == pytest.approx(LEAST_TIME_S, abs=1e-4)
    assert "least feasible 32.04" in answer["message"]
    assert answer["final_mass_kg"] is None
    assert answer["cost"] is None


def test_just_above_the_least_time_there_is_a_plan(plan: Any) -> None:
    code, answer = plan("--set", "terminal_time=32.06")
    assert (code, answer["status"]) == (ExitCode.OK, "certified")


def test_unreachable_target_is_infeasible_without_a_least_time(plan: Any) -> None:
    code, answer = plan("--set", "initial_velocity=-400,0,0", "--set", "terminal_time=31")
    assert code == ExitCode.NO_PLAN
    assert answer["status"] == "infeasible"
    assert answer["least_feasible_terminal_time_s"] is None


def test_a_certified_plan_cut_short_says_that_it_is_not_converged(
    plan: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    # Steps so short that 20 iterations do not get there.
    slow = ("--set", "trust_region_control=0.3,0.3,0.3", "--set", "terminal_time=33")
    code, answer = plan(*slow)
    assert code == ExitCode.OK
    assert (answer["certified"], answer["converged"]) == (True, False)
    assert main(["plan", "powered_descent", *slow]) == ExitCode.OK
    assert "certified, NOT CONVERGED (iteration limit)" in capsys.readouterr().out.splitlines()[0]


def test_deadline_that_is_too_short(plan: Any) -> None:
    code, answer = plan("--deadline", "1e-4")
    assert code == ExitCode.NO_PLAN
    assert answer["status"] == "deadline"
    assert answer["certificate"] is None


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        (["--set", "terminal_time=nan"], "terminal_time"),
        (["--set", "terminal_time=inf"], "terminal_time"),
        (["--set", "terminal_time=-3"], "terminal_time"),
        (["--set", "terminal_time=soon"], "terminal_time"),
        (["--set", "terminal_time=3,4"], "terminal_time"),
        (["--set", "initial_position=5000"], "initial_position"),
        (["--set", "initial_position=5000,,500"], "initial_position"),
        (["--set", "initial_mass=0"], "initial_mass"),
        (["--set", "initial_position=-5,0,0"], "x"),
        (["--set", "mass=3"], "parameter"),
        (["--set", "terminal_time"], "--set"),
        (["--set", "=3"], "--set"),
        (["--set", "gravity=9", "--set", "gravity=8"], "--set"),
        (["--vehicle", "no/such/file.yaml"], "parameter file"),
        (["--formulation", "exact"], "formulation"),
        (["--solver", "magic"], "solver"),
        (["--intervals", "1"], "--intervals"),
        (["--intervals", "1000000000"], "--intervals"),
        (["--deadline", "0"], "--deadline"),
        (["--deadline", "nan"], "--deadline"),
        (["--plot", "plan.pdf"], "--plot"),
        (["--plot", "no/such/directory/plan.png"], "--plot"),
        (["--output", "plan.txt"], "--output"),
    ],
)
def test_bad_input_names_the_field(plan: Any, arguments: list[str], field: str) -> None:
    code, answer = plan(*arguments)
    assert code == ExitCode.BAD_INPUT
    assert answer["error"]["field"] == field
    assert answer["error"]["bound"]


def test_unknown_problem(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", "ascent"]) == ExitCode.BAD_INPUT
    assert "problem: got 'ascent', expected one of powered_descent" in capsys.readouterr().err


@pytest.mark.parametrize("vehicle", LANDERS, ids=lambda path: path.stem)
def test_shipped_vehicles_land(plan: Any, vehicle: Path) -> None:
    code, answer = plan("--vehicle", str(vehicle), "--free-terminal-time")
    assert code == ExitCode.OK, answer["message"]
    assert answer["certified"] is True
    bounds = {c["name"]: c["bound"] for c in answer["certificate"]["checks"]}
    # A tolerance in N that suits one vehicle is nothing for another.
    assert bounds["thrust_max"] == pytest.approx(1e-3 * answer["parameters"]["thrust_max"])


def test_vehicle_file_sets_parameters_and_set_wins(plan: Any, tmp_path: Path) -> None:
    vehicle = tmp_path / "vehicle.yaml"
    vehicle.write_text("initial_mass: 36000\nspecific_impulse: 300\n", encoding="utf-8")
    code, answer = plan(
        "--vehicle", str(vehicle), "--set", "specific_impulse=290", "--free-terminal-time"
    )
    assert code == ExitCode.OK
    assert answer["parameters"]["initial_mass"] == 36000.0
    assert answer["parameters"]["specific_impulse"] == 290.0
    vehicle.write_text("initial_mass: heavy\n", encoding="utf-8")
    code, answer = plan("--vehicle", str(vehicle))
    assert (code, answer["error"]["field"]) == (ExitCode.BAD_INPUT, "initial_mass")


def test_files_hold_the_plan(plan: Any, tmp_path: Path) -> None:
    table, picture = tmp_path / "plan.csv", tmp_path / "plan.png"
    code, answer = plan("--output", str(table), "--plot", str(picture), "--intervals", "30")
    assert code == ExitCode.OK
    assert (answer["output"], answer["plot"]) == (str(table), str(picture))
    with table.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 31
    first, last = rows[0], rows[-1]
    assert float(first["x_m"]) == pytest.approx(5000.0)
    assert float(first["vy_m_s"]) == pytest.approx(30.0)
    assert float(last["time_s"]) == pytest.approx(32.81)
    assert float(last["mass_kg"]) == pytest.approx(answer["final_mass_kg"])
    assert float(last["thrust_x_n"]) > 0.0
    assert picture.read_bytes().startswith(PNG_SIGNATURE)
    assert sorted(tmp_path.iterdir()) == [table, picture], "no temporary file is left"


def test_json_file_holds_plan_and_description(plan: Any, tmp_path: Path) -> None:
    path = tmp_path / "plan.json"
    plan("--output", str(path), "--intervals", "20")
    content = json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)
    assert content["status"] == "certified"
    trajectory = content["trajectory"]
    assert len(trajectory["times_s"]) == len(trajectory["states"]) == 21
    assert len(trajectory["states"][0]) == len(trajectory["state_columns"]) == 7
    assert len(trajectory["controls"][0]) == len(trajectory["control_columns"]) == 3


def test_infeasible_case_leaves_files_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "plan.csv"
    path.write_text("precious\n", encoding="utf-8")
    arguments = ["--set", "terminal_time=30", "--output", str(path), "--json"]
    assert main(["plan", "powered_descent", *arguments]) == ExitCode.NO_PLAN
    output = capsys.readouterr()
    assert "is not written" in output.err
    assert json.loads(output.out)["output"] is None
    assert path.read_text(encoding="utf-8") == "precious\n"


def test_file_that_fails_half_way_is_not_there(tmp_path: Path) -> None:
    path = tmp_path / "plan.csv"

    def write() -> None:
        with complete_file(path) as partial:
            partial.write_text("half", encoding="utf-8")
            raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        write()
    assert list(tmp_path.iterdir()) == []


def test_parameter_list(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["plan", "powered_descent", "--list-parameters", "--set", "terminal_time=33"]
    assert main(arguments) == ExitCode.OK
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["name", "value", "unit", "bounds", "description"]
    assert lines[1].split()[:3] == ["terminal_time", "33", "s"]
    assert any(line.startswith("initial_position") and "5000,500,500" in line for line in lines)

    assert main([*arguments, "--json"]) == ExitCode.OK
    listed = json.loads(capsys.readouterr().out, parse_constant=refuse)["parameters"]
    by_name = {parameter["name"]: parameter for parameter in listed}
    assert by_name["terminal_time"]["default"] == 32.81
    assert by_name["terminal_time"]["value"] == 33.0
    assert by_name["fuel_weight"]["upper"] is None
    assert all(parameter["description"] for parameter in listed)


def test_text_for_people(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", "powered_descent"]) == ExitCode.OK
    text = capsys.readouterr().out
    assert "certified, converged" in text.splitlines()[0]
    assert "final mass" in text
    assert "31760.3" in text
    assert "miss_position" in text

    assert main(["plan", "powered_descent", "--set", "terminal_time=32"]) == ExitCode.NO_PLAN
    text = capsys.readouterr().out
    assert "INFEASIBLE" in text.splitlines()[0]
    assert "32.0482 s" in text


def test_what_is_not_checked_and_how_it_is_flown_is_told(
    plan: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    silent = tmp_path / "silent.yaml"
    silent.write_text("initial_mass: 38000\n", encoding="utf-8")
    case = ("--vehicle", str(silent), "--hold", "linear")
    code, answer = plan(*case)
    assert code == ExitCode.OK
    assert answer["certificate"]["unchecked"] == ["dry_mass", "thrust_rate_max"]
    assert main(["plan", "powered_descent", *case]) == ExitCode.OK
    text = capsys.readouterr().out
    assert "flown with the controls linear between the nodes:" in text
    assert "NOT checked, the bound being unknown or infinite: dry_mass, thrust_rate_max" in text


def test_needs_neither_ros_nor_torch_nor_matplotlib() -> None:
    code = (
        "import sys\n"
        "from dscp_ros.cli.main import main\n"
        "code = main(['plan', 'powered_descent', '--json'])\n"
        "print('imported:', *({'rclpy', 'torch', 'matplotlib'} & set(sys.modules)))\n"
        "sys.exit(code)\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert result.returncode == ExitCode.OK, result.stderr
    assert result.stdout.splitlines()[-1] == "imported:"


def test_best_effort_is_told_and_never_called_certified(plan: Any) -> None:
    code, answer = plan("--set", "initial_velocity=-400,30,-30", "--best-effort")
    assert code == ExitCode.NO_PLAN
    assert (answer["status"], answer["certified"]) == ("infeasible", False)
    effort = answer["best_effort"]
    assert effort["certified"] is False
    assert effort["certificate"]["passed"] is False
    # Independent: 146.12 m/s is the least (CasADi + IPOPT, the midpoint rule).
    speed = sum(effort[f"final_v{axis}_m_s"] ** 2 for axis in "xyz") ** 0.5
    assert speed == pytest.approx(146.12, rel=2e-3)
    assert effort["violations"][0] == f"final_speed_error {speed:.4g} m/s"
    assert [step.split()[0] for step in effort["steps"]][-1] == "cost"
    assert any(line.startswith("terminal_time ") for line in effort["violations"])


def test_best_effort_is_printed_drawn_and_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    figure, table = tmp_path / "least.png", tmp_path / "least.csv"
    case = ["plan", "powered_descent", "--set", "initial_velocity=-400,30,-30"]
    case += ["--free-terminal-time", "--best-effort"]
    code = main([*case, "--plot", str(figure), "--output", str(table)])
    assert code == ExitCode.NO_PLAN
    out = capsys.readouterr().out
    assert "best effort, NOT CERTIFIED: terminal time 17.9" in out
    assert out.index("it violates") < out.index("final_speed_error 146") < out.index("made least")
    assert figure.read_bytes().startswith(PNG_SIGNATURE)
    rows = list(csv.reader(table.open(encoding="utf-8")))
    assert len(rows) == 52
    assert abs(float(rows[-1][rows[0].index("x_m")])) < 1e-3


def test_a_certified_plan_comes_without_a_best_effort(plan: Any) -> None:
    code, answer = plan("--best-effort")
    assert code == ExitCode.OK
    assert answer["best_effort"] is None

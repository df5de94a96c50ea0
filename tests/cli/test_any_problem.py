"""`dscp plan` and `dscp gradient` with a problem that no package knows."""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from dscp_ros.cli import ExitCode
from dscp_ros.cli.main import main

CALL = "import sys; from dscp_ros.cli.main import main; sys.exit(main())"
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"

# A point mass in a plane past a disc, in a wind: closures, lambdas, a neighbour, no known names.
SOURCE = '''
"""A boat past an island."""
import casadi as ca
import numpy as np
from island import RADIUS, clearance

from dscp_core import (
    InitialGuess,
    Miss,
    OptimalControlProblem,
    Parameter,
    PathConstraint,
    Variable,
)


def boat(wind_default=0.02, name="boat"):
    def guess(p, n):
        share = ca.DM(np.linspace(0.0, 1.0, n + 1)).T
        start, goal = p["start"], ca.vertcat(p["goal"], 0.0, 0.0)
        bend = ca.vertcat(ca.DM.zeros(1, n + 1), 60.0 * share * (1 - share), ca.DM.zeros(2, n + 1))
        states = ca.mtimes(start, 1 - share) + ca.mtimes(goal, share) + bend
        return InitialGuess(states, ca.MX(ca.DM.zeros(2, n + 1)))

    limits = [
        PathConstraint(
            f"push_{sign:+d}_{i}",
            lambda at, p, i=i, sign=sign: sign * at.u[i] - p["push_max"],
            1.0,
            "m/s^2",
        )
        for i in range(2)
        for sign in (-1, 1)
    ]
    return OptimalControlProblem(
        name=name,
        states=tuple(
            Variable(n, unit, scale, n)
            for n, unit, scale in (
                ("east", "m", 50.0), ("north", "m", 50.0), ("veast", "m/s", 5.0),
                ("vnorth", "m/s", 5.0),
            )
        ),
        controls=tuple(Variable(n, "m/s^2", 1.0, n) for n in ("push_east", "push_north")),
        parameters=(
            Parameter("terminal_time", 30.0, "s", "Duration.", lower=1.0, upper=100.0),
            Parameter("start", (0.0, 0.0, 0.0, 0.0), "1", "Position and speed at the start."),
            Parameter("goal", (100.0, 0.0), "m", "Where to."),
            Parameter("drag", 0.01, "1/m", "Drag over squared speed.", lower=0.0),
            Parameter("wind", wind_default, "m/s^2", "Acceleration to the north."),
            Parameter("push_max", 1.5, "m/s^2", "Greatest push per axis.", lower=0.0),
        ),
        dynamics=lambda x, u, p: ca.vertcat(
            x[2],
            x[3],
            u[0] - p["drag"] * x[2] * ca.sqrt(x[2] ** 2 + x[3] ** 2 + 1e-4),
            u[1] - p["drag"] * x[3] * ca.sqrt(x[2] ** 2 + x[3] ** 2 + 1e-4) + p["wind"],
        ),
        initial_state=lambda p: p["start"],
        initial_state_parameters=("start",),
        final_state={
            "east": lambda p: p["goal"][0],
            "north": lambda p: p["goal"][1],
            "veast": lambda p: ca.SX(0.0),
        },
        terminal_cost=lambda x, t, p: 0.0 * t,
        running_cost=lambda x, u, p: u[0] ** 2 + u[1] ** 2,
        cost_scale=1.0,
        cost_unit="m^2/s^3",
        path_constraints=(*limits, PathConstraint("island", clearance, RADIUS, "m", tolerance=0.2)),
        misses=(
            Miss("miss_goal", lambda x, p: ca.norm_2(x[:2] - p["goal"]), "m", 0.5),
        ),
        virtual_control_scale=(1.0, 1.0, 1.0, 1.0),
        virtual_control_weight=1e6,
        trust_region_state=(0.01,) * 4,
        initial_guess=guess,
    )


BOAT = boat()
NUMBER = 3


def other():
    return boat(0.05, "windy_boat")


def raising():
    raise RuntimeError("no boat today")
'''
NEIGHBOUR = """
import casadi as ca

RADIUS = 15.0


def clearance(at, p):
    return RADIUS - ca.sqrt((at.x[0] - 50.0) ** 2 + (at.x[1] - 0.0) ** 2 + 1e-6)
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("own")
    (folder / "boat.py").write_text(SOURCE, encoding="utf-8")
    (folder / "island.py").write_text(NEIGHBOUR, encoding="utf-8")
    (folder / "vehicle.yaml").write_text("drag: 0.02\npush_max: 2\n", encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def boat(folder: Path) -> str:
    return f"{folder}/boat.py:BOAT"


def run(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, dict[str, Any]]:
    code = main([*arguments, "--json"])
    return code, json.loads(capsys.readouterr().out)


def test_a_plan_with_its_files(
    boat: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [tmp_path / name for name in ("plan.png", "plan.csv", "plan.json")]
    code, plan = run(capsys, "plan", boat, "--plot", str(files[0]), "--output", str(files[1]))
    assert code == ExitCode.OK, plan["message"]
    assert (plan["problem"], plan["formulation"]) == ("boat", None)
    assert plan["headline"].startswith("certified, converged: terminal time 30 s (fixed), cost ")
    assert plan["cost_unit"] == "m^2/s^3"
    assert plan["subproblem_costs"] == {"running": "exact", "terminal": "exact"}
    assert " m^2/s^3, at most " in plan["headline"]
    assert plan["headline"].endswith(" m^2/s^3 to gain")
    assert plan["final_east_m"] == pytest.approx(100.0)
    assert plan["final_veast_m_s"] == pytest.approx(0.0, abs=1e-9)
    assert plan["certificate"]["miss_goal_m"] < 0.5
    assert not any("mass" in key for key in (*plan, *plan["certificate"]))
    assert files[0].read_bytes().startswith(PNG_SIGNATURE)
    with files[1].open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 51
    assert list(rows[0])[:2] == ["time_s", "east_m"]
    assert "push_east_m_s2" in rows[0]
    north = [abs(float(row["north_m"])) for row in rows]
    assert max(north) > 14.0, "past the island, not through it"
    code, _ = run(capsys, "plan", boat, "--output", str(files[2]))
    written = json.loads(files[2].read_text(encoding="utf-8"))
    assert written["headline"] == plan["headline"]
    assert len(written["trajectory"]["states"][0]) == 4


def test_text_for_people(boat: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", boat]) == ExitCode.OK
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("boat (50 intervals): certified, converged: terminal time 30 s")
    text = "\n".join(lines)
    assert "final vnorth" in text
    assert "final east" not in text, "it is pinned"
    assert "miss_goal" in text


def test_vehicle_and_values(boat: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, plan = run(
        *(capsys, "plan", boat, "--vehicle", str(folder / "vehicle.yaml")),
        *("--set", "push_max=1.8", "--set", "start=5,0,0,0", "--intervals", "40"),
    )
    assert code == ExitCode.OK
    assert (plan["parameters"]["drag"], plan["parameters"]["push_max"]) == (0.02, 1.8)
    assert plan["parameters"]["start"][0] == 5.0
    assert plan["intervals"] == 40
    code, refused = run(capsys, "plan", boat, "--set", "dragg=1")
    assert code == ExitCode.BAD_INPUT
    assert "did you mean drag" in refused["error"]["bound"]
    code, refused = run(capsys, "plan", boat, "--formulation", "printed")
    assert (code, refused["error"]["field"]) == (ExitCode.BAD_INPUT, "formulation")


def test_the_parameters_of_the_file(boat: str, capsys: pytest.CaptureFixture[str]) -> None:
    for command in ("plan", "gradient"):
        code, listed = run(capsys, command, boat, "--list-parameters")
        assert code == ExitCode.OK
        names = [parameter["name"] for parameter in listed["parameters"]]
        assert names[:3] == ["terminal_time", "start", "goal"]


def test_a_free_terminal_time(boat: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, plan = run(capsys, "plan", boat, "--free-terminal-time")
    assert code in (ExitCode.OK, ExitCode.NO_PLAN)
    assert plan["terminal_time_source"] == "free"


@pytest.mark.parametrize("of", ["cost", "vnorth", "final_vnorth"])
def test_gradients_are_the_differences(
    boat: str, of: str, capsys: pytest.CaptureFixture[str]
) -> None:
    code, found = run(capsys, "gradient", boat, "--of", of, "--wrt", "wind", "goal", "--check")
    assert code == ExitCode.OK
    assert found["trusted"], found["reasons"]
    assert (found["feasible"], found["converged"]) == (True, True)
    assert found["relative_error"]["wind"] < 1e-5
    assert found["relative_error"]["goal"][0] < 1e-5
    assert found["of"] == ("cost" if of == "cost" else "final_vnorth")
    assert found["headline"].startswith(f"gradient of {found['of']}, ")
    assert f"[{found['unit']}]; unrolled" in found["headline"]


def test_how_fast_it_settles(boat: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, found = run(
        *(capsys, "gradient", boat, "--of", "convergence", "--wrt", "trust_region_state"),
        *("--iterations", "5"),
    )
    assert code == ExitCode.OK
    assert len(found["gradient"]) == 4
    assert "convergence not tested" in found["headline"]


def test_what_is_no_state_is_refused(boat: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, refused = run(capsys, "gradient", boat, "--of", "final_mass", "--wrt", "wind")
    assert code == ExitCode.BAD_INPUT
    assert refused["error"]["field"] == "--of"
    assert "final_vnorth" in refused["error"]["bound"]


def test_a_function_and_an_entry_point(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, made = run(capsys, "plan", f"{folder}/boat.py:other")
    assert (code, made["problem"]) == (ExitCode.OK, "windy_boat")
    info = tmp_path / "boats-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: boats\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[dscp.problems]\nmy_boat = boat:other\n")
    search = [str(tmp_path), str(folder), *filter(None, [os.environ.get("PYTHONPATH")])]
    installed = subprocess.run(
        [sys.executable, "-c", CALL, "plan", "my_boat", "--json"],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(search)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert installed.returncode == ExitCode.OK, installed.stderr
    answer = json.loads(installed.stdout)
    assert answer["cost"] == pytest.approx(made["cost"], rel=1e-9)


@pytest.mark.parametrize("command", [["plan"], ["gradient", "--of", "cost", "--wrt", "wind"]])
@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("boat.py:BOATS", "the file has BOAT"),
        ("boat.py:NUMBER", "int"),
        ("boat.py:raising", "no boat today"),
        ("boats.py:BOAT", "No such file"),
        ("boat.py", "FILE.py:NAME"),
        ("vehicle.yaml:BOAT", "FILE.py:NAME"),
        ("nonsense.py:X", "nonsense.py line 1: "),
    ],
)
def test_bad_problems_are_refused_in_words(
    folder: Path,
    command: list[str],
    name: str,
    said: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (folder / "nonsense.py").write_text("this is no Python\n", encoding="utf-8")
    code, refused = run(capsys, command[0], f"{folder}/{name}", *command[1:])
    assert code == ExitCode.BAD_INPUT
    assert refused["error"]["field"] == "problem"
    assert said in refused["error"]["message"]


CHANGED = """
from dataclasses import replace
from boat import BOAT
from dscp_core import Variable
BAD = {change}
"""


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("replace(BOAT, dynamics=lambda x, u, p: p['dragg'])", "dragg"),
        ("replace(BOAT, dynamics=lambda x, u, p: 1 / 0)", "ZeroDivisionError"),
        ("replace(BOAT, dynamics=lambda x, u, p: x[:2])", "shape"),
        ("replace(BOAT, states=(), final_state={}, initial_state_parameters=())", "states"),
        ("replace(BOAT, initial_guess=lambda p, n: None)", "initial_guess"),
    ],
)
def test_declarations_that_are_wrong_are_refused_in_words(
    folder: Path, change: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "changed.py").write_text(CHANGED.format(change=change), encoding="utf-8")
    code, refused = run(capsys, "plan", f"{folder}/changed.py:BAD")
    assert code == ExitCode.BAD_INPUT
    assert said in refused["error"]["message"]


CHAIN = """
import casadi as ca
from dscp_core import InitialGuess, OptimalControlProblem, Parameter, Variable


def chain(n, **cost):
    return OptimalControlProblem(
        name="chain",
        states=tuple(Variable(f"x{i}", "m", 1.0, "") for i in range(n)),
        controls=(Variable("u", "m/s", 1.0, ""),),
        parameters=(
            Parameter("terminal_time", 2.0, "s", ""),
            Parameter("start", (0.0,) * n, "m", ""),
        ),
        dynamics=lambda x, u, p: ca.vertcat(*(x[i + 1] - x[i] for i in range(n - 1)), u - x[n - 1]),
        initial_state=lambda p: p["start"],
        initial_state_parameters=("start",),
        final_state={f"x{n - 1}": lambda p: 0.1},
        terminal_cost=lambda x, t, p: 0.0 * t,
        cost_scale=1.0,
        initial_guess=lambda p, k: InitialGuess(ca.MX(n, k + 1), ca.MX(1, k + 1)),
        **cost,
    )


def long():
    return chain(500, running_cost=lambda x, u, p: u[0] ** 2)


def no_cost():
    return chain(2)


def no_states():
    return chain(0, running_cost=lambda x, u, p: u[0] ** 2)
"""


@pytest.mark.parametrize(("name", "said"), [("no_cost", "no cost"), ("no_states", "states")])
def test_without_cost_or_states_there_is_no_problem(
    folder: Path, name: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "chain.py").write_text(CHAIN, encoding="utf-8")
    for command in (["plan"], ["gradient", "--of", "cost", "--wrt", "start"]):
        code, refused = run(capsys, command[0], f"{folder}/chain.py:{name}", *command[1:])
        assert code == ExitCode.BAD_INPUT
        assert said in refused["error"]["message"]


@pytest.mark.slow
def test_five_hundred_states_are_planned_and_not_all_printed(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "chain.py").write_text(CHAIN, encoding="utf-8")
    picture = tmp_path / "chain.png"
    assert main(["plan", f"{folder}/chain.py:long", "--plot", str(picture)]) == ExitCode.OK
    text = capsys.readouterr().out
    assert "certified, converged" in text.splitlines()[0]
    assert text.count("final x") == 8
    assert picture.read_bytes().startswith(PNG_SIGNATURE)

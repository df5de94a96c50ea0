"""`dscp simulate`, with a cart whose flights are over at once."""

from __future__ import annotations

import csv
import json
import shlex
from pathlib import Path
from typing import Any

import pytest

from dscp_ros.cli import ExitCode
from dscp_ros.cli.main import main

CART = "tests/simulation_support.py:rolling_cart"
OPTIONS = ("--set", "mass=2", "--intervals", "5", "--truth", "raising=25")
FLIGHTS = 30


@pytest.fixture(autouse=True)
def from_the_root(monkeypatch: pytest.MonkeyPatch) -> None:
    root = Path(__file__).resolve().parents[2]
    monkeypatch.chdir(root)
    monkeypatch.syspath_prepend(str(root / "tests"))


def simulate(output: Path, *arguments: str, flights: int = FLIGHTS) -> int:
    count = ("--flights", str(flights), "--workers", "1")
    return main(["simulate", CART, *OPTIONS, *count, "--output", str(output), *arguments])


def read(path: Path) -> Any:
    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is not JSON")

    return json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)


def test_what_it_prints_and_writes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert simulate(tmp_path) == ExitCode.OK
    printed = capsys.readouterr().out
    assert printed.startswith("cart: 29 of 30 flights succeeded, 96.7 % (95 % confidence: 82.8")
    names = {"flights.jsonl", "flights.csv", "statistics.json", "campaign.png"}
    assert {file.name for file in tmp_path.iterdir()} == names
    assert all(f"wrote {tmp_path / name}" in printed for name in names)
    assert (tmp_path / "campaign.png").read_bytes().startswith(b"\x89PNG")

    written = read(tmp_path / "statistics.json")
    assert (written["flights"], written["successes"], written["seeds"]) == (30, 29, [1, 30])
    assert written["settings"]["vehicle"] == {"mass": 2.0, "range_max": ["inf", 1.0]}
    assert written["classes"] == {"error": 1}
    assert written["failed"][0]["seed"] == 25
    speeds = written["figures"]["stop_speed_m_s"]
    assert (speeds["bound"], speeds["unit"], speeds["count"]) == (1.0, "m/s", 29)
    assert speeds["p99"]["high"] is None
    assert written["figures"]["energy_j"]["bound"] is None

    # The table has the numbers of the flights' own file, to the last bit.
    with (tmp_path / "flights.csv").open(newline="", encoding="utf-8") as file:
        rows = {int(row["seed"]): row for row in csv.DictReader(file)}
    lines = [json.loads(line) for line in (tmp_path / "flights.jsonl").read_text().splitlines()]
    for line in lines[1:]:
        flight, row = line["row"], rows.pop(line["row"]["seed"])
        assert row["success"] == str(not flight["failure"])
        figures = {n: float(row[n]) for n in written["figures"] if row[n]}
        assert figures == flight["figures"]
    assert not rows


def test_json_is_what_is_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert simulate(tmp_path, "--json") == ExitCode.OK
    printed = json.loads(capsys.readouterr().out)
    assert printed == read(tmp_path / "statistics.json")


def test_going_on_and_another_setup(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert simulate(tmp_path, flights=10) == ExitCode.OK
    capsys.readouterr()
    assert simulate(tmp_path, "--json") == ExitCode.OK
    captured = capsys.readouterr()
    assert "10 flights of an earlier run used" in captured.err
    assert json.loads(captured.out)["resumed"] == 10
    assert json.loads(captured.out)["flights"] == FLIGHTS
    assert simulate(tmp_path, "--dispersions", "2") == ExitCode.BAD_INPUT
    assert "truth.dispersion 1.0 there, 2.0 here" in capsys.readouterr().err
    doomed = ("--restart", "--set", "mass=3", "--truth", "grip=0")
    assert simulate(tmp_path, *doomed) == ExitCode.BAD_INPUT
    capsys.readouterr()
    assert simulate(tmp_path, "--json") == ExitCode.OK
    assert json.loads(capsys.readouterr().out)["resumed"] == FLIGHTS, "bad input forgets nothing"
    assert simulate(tmp_path, "--dispersions", "2", "--restart", flights=3) == ExitCode.OK


def test_a_failure_is_flown_again_by_the_command_that_is_printed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ("--guidance", "gain=2", "--seed", "40", "--json", "--dispersions", "2")
    assert simulate(tmp_path, *arguments) == ExitCode.OK
    campaign = json.loads(capsys.readouterr().out)
    slow = [flight for flight in campaign["failed"] if "never stopped" in flight["classes"]]
    (seed,) = {flight["seed"] for flight in slow}
    words = shlex.split(campaign["replay"][str(seed)])
    assert words[0] == "dscp"
    assert main([*words[1:], "--output", str(tmp_path)]) == ExitCode.OK
    printed = capsys.readouterr().out
    assert printed.startswith(f"cart, seed {seed}: never stopped")
    assert "pushed off" in printed
    flight = read(tmp_path / f"flight_{seed}.json")
    assert flight["settings"] == campaign["settings"]
    lines = [json.loads(line) for line in (tmp_path / "flights.jsonl").read_text().splitlines()]
    (row,) = [line["row"] for line in lines[1:] if line["row"]["seed"] == seed]
    assert flight["figures"] == row["figures"], "the same flight"
    assert len(flight["states"]) == len(flight["times_s"]) == len(flight["phases"])
    assert (tmp_path / f"flight_{seed}.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--flights", "0"), "flights: got 0"),
        (("--seed", "-1"), "seed: got -1"),
        (("--workers", "0"), "--workers: got 0"),
        (("--replay", "-3"), "--replay: got -3"),
        (("--truth", "lagg=1"), "parameter: got 'lagg', expected a known name"),
        (("--truth", "gain=1"), "parameter: got 'gain'"),  # guidance has it
        (("--truth", "grip"), "--truth: got 'grip', expected NAME=VALUE"),
        (("--truth", "grip=1", "--truth", "grip=2"), "grip only once"),
        (("--truth", "grip=0"), "cannot start"),
        (("--guidance", "gain=3"), "gain: got 3.0, expected [0, 2] 1/s"),
        (("--guidance", "gain=nan"), "gain: got nan"),
        (("--dispersions", "-1"), "dispersion: got -1"),
        (("--dispersions", "1", "--truth", "dispersion=1"), "no --truth dispersion beside it"),
        (("--set", "weight=1"), "parameter: got 'weight'"),
        (("--output", "README.md"), "--output: got 'README.md', expected a directory"),
        (("--output", "README.md/deep/er"), "got 'README.md/deep/er', expected a directory"),
        (("--output", "x" * 300), "File name too long"),
        (("--write-bags", "README.md"), "--write-bags: got 'README.md', expected a directory"),
    ],
)
def test_bad_input(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], said: str
) -> None:
    command = ["simulate", CART, "--output", str(tmp_path / "new"), "--flights", "3", *arguments]
    assert main([*command, "--json"]) == ExitCode.BAD_INPUT
    captured = capsys.readouterr()
    assert said in json.loads(captured.out)["error"]["message"]
    assert not (tmp_path / "new").exists()


def test_a_problem_that_cannot_be_flown(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", "tests/ros/stranger.py:puck"]) == ExitCode.BAD_INPUT
    assert "one that brings a simulation" in capsys.readouterr().err


def test_options_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    listing = ["simulate", CART, "--list-parameters", "--truth", "grip=0.5"]
    assert main(listing) == ExitCode.OK
    printed = capsys.readouterr().out
    assert "--truth:" in printed
    assert "grip        0.5" in printed
    assert main([*listing, "--json"]) == ExitCode.OK
    listed = json.loads(capsys.readouterr().out)
    assert [option["name"] for option in listed["guidance"]] == ["gain"]
    assert {p["name"] for p in listed["parameters"]} > {"mass", "drag"}

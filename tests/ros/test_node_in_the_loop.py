"""Flights whose plans a planner node makes, in a process of its own, over real topics."""

from __future__ import annotations

from pathlib import Path

import pytest

from dscp_core import problems
from dscp_core.campaigns.campaign import Campaign, run_campaign
from dscp_core.planning.settings import PlannerSettings, TerminalTime
from dscp_core.workers.grid import GridFileError
from dscp_ros.cli import ExitCode
from dscp_ros.cli.main import main
from dscp_ros.demo.processes import ChildFailedError
from dscp_ros.flights.node_planner import node_planner

NAME = "powered_descent"
OPTIONS = {"replan_s": 4.0}
SETTINGS = PlannerSettings(terminal_time=TerminalTime.FREE)


def test_a_flight_lands_as_it_does_without_ros(tmp_path: Path) -> None:
    problem = problems.get(NAME)
    here = Campaign(problem, SETTINGS, OPTIONS)
    alone = run_campaign(tmp_path / "alone.jsonl", here, [3], workers=1).flights[0]
    with node_planner(NAME, problem, SETTINGS, tmp_path / "planner.log") as planner:
        campaign = Campaign(problem, SETTINGS, OPTIONS, planner)
        (flight,) = run_campaign(tmp_path / "ros.jsonl", campaign, [3]).flights
        with pytest.raises(GridFileError, match=r"planned_by None there, 'NodePlanner' here"):
            run_campaign(tmp_path / "alone.jsonl", campaign, [3])
    assert flight.failure == alone.failure == ""
    assert flight.figures["refused_replans"] == 0.0
    assert flight.figures["replans"] == alone.figures["replans"]
    # Both planners stop within their tolerance of the same plans.
    for name, bound in (
        ("contact_speed_m_s", 0.05),
        ("contact_position_m", 0.05),
        ("flight_s", 0.2),
        ("fuel_kg", 20.0),
    ):
        assert flight.figures[name] == pytest.approx(alone.figures[name], abs=bound), name
    log = (tmp_path / "planner.log").read_text(encoding="utf-8")
    assert "planner rebuilt with the new parameters" in log, "the node did plan"


def test_a_planner_that_dies_ends_the_campaign_and_is_no_failed_flight(tmp_path: Path) -> None:
    problem, path = problems.get(NAME), tmp_path / "ros.jsonl"

    def fly() -> None:
        with node_planner(NAME, problem, SETTINGS, tmp_path / "planner.log") as planner:
            process = planner._link._process._process
            campaign = Campaign(problem, SETTINGS, {**OPTIONS, "outage_s": 1e3}, planner)
            run_campaign(path, campaign, [3, 4], report=lambda flown: flown and process.kill())

    with pytest.raises(ChildFailedError):
        fly()
    assert len(path.read_text(encoding="utf-8").splitlines()) == 2, "the setup and the first flight"


def test_one_process_plans_for_all(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    arguments = ["simulate", "--over-ros", "--workers", "2", "--output", str(tmp_path)]
    assert main(arguments) == ExitCode.BAD_INPUT
    assert "neither --workers nor --ray" in capsys.readouterr().err

"""Campaigns of flights that are over at once: killed, continued, in any order, on any machine."""

from __future__ import annotations

import json
import math
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from core.toy_problems import cart
from simulation_support import CartSimulation, rolling_cart

from dscp_core.campaigns.campaign import (
    MOST_FLIGHTS,
    Campaign,
    CampaignResult,
    finite,
    fly,
    run_campaign,
    seeds_of,
)
from dscp_core.campaigns.statistics import statistics
from dscp_core.errors import HelperLostError, InvalidInputError
from dscp_core.planning.settings import PlannerSettings
from dscp_core.problem.parameters import Value
from dscp_core.problem.simulation import FlightSummary
from dscp_core.workers.grid import GridFileError

SETTINGS = PlannerSettings(intervals=5)


def campaign(**options: Value) -> Campaign:
    return Campaign(rolling_cart(), SETTINGS, options)


def flown(path: Path, flights: int, workers: int = 1, **options: Value) -> CampaignResult:
    return run_campaign(path, campaign(**options), seeds_of(1, flights), workers=workers)


def test_the_same_whatever_the_number_of_workers(tmp_path: Path) -> None:
    one, three = (flown(tmp_path / f"{n}.jsonl", 60, n, raising=7.0) for n in (1, 3))
    assert one.flights == three.flights
    assert (tmp_path / "1.jsonl").read_bytes() == (tmp_path / "3.jsonl").read_bytes()
    both = [statistics(result.simulation, result.flights) for result in (one, three)]
    assert repr(both[0]) == repr(both[1])
    assert one.digest == three.digest


def test_every_line_is_json_and_the_first_holds_the_setup(tmp_path: Path) -> None:
    path = tmp_path / "flights.jsonl"
    result = flown(path, 3, dispersion=2.0)
    first, *rest = (json.loads(line) for line in path.read_text().splitlines())
    assert first["identity"]["truth.dispersion"] == 2.0
    assert first["identity"]["vehicle.mass"] == 1.5
    assert [line["row"]["seed"] for line in rest] == [1, 2, 3]
    assert [FlightSummary(**line["row"]) for line in rest] == list(result.flights)


def test_killed_in_the_middle_and_continued(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, whole, flights = tmp_path / "flights.jsonl", tmp_path / "whole.jsonl", 80
    code = (
        f"import sys; sys.path[:0] = {sys.path!r}\n"
        "from pathlib import Path\n"
        "from core.campaigns.test_campaign import flown\n"
        "if __name__ == '__main__':\n"
        f"    flown(Path({str(path)!r}), {flights}, 2, sleep_s=0.02)\n"
    )
    child = subprocess.Popen([sys.executable, "-c", code])
    try:
        while not path.exists() or path.read_bytes().count(b"\n") < 12:
            assert child.poll() is None, "it ended by itself"
            time.sleep(0.01)
    finally:
        child.send_signal(signal.SIGKILL)
        child.wait()
    with path.open("ab") as file:  # the line that it was writing
        file.write(b'{"item":[77],"row":{"seed":77,"figures":{"stop_sp')
    log = tmp_path / "second"
    monkeypatch.setenv("CART_LOG", str(log))
    again = flown(path, flights, 2)
    monkeypatch.delenv("CART_LOG")
    uninterrupted = flown(whole, flights)
    assert again.flights == uninterrupted.flights
    assert 11 <= again.kept < flights
    assert again.damaged == 1
    seeds = sorted(int(line) for line in log.read_text().split())
    assert seeds == list(range(again.kept + 1, flights + 1)), "what was kept is not flown again"
    assert path.read_bytes() == whole.read_bytes(), "nothing twice, nothing left out"


def test_another_setup_is_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "flights.jsonl"
    flown(path, 2)
    content = path.read_bytes()
    with pytest.raises(GridFileError, match=r"guidance\.gain 0\.5 there, 0\.7 here"):
        flown(path, 2, gain=0.7)
    other = Campaign(rolling_cart(), PlannerSettings(parameters={"mass": 2.0}, intervals=5))
    with pytest.raises(GridFileError, match=r"vehicle\.mass 1\.5 there, 2\.0 here"):
        run_campaign(path, other, seeds_of(1, 2))
    coarse = Campaign(rolling_cart(), PlannerSettings(intervals=6))
    with pytest.raises(GridFileError, match=r"planner\.intervals 5 there, 6 here"):
        run_campaign(path, coarse, seeds_of(1, 2))
    assert path.read_bytes() == content
    assert flown(path, 4).kept == 2, "more flights of the same setup are flown on top"


def test_a_flight_that_raises_is_one_failure(tmp_path: Path) -> None:
    result = flown(tmp_path / "flights.jsonl", 10, raising=5.0)
    failed = {flight.seed: flight for flight in result.flights if flight.failure}
    assert sorted(failed) == [5, 10]
    assert failed[5] == FlightSummary(
        5, {}, "error", story="ZeroDivisionError: seed 5 has no wheels"
    )


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_figure_that_is_no_number_is_a_failure(value: float) -> None:
    told = finite(FlightSummary(3, {"a": 1.0, "b": value}, "", story="rolled"))
    assert told == FlightSummary(3, {"a": 1.0}, "error", story=f"b is {value}; rolled")


@pytest.mark.parametrize("lost", [KeyboardInterrupt, HelperLostError, MemoryError])
def test_what_says_nothing_of_a_flight_is_no_failure_of_it(lost: type[BaseException]) -> None:
    class Interrupted(CartSimulation):
        def fly(self, seed: int) -> FlightSummary:
            raise lost

    with pytest.raises(lost):
        fly(Interrupted(1.0, {}), 1)


def test_refusals(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="extras bring a simulation"):
        run_campaign(tmp_path / "a", Campaign(cart(), SETTINGS), [1])
    with pytest.raises(InvalidInputError, match="grip"):
        flown(tmp_path / "a", 1, grip=0.0)
    for first, flights in ((1, 0), (1, -1), (-1, 5), (1, MOST_FLIGHTS + 1)):
        with pytest.raises(InvalidInputError, match=r"flights|seed"):
            seeds_of(first, flights)
    assert not (tmp_path / "a").exists()

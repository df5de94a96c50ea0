"""Figures of campaigns, whatever came of the flights."""

from __future__ import annotations

import pytest
from simulation_support import VALUES, CartSimulation

from dscp_core.campaigns.figures import WORST, campaign_figure, flight_figure, worst_seeds
from dscp_core.campaigns.statistics import judge, statistics
from dscp_core.problem.simulation import FlightSummary

SIMULATION = CartSimulation(1.5, VALUES)
FLIGHTS = [SIMULATION.fly(seed) for seed in range(1, 101)]
ERROR = FlightSummary(7, {}, "error", story="why")


@pytest.mark.parametrize(
    "flights",
    [FLIGHTS, FLIGHTS[:1], FLIGHTS[:3], [ERROR], [ERROR, *FLIGHTS[:2]], [FLIGHTS[48]]],
    ids=["many", "one", "three", "error", "some", "never stopped"],
)
def test_it_can_be_drawn(flights: list[FlightSummary]) -> None:
    summed = statistics(SIMULATION, flights)
    worst = [SIMULATION.record(seed) for seed in worst_seeds(SIMULATION, flights)]
    figure = campaign_figure(SIMULATION, flights, summed, worst, "carts")
    figure.canvas.draw()


def test_the_worst_are_those_that_failed_and_then_the_fastest() -> None:
    failed = {f.seed for f in FLIGHTS if judge(SIMULATION.figures, f)}
    assert set(worst_seeds(SIMULATION, [*FLIGHTS, ERROR])) <= failed
    good = [flight for flight in FLIGHTS if flight.seed not in failed]
    fastest = sorted(good, key=lambda flight: -flight.figures["stop_speed_m_s"])[:WORST]
    assert worst_seeds(SIMULATION, good) == tuple(flight.seed for flight in fastest)


def test_the_ellipse_and_the_bound_are_where_the_flights_are() -> None:
    figure = campaign_figure(SIMULATION, FLIGHTS, statistics(SIMULATION, FLIGHTS), [], "carts")
    *ellipses, bound = figure.axes[0].patches
    assert len(ellipses) == 3
    assert (bound.width, bound.height) == (6.0, 6.0)  # type: ignore[attr-defined]
    wide, high = (ellipses[0].width, ellipses[0].height)  # type: ignore[attr-defined]
    assert 1.6 < wide < 2.4, "twice the standard deviation of 1 m to the east"
    assert 0.8 < high < 1.2
    assert min(ellipses[0].angle % 180.0, 180.0 - ellipses[0].angle % 180.0) < 15.0  # type: ignore[attr-defined]


def test_one_flight() -> None:
    record = SIMULATION.record(3)
    figure = flight_figure(record, "cart")
    assert [axes.get_title(loc="left") for axes in figure.axes] == list(record.histories)
    figure.canvas.draw()

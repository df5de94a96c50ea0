"""Statistics of campaigns against values worked out by hand, and by simulation."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from simulation_support import FIGURES, VALUES, CartSimulation

from dscp_core.campaigns.statistics import judge, mean, quantile, share, statistics
from dscp_core.problem.simulation import FlightFigure, FlightSummary, worst_of

SIMULATION = CartSimulation(1.5, VALUES)
GOOD = {"stop_speed_m_s": 0.5, "miss_m": 1.0, "energy_j": 2.0, "east_m": 0.0, "north_m": 1.0}

NUMBERS = st.floats(-1e6, 1e6, allow_nan=False)


def test_share_is_clopper_pearson() -> None:
    # Of n successes in n trials the interval begins at (alpha / 2)^(1 / n), and ends at 1.
    full = share(20, 20)
    assert full.low == pytest.approx(0.025 ** (1 / 20))
    assert (full.value, full.high) == (1.0, 1.0)
    none = share(0, 50)
    assert (none.value, none.low) == (0.0, 0.0)
    assert none.high == pytest.approx(1.0 - 0.025 ** (1 / 50))
    # Tabulated: 95 of 100.
    usual = share(95, 100)
    assert usual.low == pytest.approx(0.8872, abs=1e-4)
    assert usual.high == pytest.approx(0.9836, abs=1e-4)


@pytest.mark.parametrize(("count", "bounded"), [(367, False), (368, True)])
def test_too_few_values_do_not_bound_a_percentile(count: int, bounded: bool) -> None:
    """All are below the 99th percentile with 0.99^n, which is 2.5 % at 367.04."""
    estimate = quantile(np.arange(float(count)), 0.99)
    assert (estimate.high is not None) == bounded
    assert estimate.low is not None


def test_an_interval_of_the_median_is_made_of_order_statistics() -> None:
    # Of 10 values: the second and the ninth, with 1 - 2 (1 + 10) / 2^10 = 97.9 %.
    estimate = quantile(np.arange(1.0, 11.0), 0.5)
    assert (estimate.value, estimate.low, estimate.high) == (5.5, 2.0, 9.0)


def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    random = np.random.default_rng(7)
    truth = {"mean": 2.0, "p90": 2.0 * math.log(10.0)}
    held = dict.fromkeys(truth, 0)
    for _ in range(200):
        values = random.exponential(2.0, 60)
        for name, estimate in (("mean", mean(values)), ("p90", quantile(values, 0.9))):
            low, high = estimate.low, estimate.high
            held[name] += (low or 0.0) <= truth[name] <= (math.inf if high is None else high)
    # 95 % of 200, less four standard deviations.
    assert held["mean"] >= 190 - 16
    assert held["p90"] >= 190 - 12


@settings(deadline=None, max_examples=50)
@given(st.lists(NUMBERS, min_size=1, max_size=30), st.sampled_from([0.5, 0.9, 0.99]))
def test_estimates_stand_in_their_order(numbers: list[float], level: float) -> None:
    values = np.array(numbers)
    for estimate in (quantile(values, level), mean(values)):
        assert math.isfinite(estimate.value)
        for end in (estimate.low, estimate.high):
            assert end is None or values.min() - 1e-6 <= end <= values.max() + 1e-6
        if estimate.low is not None and estimate.high is not None:
            assert estimate.low <= estimate.high


def test_few_or_equal_values() -> None:
    assert (mean(np.array([3.0])).low, mean(np.array([3.0, 4.0])).high) == (None, None)
    constant = mean(np.full(10, 0.1))
    assert constant.low == constant.value == constant.high


@pytest.mark.parametrize(
    ("changes", "failure", "classes"),
    [
        ({}, "", None),
        ({"stop_speed_m_s": 1.0}, "", None),  # on the bound
        ({"stop_speed_m_s": 1.0 + 1e-12}, "", ("hard",)),
        ({"energy_j": 1e9}, "", None),  # not judged
        ({"stop_speed_m_s": 1.1, "miss_m": 30.0}, "", ("off target", "hard")),  # gravest first
        ({"stop_speed_m_s": None}, "", ("no stop_speed_m_s",)),
        ({}, "never stopped", ("never stopped",)),
        ({"miss_m": 30.0}, "never stopped", ("never stopped",)),
    ],
)
def test_judgement(
    changes: dict[str, float | None], failure: str, classes: tuple[str, ...] | None
) -> None:
    figures = {n: v for n, v in {**GOOD, **changes}.items() if v is not None}
    failed = judge(FIGURES, FlightSummary(4, figures, failure, story="rolled"))
    assert (failed and failed.classes) == classes
    if failed:
        over = {n: v for n, v in changes.items() if v is not None and n != "energy_j"}
        assert failed.figures == over


def test_a_bound_of_zero_is_exceeded_by_anything_above() -> None:
    figures = tuple(
        FlightFigure(name, "m", "", most, name) for name, most in (("a", 0.0), ("b", 1.0))
    )
    assert worst_of(figures, {"a": 1e-9, "b": 5.0}) == "a"
    assert worst_of(figures, {"a": 0.0, "b": 1.0}) == ""
    failed = judge(figures, FlightSummary(1, {"a": 1e-9, "b": 5.0}))
    assert failed is not None
    assert failed.classes == ("a", "b")


def test_a_bound_without_a_word_is_named_by_its_number() -> None:
    figure = FlightFigure("tilt_rad", "rad", "Tilt.", 0.0)
    failed = judge([figure], FlightSummary(1, {"tilt_rad": 0.1}))
    assert failed is not None
    assert failed.classes == ("tilt_rad > 0",)


def test_sums() -> None:
    flights = [SIMULATION.fly(seed) for seed in range(1, 101)]
    flights[3] = FlightSummary(4, {}, "error", story="why")
    summed = statistics(SIMULATION, flights)
    assert repr(statistics(SIMULATION, flights[::-1])) == repr(summed), "in any order"
    speeds = np.array(
        [f.figures["stop_speed_m_s"] for f in flights if "stop_speed_m_s" in f.figures]
    )
    first = summed.figures[0]
    assert first.figure.name == "stop_speed_m_s"
    assert (first.count, first.greatest) == (97, speeds.max())  # without 4, 49 and 99
    assert flights[first.greatest_seed - 1].figures["stop_speed_m_s"] == speeds.max()
    assert first.p90.value == np.percentile(speeds, 90)
    hard = int((speeds > 1.0).sum())
    assert summed.classes == {"hard": hard, "never stopped": 2, "error": 1}
    assert summed.successes == 100 - 3 - hard == 100 - len(summed.failed)
    assert [flight.seed for flight in summed.failed] == sorted(f.seed for f in summed.failed)
    footprint = summed.footprint
    assert footprint is not None
    places = np.array([[f.figures[n] for n in SIMULATION.footprint] for f in flights if f.figures])
    assert np.allclose(footprint.centre_m, places.mean(axis=0))
    assert np.allclose(footprint.covariance_m2, np.cov(places.T))


def test_the_ellipses_hold_a_normal_distribution_as_they_say() -> None:
    random = np.random.default_rng(1)
    turned = random.standard_normal((20_000, 2)) @ np.array([[3.0, 1.0], [0.0, 0.5]])
    names = SIMULATION.footprint
    flights = [
        FlightSummary(seed, dict(zip(names, map(float, place), strict=True)))
        for seed, place in enumerate(turned)
    ]
    footprint = statistics(SIMULATION, flights).footprint
    assert footprint is not None
    assert footprint.inside == pytest.approx((0.3935, 0.8647, 0.9889), abs=0.01)


def test_flights_that_all_end_at_one_place() -> None:
    flights = [FlightSummary(seed, GOOD) for seed in range(5)]
    footprint = statistics(SIMULATION, flights).footprint
    assert footprint is not None
    assert footprint.inside == (1.0, 1.0, 1.0)
    assert statistics(SIMULATION, flights[:2]).footprint is None

"""The study of the surface-to-mass ratio: its runs, its descent, its summary and figures."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dscp_core.errors import InvalidInputError
from dscp_core.studies import surface_to_mass_figures as figures
from dscp_core.studies.surface_to_mass import (
    FULL_POINTS,
    LARGEST_ERROR,
    PAPER,
    QUICK_POINTS,
    SurfaceToMassModel,
    changes_count,
    summarise,
    sweep_items,
)
from dscp_core.studies.trust_region_cases import CASES
from dscp_core.workers.grid import Item, Row


@pytest.fixture(scope="module")
def evaluate() -> Callable[[Item], Row]:
    return SurfaceToMassModel()()


@pytest.mark.parametrize(("ratio", "count"), [(0.8, 5), (1.15, 6)])
def test_gradient_at_equal_iterations(
    evaluate: Callable[[Item], Row], ratio: float, count: int
) -> None:
    row = evaluate(("point", "case4", 100, ratio))
    assert row["iterations"] == count
    assert row["trusted"]
    assert not row["across_kink"]
    assert abs(row["difference"]) > 1e-3
    assert row["relative_error"] <= LARGEST_ERROR
    assert row["gradient"] == pytest.approx(row["difference"], rel=LARGEST_ERROR)


def test_optimum_by_descent(evaluate: Callable[[Item], Row]) -> None:
    row = evaluate(("descent", "case4", 100))
    paper = PAPER["case4", 100]
    assert row["steps"][0]["ratio"] == 1.0
    assert row["ratio"] == pytest.approx(paper.ratio, abs=0.02)
    assert row["cost"] == pytest.approx(paper.cost, abs=1e-4)
    assert abs(row["steps"][-1]["gradient"]) < 1e-6


def test_a_coarse_sweep_is_part_of_the_fine_one() -> None:
    coarse, fine = sweep_items(QUICK_POINTS), sweep_items(FULL_POINTS)
    assert set(coarse) <= set(fine)
    assert len(fine) == 2 * len(CASES) * 42
    assert ("point", "case2", 200, 0.9375) in fine
    with pytest.raises(InvalidInputError, match="points"):
        sweep_items({100: 2})


def hand_made(*, noise: float = 0.0, best: float = 0.9) -> tuple[list[Item], list[Row]]:
    """Parabolas with an optimum, one false stop, one failure, one flagged gradient."""
    rng = np.random.default_rng(5)
    items = sweep_items({100: 21, 200: 21})
    rows: list[dict[str, Any]] = []
    for item in items:
        if item[0] == "descent":
            steps = [{"ratio": 0.9, "cost": 0.0358, "gradient": 0.0}]
            rows.append({"iterations": 5, "steps": steps, "ratio": 0.9, "cost": 0.0358})
            continue
        ratio = float(item[3])
        slope = 0.04 * (ratio - best)
        rows.append(
            {
                "ratio": ratio,
                "status": "converged",
                "iterations": 5 if ratio < 1.0 else 6,
                "cost": 0.0358 + 0.02 * (ratio - best) ** 2 + noise * rng.normal(),
                "max_defect": 1e-5,
                "gradient": slope,
                "trusted": ratio != 1.1,
                "difference": slope * (1.0 + 1e-6),
                "uncertainty": 1e-12,
                "across_kink": False,
                "relative_error": 1e-6,
            }
        )
        if ratio == 0.95:
            rows[-1] |= {"cost": 0.0, "max_defect": 1e-2}
        if ratio == 1.25:
            rows[-1] |= {"cost": None, "gradient": None, "difference": None, "max_defect": None}
            rows[-1] |= {"status": "diverged", "trusted": False, "relative_error": None}
    return items, rows


def test_summary() -> None:
    items, rows = hand_made()
    table = summarise(items, rows)
    assert [(row.case, row.intervals) for row in table] == list(PAPER)
    for row in table:
        assert row.optimal_ratio == pytest.approx(0.9), "not the false stop, though it costs less"
        assert row.descent_ratio == 0.9
        assert (row.flagged, row.false_stops, row.failed, row.compared) == (1, 1, 1, 19)
        assert row.gradient_correlation["equal_k"] == pytest.approx(1.0)
        assert row.gradient_correlation["sweep"] == pytest.approx(1.0)
        swept = row.gradient_correlation["sweep_all"]
        assert swept is not None
        assert swept < 0.9, "the false stop is a spike"
        assert row.max_relative_error == 1e-6
        assert row.mean_iterations == pytest.approx(5.5)
        assert row.std_iterations == pytest.approx(0.5)
    names = {"case", "intervals", "optimal_ratio", "optimal_cost", "mean_iterations"}
    assert names | {"std_iterations", "gradient_correlation"} <= set(table[0].document())


@pytest.mark.parametrize(("best", "expected"), [(0.87, 0.87), (0.986, 0.975)])
def test_optimum_between_points(best: float, expected: float) -> None:
    # From 1.0 on it takes another iteration: no cubic reaches across.
    row = summarise(*hand_made(best=best))[0]
    assert row.optimal_ratio == pytest.approx(expected)
    assert row.optimal_cost == pytest.approx(0.0358 + 0.02 * (expected - best) ** 2)


def test_noise_of_the_sweep_lowers_its_correlation_only() -> None:
    (noisy, *_), (smooth, *_) = summarise(*hand_made(noise=2e-4)), summarise(*hand_made())
    swept = noisy.gradient_correlation["sweep"]
    assert swept is not None
    assert swept < 0.9
    assert noisy.gradient_correlation["equal_k"] == smooth.gradient_correlation["equal_k"]


def test_neighbours_with_another_count() -> None:
    points = [{"iterations": count} for count in (5, 5, 5, 6, 6, 7)]
    assert changes_count(points) == [False, False, True, True, True, True]


@pytest.mark.filterwarnings("error")
def test_figures(tmp_path: Path) -> None:
    items, rows = hand_made()
    for number, figure in enumerate(
        (figures.sweep_figure(items, rows, 100), figures.gradient_figure(items, rows, 200))
    ):
        path = tmp_path / f"{number}.png"
        figure.savefig(path, dpi=40)
        assert path.stat().st_size > 2_000

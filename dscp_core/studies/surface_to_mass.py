"""Surface-to-mass ratio of the entry vehicle (section 4.3): sweep, gradients, and the optimum.

At every ratio the iterations stop by the paper's rule. The gradient of the cost through them is
compared with differences at the same number of iterations, and with the slope of the sweep, as the
paper does; there the number of iterations changes between neighbours.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline

from dscp_core.errors import InvalidInputError
from dscp_core.gradients.differences import RunDifferences, relative_error
from dscp_core.gradients.losses import CostLoss
from dscp_core.gradients.run import DifferentiationError, Gradient, unrolled
from dscp_core.studies.trust_region_cases import (
    CASES,
    FALSE_STOP_DEFECT,
    MOST_ITERATIONS,
    EntryRuns,
)
from dscp_core.workers.grid import Item, Row

Array = NDArray[np.float64]

PARAMETER = "surface_to_mass_ratio"
RATIOS = (0.75, 1.25)
QUICK_POINTS = {100: 21, 200: 11}
FULL_POINTS = {100: 41, 200: 41}
"""Number of ratios for each number of intervals."""
LARGEST_ERROR = 1e-4
"""What a gradient that the verdict calls regular may be off by, relative to its size."""

# With one extrapolation, differences are then good to 1e-7 where no active set changes.
_DIFFERENCE_STEP = 2e-4
_DESCENT_START = 1.0
_FIRST_STEP = 0.02
_LONGEST_STEP = 0.1
_SETTLED_STEP = 1e-5
_MOST_STEPS = 20


@dataclass(frozen=True)
class PaperResult:
    """A row of the paper's table.

    Attributes:
        ratio: Optimal w_S/m.
        cost: Its J1.
        mean_iterations, std_iterations: Over the sweep.
    """

    ratio: float
    cost: float
    mean_iterations: float
    std_iterations: float


PAPER = {
    ("case1", 100): PaperResult(0.94, 0.0368, 18.92, 2.49),
    ("case2", 100): PaperResult(0.93, 0.0359, 7.86, 2.91),
    ("case3", 100): PaperResult(0.93, 0.0358, 5.34, 0.22),
    ("case4", 100): PaperResult(0.93, 0.0358, 5.13, 0.73),
    ("case1", 200): PaperResult(1.00, 0.0373, 20.00, 0.00),
    ("case2", 200): PaperResult(0.92, 0.0358, 11.59, 0.40),
    ("case3", 200): PaperResult(0.91, 0.0356, 8.04, 0.47),
    ("case4", 200): PaperResult(0.91, 0.0356, 7.47, 0.25),
}


@dataclass(frozen=True)
class SurfaceToMassModel:
    """What a worker of the study needs. Calling it makes its function."""

    def __call__(self) -> Callable[[Item], Row]:
        """Make the function; problems are compiled when they are needed."""
        return _Evaluator()


def sweep_items(points: Mapping[int, int]) -> list[Item]:
    """All items of the study; those that take longest come first.

    Args:
        points: Number of ratios for each number of intervals.

    Raises:
        InvalidInputError: Fewer than three.
    """
    if min(points.values()) < 3:
        raise InvalidInputError("points", dict(points), ">= 3")
    items: list[Item] = []
    for intervals in sorted(points, reverse=True):
        # Rounded: the same ratio of a coarse and a fine sweep has the same name.
        ratios = [round(float(ratio), 9) for ratio in np.linspace(*RATIOS, points[intervals])]
        items += [("descent", case.name, intervals) for case in CASES]
        for case in CASES:
            items += [("point", case.name, intervals, ratio) for ratio in ratios]
    return items


class _Evaluator:
    def __init__(self) -> None:
        self._weights = {case.name: case.log_weights for case in CASES}
        self._runs: dict[int, EntryRuns] = {}

    def __call__(self, item: Item) -> Row:
        case, intervals = str(item[1]), int(item[2])
        if intervals not in self._runs:
            self._runs[intervals] = EntryRuns(intervals)
        runs = self._runs[intervals]
        if item[0] == "descent":
            return _descend(runs, self._weights[case])
        return _point(runs, self._weights[case], float(item[3]))


def _point(runs: EntryRuns, log_weights: tuple[float, float], ratio: float) -> dict[str, Any]:
    scp = runs.scp()
    trace = scp.run(runs.parameters(log_weights, ratio))
    row: dict[str, Any] = {
        "ratio": ratio,
        "status": trace.status.name.lower(),
        "iterations": len(trace.iterations),
        "cost": None,
        "max_defect": None,
        "gradient": None,
        "trusted": False,
        "difference": None,
        "uncertainty": None,
        "across_kink": False,
        "relative_error": None,
    }
    try:
        gradient = unrolled(scp, trace, CostLoss())
    except DifferentiationError:
        return row
    slope = _by_ratio(runs, gradient)
    difference = RunDifferences(scp, trace, CostLoss()).derivative(
        PARAMETER, step=_DIFFERENCE_STEP, most_steps=2
    )
    size = max(abs(slope), abs(difference.value or 0.0))
    return {
        **row,
        "cost": gradient.value,
        "max_defect": runs.largest_defect(trace.iterations[-1]),
        "gradient": slope,
        "trusted": gradient.trusted,
        "difference": difference.value,
        "uncertainty": difference.uncertainty if math.isfinite(difference.uncertainty) else None,
        "across_kink": difference.crosses_active_set_change,
        "relative_error": relative_error(slope, difference, size),
    }


def _by_ratio(runs: EntryRuns, gradient: Gradient) -> float:
    return float(gradient.parameters[runs.transcription.table.slice(PARAMETER)][0])


def _descend(runs: EntryRuns, log_weights: tuple[float, float]) -> dict[str, Any]:
    """Gradient descent with the steps of Barzilai and Borwein, at a fixed number of iterations.

    The number is what the nominal ratio needs: the cost would jump with it.
    """
    nominal = runs.scp(MOST_ITERATIONS).run(runs.parameters(log_weights, _DESCENT_START))
    count = runs.iterations_needed(nominal, flyable=True) or MOST_ITERATIONS
    scp = runs.scp(count)
    ratio = _DESCENT_START
    steps: list[dict[str, float]] = []
    for _ in range(_MOST_STEPS):
        trace = scp.run(runs.parameters(log_weights, ratio))
        try:
            gradient = unrolled(scp, trace, CostLoss())
        except DifferentiationError:
            break  # the steps so far are the result
        steps.append(
            {"ratio": ratio, "cost": gradient.value, "gradient": _by_ratio(runs, gradient)}
        )
        following = min(max(ratio + _step(steps), RATIOS[0]), RATIOS[1])
        if abs(following - ratio) < _SETTLED_STEP:
            break
        ratio = following
    best = min(steps, key=lambda entry: abs(entry["gradient"]), default=None)
    return {
        "iterations": count,
        "steps": steps,
        "ratio": None if best is None else best["ratio"],
        "cost": None if best is None else best["cost"],
    }


def _step(steps: Sequence[Mapping[str, float]]) -> float:
    """The gradient over the curvature that the last two steps have seen, if it is positive."""
    slope = steps[-1]["gradient"]
    step = -math.copysign(_FIRST_STEP, slope)
    if len(steps) > 1:
        rise = slope - steps[-2]["gradient"]
        curvature = rise / (steps[-1]["ratio"] - steps[-2]["ratio"])
        if curvature > 0.0:
            step = -slope / curvature
    return min(max(step, -_LONGEST_STEP), _LONGEST_STEP)


@dataclass(frozen=True)
class SurfaceToMassRow:
    """One case at one number of intervals.

    Attributes:
        case, intervals: Which.
        optimal_ratio, optimal_cost: Of the sweep, as in the paper, false stops left out.
        descent_ratio, descent_cost: By gradient descent through the iterations.
        descent_iterations: Their fixed number there.
        mean_iterations, std_iterations: Over the sweep.
        gradient_correlation: With differences at ``equal_k``; with the slope of the ``sweep``
            without its false stops; and with all of them, ``sweep_all``.
        max_relative_error: Of the gradients that are called regular, at equal K.
        compared: How many these are.
        flagged: How many the verdict warns of.
        across_kink: How many differences reach across a change of an active set, left out.
        false_stops: How many stop far from the dynamics.
        failed: How many ratios have no result.
        paper: The paper's row.
    """

    case: str
    intervals: int
    optimal_ratio: float | None
    optimal_cost: float | None
    descent_ratio: float | None
    descent_cost: float | None
    descent_iterations: int
    mean_iterations: float | None
    std_iterations: float | None
    gradient_correlation: dict[str, float | None]
    max_relative_error: float | None
    compared: int
    flagged: int
    across_kink: int
    false_stops: int
    failed: int
    paper: PaperResult

    def document(self) -> dict[str, Any]:
        """As JSON holds it."""
        return asdict(self)


def rows_of(
    items: Sequence[Item], rows: Sequence[Row], case: str, intervals: int
) -> tuple[list[Row], Row]:
    """The sweep's points, in order, and the descent of one case at one number of intervals."""
    mine = [
        (item[0], row)
        for item, row in zip(items, rows, strict=True)
        if item[1:3] == (case, intervals)
    ]
    points = sorted((row for kind, row in mine if kind == "point"), key=lambda row: row["ratio"])
    return points, next(row for kind, row in mine if kind == "descent")


def summarise(items: Sequence[Item], rows: Sequence[Row]) -> list[SurfaceToMassRow]:
    """The table of a complete sweep, in the paper's order."""
    return [
        _summary(case.name, intervals, *rows_of(items, rows, case.name, intervals))
        for intervals in sorted({int(item[2]) for item in items})
        for case in CASES
    ]


def _summary(case: str, intervals: int, points: Sequence[Row], descent: Row) -> SurfaceToMassRow:
    solved = solved_points(points)
    flyable = [row for row in solved if not false_stop(row)]
    best_ratio, best_cost = _optimum(flyable)
    counts = np.array([row["iterations"] for row in solved], dtype=float)
    regular = [row for row in points if regular_difference(row)]
    compared = [row for row in regular if row["relative_error"] is not None]
    return SurfaceToMassRow(
        case=case,
        intervals=intervals,
        optimal_ratio=best_ratio,
        optimal_cost=best_cost,
        descent_ratio=descent["ratio"],
        descent_cost=descent["cost"],
        descent_iterations=descent["iterations"],
        mean_iterations=float(np.mean(counts)) if solved else None,
        std_iterations=float(np.std(counts)) if solved else None,
        gradient_correlation={
            "equal_k": _correlation(
                [row["gradient"] for row in regular], [row["difference"] for row in regular]
            ),
            "sweep": _sweep_correlation(flyable),
            "sweep_all": _sweep_correlation(solved),
        },
        max_relative_error=max((row["relative_error"] for row in compared), default=None),
        compared=len(compared),
        flagged=sum(not row["trusted"] for row in solved),
        across_kink=sum(row["across_kink"] for row in solved),
        false_stops=sum(map(false_stop, solved)),
        failed=len(points) - len(solved),
        paper=PAPER[case, intervals],
    )


def solved_points(points: Sequence[Row]) -> list[Row]:
    """Those with a cost and a gradient."""
    return [row for row in points if row["cost"] is not None]


def false_stop(row: Row) -> bool:
    """Whether the cost had settled far from the dynamics."""
    return bool(row["status"] == "converged" and row["max_defect"] > FALSE_STOP_DEFECT)


def regular_difference(row: Row) -> bool:
    """Whether gradient and difference are of the same smooth piece."""
    return bool(row["trusted"] and not row["across_kink"] and row["difference"] is not None)


def sweep_slopes(points: Sequence[Row]) -> list[float]:
    """Differences of neighbouring costs, as in the paper; one-sided at both ends."""
    if len(points) < 3:
        return [math.nan] * len(points)
    costs, ratios = [row["cost"] for row in points], [row["ratio"] for row in points]
    slopes = np.gradient(costs, ratios, edge_order=2)
    return [float(slope) for slope in slopes]


def changes_count(points: Sequence[Row]) -> list[bool]:
    """Whether a neighbour of each point stopped after another number of iterations."""
    counts = [row["iterations"] for row in points]
    return [len(set(counts[max(number - 1, 0) : number + 2])) > 1 for number in range(len(counts))]


def _optimum(points: Sequence[Row]) -> tuple[float | None, float | None]:
    """Ratio and cost of the best point.

    Where a neighbour took equally many iterations and its slope has the other sign, the least of
    the cubic through both costs and slopes.
    """
    if not points:
        return None, None
    number = min(range(len(points)), key=lambda index: points[index]["cost"])
    best = points[number]
    for pair in (points[max(number - 1, 0) : number + 1], points[number : number + 2]):
        changes_sign = pair[0]["gradient"] < 0.0 < pair[-1]["gradient"]
        if changes_sign and pair[0]["iterations"] == pair[-1]["iterations"]:
            ratios, costs, slopes = (
                np.array([row[name] for row in pair]) for name in ("ratio", "cost", "gradient")
            )
            cubic = CubicHermiteSpline(ratios, costs, slopes)
            least = min(cubic.derivative().roots(extrapolate=False), key=cubic)
            return float(least), float(cubic(least))
    return best["ratio"], best["cost"]


def _sweep_correlation(points: Sequence[Row]) -> float | None:
    return _correlation([row["gradient"] for row in points], sweep_slopes(points))


def _correlation(first: Sequence[float], second: Sequence[float]) -> float | None:
    if len(first) < 3:
        return None
    return float(np.corrcoef(first, second)[0, 1])

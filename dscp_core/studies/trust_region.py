"""Trust-region weights of the entry: how they decide convergence (section 4.2.2).

A grid over log10 w_gamma and log10 w_u, the paper's four cases, and a descent on the convergence
metric from a slow start.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dscp_core.errors import InvalidInputError
from dscp_core.gradients.losses import ConvergenceLoss, LogConvergenceLoss
from dscp_core.gradients.run import DifferentiationError, Gradient, unrolled
from dscp_core.problems.entry import physics
from dscp_core.scp.trace import ScpResult, ScpStatus
from dscp_core.studies.trust_region_cases import (
    CASES,
    FALSE_STOP_DEFECT,
    MOST_ITERATIONS,
    EntryRuns,
)
from dscp_core.workers.grid import Item, Row

Array = NDArray[np.float64]

LOG_GAMMA = (1.0, 2.0)
LOG_CONTROL = (-1.0, 2.0)
"""Range of the paper's maps; smaller w_gamma diverges."""
BASIN = ((1.3, 1.5), (-0.7, 0.4))
"""Where the paper finds fast convergence."""
QUICK_POINTS = (11, 13)
FULL_POINTS = (21, 61)

SLOW_START = CASES[0].log_weights
DESCENT_STEPS = 14
_LEARNING_RATE = 0.2
_DECAY = (0.9, 0.999)
_LOSS_FLOOR = 1e-9


@dataclass(frozen=True)
class TrustRegionModel:
    """What a worker of the study needs. Calling it makes its function.

    Attributes:
        intervals: Number of intervals N.
    """

    intervals: int

    def __call__(self) -> Callable[[Item], Row]:
        """Compile the problem."""
        return _Evaluator(self.intervals)


def grid_items(points: tuple[int, int]) -> list[Item]:
    """All items of the study; those that take longest come first.

    Args:
        points: Number of values of log10 w_gamma and of log10 w_u.

    Raises:
        InvalidInputError: Fewer than two values.
    """
    if min(points) < 2:
        raise InvalidInputError("points", points, ">= 2 along each axis")
    items: list[Item] = [("descent",)]
    items += [("case", case.name) for case in CASES]
    for log_gamma in _axis(LOG_GAMMA, points[0]):
        items += [("point", log_gamma, log) for log in _axis(LOG_CONTROL, points[1])]
    return items


def _axis(limits: tuple[float, float], count: int) -> list[float]:
    # Rounded: the same point of a coarse and a fine grid has the same name.
    return [round(float(value), 9) for value in np.linspace(*limits, count)]


class _Evaluator:
    def __init__(self, intervals: int) -> None:
        self._runs = EntryRuns(intervals)
        states = self._runs.transcription.problem.states
        self._index = {state.name: number for number, state in enumerate(states)}

    def __call__(self, item: Item) -> Row:
        if item[0] == "descent":
            return {"steps": self._descend()}
        if item[0] == "case":
            case = next(case for case in CASES if case.name == item[1])
            return self._case(case.log_weights)
        return self._point((float(item[1]), float(item[2])))[1]

    def _point(self, log_weights: tuple[float, float]) -> tuple[ScpResult, dict[str, Any]]:
        scp = self._runs.scp()
        trace = scp.run(self._runs.parameters(log_weights))
        row: dict[str, Any] = {
            "log_weights": list(log_weights),
            "status": trace.status.name.lower(),
            "iterations": len(trace.iterations),
            "cost": None,
            "loss": None,
            "gradient": None,
            "trusted": False,
            "max_defect": None,
        }
        try:
            gradient = unrolled(scp, trace, ConvergenceLoss())
        except DifferentiationError:
            return trace, row
        slopes = self._runs.weight_gradient(gradient.parameters, log_weights)
        return trace, {
            **row,
            "cost": trace.iterations[-1].cost,
            "loss": gradient.value,
            "gradient": slopes.tolist() if np.all(np.isfinite(slopes)) else None,
            "trusted": gradient.trusted,
            "max_defect": self._runs.largest_defect(trace.iterations[-1]),
        }

    def _case(self, log_weights: tuple[float, float]) -> dict[str, Any]:
        """A point, with all that its figures show."""
        trace, row = self._point(log_weights)
        layout = self._runs.transcription.layout
        trajectories = [
            layout.states(iteration.solution.z[: layout.reference_size])
            for iteration in trace.iterations
        ]
        values = self._runs.transcription.problem.table.unpack(trace.parameters)
        final = layout.states(trace.final_reference)
        limited: dict[str, Callable[[Any, Any], Any]] = {
            "dynamic_pressure": physics.dynamic_pressure,
            "heat_rate": physics.heat_rate,
            "load_factor": physics.load_factor,
        }
        time_s = self._runs.transcription.terminal_time(trace.final_reference, trace.parameters)
        radius, speed = self._index["radius"], self._index["speed"]
        return {
            **row,
            "costs": [iteration.cost for iteration in trace.iterations],
            "defects": [self._runs.largest_defect(i) for i in trace.iterations],
            "times_s": np.linspace(0.0, time_s, len(final)).tolist(),
            "states": {name: final[:, n].tolist() for name, n in self._index.items()},
            "limited": {
                name: [float(function(state, values)) for state in final]
                for name, function in limited.items()
            },
            "limits": {name: float(values[f"{name}_max"]) for name in limited},
            "altitudes_m": [
                (states[:, radius] - values["planet_radius"]).tolist() for states in trajectories
            ],
            "speeds_m_s": [states[:, speed].tolist() for states in trajectories],
        }

    def _descend(self) -> list[dict[str, Any]]:
        """Adam on the logarithm of the convergence metric, in log10 of the weights.

        The metric is that of a fixed number of iterations: it would be small where the iterations
        stop too early, and it would jump with their number.
        """
        scp = self._runs.scp(MOST_ITERATIONS)
        loss = LogConvergenceLoss(scale=1.0, floor=_LOSS_FLOOR)
        place = np.array(SLOW_START)
        mean, square = np.zeros(2), np.zeros(2)
        steps: list[dict[str, Any]] = []
        for number in range(1, DESCENT_STEPS + 1):
            log_weights = (float(place[0]), float(place[1]))
            trace = scp.run(self._runs.parameters(log_weights))
            try:
                gradient = unrolled(scp, trace, loss)
            except DifferentiationError:
                break  # the steps so far are the result
            slope = self._runs.weight_gradient(gradient.parameters, log_weights)
            steps.append(self._step(log_weights, trace, gradient, slope))
            mean = _DECAY[0] * mean + (1.0 - _DECAY[0]) * slope
            square = _DECAY[1] * square + (1.0 - _DECAY[1]) * slope**2
            unbiased = mean / (1.0 - _DECAY[0] ** number)
            size = np.sqrt(square / (1.0 - _DECAY[1] ** number))
            place = place - _LEARNING_RATE * unbiased / (size + 1e-12)
        return steps

    def _step(
        self,
        log_weights: tuple[float, float],
        trace: ScpResult,
        gradient: Gradient,
        slope: Array,
    ) -> dict[str, Any]:
        flyable = self._runs.iterations_needed(trace, flyable=True)
        plain = self._runs.iterations_needed(trace, flyable=False)
        return {
            "log_weights": list(log_weights),
            "loss": math.exp(gradient.value) - _LOSS_FLOOR,
            "gradient": slope.tolist(),
            "iterations": flyable,
            "false_stop": plain != flyable,
            "cost": trace.iterations[(flyable or MOST_ITERATIONS) - 1].cost,
            "trusted": gradient.trusted,
        }


@dataclass(frozen=True)
class CaseSummary:
    """One of the paper's cases.

    Attributes:
        case: Its name.
        log_gamma, log_control: log10 of the weights.
        paper_iterations, iterations: Until the cost has settled; None for not within 20.
        cost: Nonlinear J1.
        max_defect: Largest scaled defect at the stop.
    """

    case: str
    log_gamma: float
    log_control: float
    paper_iterations: int | None
    iterations: int | None
    cost: float | None
    max_defect: float | None


@dataclass(frozen=True)
class TrustRegionSummary:
    """The numbers of the study.

    Attributes:
        points: Size of the grid.
        converged: How many converge to a flyable trajectory.
        false_stops: How many stop with a large defect.
        basin_iterations: Fewest and most in the paper's basin, false stops left out; None where
            the grid has no such point.
        basin_converged: Share of the basin's points that converge.
        fewest_iterations: In the whole grid, false stops left out.
        cases: The four.
        descent_iterations: At each step; None for not within 20.
        descent_log_weights: Where the descent is fastest; None where it has not begun.
        descent_final_iterations: There.
        descent_final_cost: There.
    """

    points: int
    converged: int
    false_stops: int
    basin_iterations: tuple[int, int] | None
    basin_converged: float | None
    fewest_iterations: int | None
    cases: tuple[CaseSummary, ...]
    descent_iterations: tuple[int | None, ...]
    descent_log_weights: tuple[float, float] | None
    descent_final_iterations: int | None
    descent_final_cost: float | None

    def document(self) -> dict[str, Any]:
        """As JSON holds it."""
        return asdict(self)


def converged(row: Row) -> bool:
    """Whether a point stopped by the rule, at a flyable trajectory."""
    return row["status"] == ScpStatus.CONVERGED.name.lower() and not false_stop(row)


def false_stop(row: Row) -> bool:
    """Whether a point stopped by the rule, far from the dynamics."""
    stopped = row["status"] == ScpStatus.CONVERGED.name.lower()
    return stopped and row["max_defect"] is not None and row["max_defect"] > FALSE_STOP_DEFECT


def fastest_step(steps: Sequence[Row]) -> Row | None:
    """The step of the descent with fewest iterations, then least loss; None without steps."""
    return min(
        steps,
        key=lambda step: (step["iterations"] or MOST_ITERATIONS + 1, step["loss"]),
        default=None,
    )


def summarise(items: Sequence[Item], rows: Sequence[Row]) -> TrustRegionSummary:
    """The numbers of a complete grid."""
    points = [row for item, row in zip(items, rows, strict=True) if item[0] == "point"]
    named = {item[1]: row for item, row in zip(items, rows, strict=True) if item[0] == "case"}
    steps = next(r["steps"] for i, r in zip(items, rows, strict=True) if i[0] == "descent")
    good = [row for row in points if converged(row)]
    inside = [row for row in points if _in_basin(row["log_weights"])]
    fast = [row["iterations"] for row in inside if converged(row)]
    best = fastest_step(steps)
    return TrustRegionSummary(
        points=len(points),
        converged=len(good),
        false_stops=sum(map(false_stop, points)),
        basin_iterations=(min(fast), max(fast)) if fast else None,
        basin_converged=len(fast) / len(inside) if inside else None,
        fewest_iterations=min((row["iterations"] for row in good), default=None),
        cases=tuple(
            CaseSummary(
                case=case.name,
                log_gamma=case.log_weights[0],
                log_control=case.log_weights[1],
                paper_iterations=case.paper_iterations,
                iterations=row["iterations"] if row["status"] == "converged" else None,
                cost=row["cost"],
                max_defect=row["max_defect"],
            )
            for case, row in ((case, named[case.name]) for case in CASES)
        ),
        descent_iterations=tuple(step["iterations"] for step in steps),
        descent_log_weights=None if best is None else tuple(best["log_weights"]),
        descent_final_iterations=None if best is None else best["iterations"],
        descent_final_cost=None if best is None else best["cost"],
    )


def _in_basin(log_weights: Sequence[float]) -> bool:
    return all(
        low - 1e-9 <= value <= high + 1e-9
        for value, (low, high) in zip(log_weights, BASIN, strict=True)
    )

"""Final mass and its gradient over the terminal time (Fig. 1-1 of the paper)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from statistics import fmean, median

import numpy as np

from dscp_core.errors import InvalidInputError
from dscp_core.gradients.differences import RunDifferences, relative_error
from dscp_core.gradients.losses import FinalStateLoss
from dscp_core.gradients.run import DifferentiationError, unrolled
from dscp_core.planning.planner import Planner, PlannerSettings, TerminalTime
from dscp_core.problem.declaration import TERMINAL_TIME, OptimalControlProblem
from dscp_core.problem.flight import Discretisation
from dscp_core.problems.powered_descent import powered_descent
from dscp_core.scp.scp import ScpOptions, ScpStatus
from dscp_core.workers.choice import make_engine

PAPER_OPTIMUM_S = 32.81
"""Optimal terminal time that section 4.1.2 of the paper reports."""
RELIABLE_FROM_S = 32.1
"""Terminal time above which the paper's iterations converge reliably."""
GROSS_ERROR = 1e-3
"""A gradient with a relative error beyond this is of no use."""

_MOST_POINTS = 10_000
_LOSS = FinalStateLoss("mass")


@dataclass(frozen=True)
class Sweep:
    """Which terminal times to run.

    Attributes:
        start_s: First terminal time.
        stop_s: Last terminal time.
        step_s: Distance of neighbours.
        settings: The case; its options are replaced by those for gradients.
        problem: What is swept.

    Raises:
        InvalidInputError: On construction, for a value out of range.
    """

    start_s: float = 32.0
    stop_s: float = 34.0
    step_s: float = 0.01
    settings: PlannerSettings = field(
        default_factory=lambda: PlannerSettings(discretisation=Discretisation.MIDPOINT)
    )
    problem: OptimalControlProblem = field(default_factory=powered_descent)

    def __post_init__(self) -> None:
        for name in ("start_s", "stop_s", "step_s"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise InvalidInputError(name, value, "finite and > 0 s")
        declared = self.problem.table
        for value in (self.start_s, self.stop_s):
            declared[TERMINAL_TIME].validate(value)
        if self.stop_s < self.start_s:
            raise InvalidInputError("stop_s", self.stop_s, f">= start_s, {self.start_s:g} s")
        if (self.stop_s - self.start_s) / self.step_s >= _MOST_POINTS:
            raise InvalidInputError(
                "step_s", self.step_s, f"a step with at most {_MOST_POINTS} points"
            )

    @property
    def times_s(self) -> tuple[float, ...]:
        """Terminal times, rounded to 1e-9 s."""
        count = int(np.floor((self.stop_s - self.start_s) / self.step_s + 1e-9)) + 1
        return tuple(round(self.start_s + i * self.step_s, 9) for i in range(count))


@dataclass(frozen=True)
class SweepPoint:
    """One terminal time; NaN stands for a number that does not exist.

    Attributes:
        terminal_time_s: The terminal time.
        status: How the iterations ended.
        iterations: Their number K.
        final_mass_kg: Mass at the end, m_N.
        virtual_control: Largest virtual control, relative to the states' scales.
        gradient_kg_s: d m_N / d t_f, unrolled.
        trusted: Whether the gradient's verdict trusts it.
        central_difference_kg_s: The same by differences of the whole SCP at the same K.
        uncertainty_kg_s: Of the difference.
        across_kink: Whether an active set changes within its step: it is no reference then.
        relative_error: Of the gradient against the difference; NaN where the difference does not
            tell the gradient from zero.
        reasons: Why the gradient is not trusted, or why there is none.
    """

    terminal_time_s: float
    status: ScpStatus
    iterations: int
    final_mass_kg: float
    virtual_control: float
    gradient_kg_s: float
    trusted: bool
    central_difference_kg_s: float
    uncertainty_kg_s: float
    across_kink: bool
    relative_error: float
    reasons: tuple[str, ...]

    @property
    def feasible(self) -> bool:
        """Whether the iterations found a trajectory."""
        return self.status is ScpStatus.CONVERGED

    @property
    def compared(self) -> bool:
        """Whether the difference says something about the gradient."""
        return math.isfinite(self.relative_error) and not self.across_kink


@dataclass(frozen=True)
class SweepSummary:
    """The numbers that the sweep is about; None where the sweep does not hold them.

    Attributes:
        points: Number of terminal times.
        infeasible_s: Least and greatest terminal time without a trajectory.
        least_feasible_s: Least feasible terminal time, by minimising it.
        best_swept_s: Terminal time of the greatest final mass among the points.
        gradient_zero_s: Where the gradient changes sign, interpolated.
        free_optimum_s: Optimum with the terminal time as a decision.
        free_final_mass_kg: Its final mass.
        paper_optimum_s: The paper's optimum.
        mean_iterations: Over the feasible points from `RELIABLE_FROM_S` on.
        regular_share: Share of them whose gradient is trusted.
        compared: Number of trusted points with a usable difference, of the same.
        across_kink: Number of trusted points whose difference is not, as it crosses a kink.
        median_relative_error: Over the compared points.
        max_relative_error: Over the compared points.
        max_relative_error_at_s: Where that is.
        unflagged_gross_errors: Trusted points of the sweep with an error above `GROSS_ERROR`.
    """

    points: int
    infeasible_s: tuple[float, float] | None
    least_feasible_s: float | None
    best_swept_s: float | None
    gradient_zero_s: float | None
    free_optimum_s: float | None
    free_final_mass_kg: float | None
    paper_optimum_s: float
    mean_iterations: float | None
    regular_share: float | None
    compared: int
    across_kink: int
    median_relative_error: float | None
    max_relative_error: float | None
    max_relative_error_at_s: float | None
    unflagged_gross_errors: int


def run_sweep(
    sweep: Sweep,
    *,
    jobs: int | None = 1,
    ray_address: str | None = None,
    report: Callable[[int], object] = lambda _: None,
) -> list[SweepPoint]:
    """All points, in order.

    Args:
        sweep: Which terminal times.
        jobs: How many points at once; None for one per processor.
        ray_address: Of the Ray cluster that computes; None for this machine.
        report: Called with the number of points done since the last call.

    Raises:
        InvalidInputError: ``jobs`` below 1, or settings that cannot be used.
        RayMissingError, RayClusterError: No usable cluster at the address.
    """
    if jobs is not None and jobs < 1:
        raise InvalidInputError("jobs", jobs, ">= 1")
    points: list[SweepPoint] = []
    engine = make_engine(SweepModel(sweep.problem, sweep.settings), jobs, ray_address)
    try:
        for point in engine.map(sweep.times_s):
            points.append(point)
            report(1)
    finally:
        engine.close()
    return points


def summarise(sweep: Sweep, points: Sequence[SweepPoint]) -> SweepSummary:
    """The numbers of a sweep, with the optimum and the least time found independently of it."""
    feasible = [p for p in points if p.feasible]
    infeasible = [p.terminal_time_s for p in points if p.status is ScpStatus.INFEASIBLE]
    reliable = [p for p in feasible if p.terminal_time_s >= RELIABLE_FROM_S - 1e-9]
    compared = [p for p in reliable if p.trusted and p.compared]
    worst = max(compared, key=lambda p: p.relative_error, default=None)
    best = max(feasible, key=lambda p: p.final_mass_kg, default=None)
    planner = Planner(sweep.problem, replace(sweep.settings, terminal_time=TerminalTime.FREE))
    free = planner.plan(planner.initial_state)
    optimum = free.plan if free.converged else None
    return SweepSummary(
        points=len(points),
        infeasible_s=(min(infeasible), max(infeasible)) if infeasible else None,
        least_feasible_s=planner.least_terminal_time(planner.initial_state),
        best_swept_s=None if best is None else best.terminal_time_s,
        gradient_zero_s=_zero(feasible),
        free_optimum_s=None if optimum is None else optimum.terminal_time_s,
        free_final_mass_kg=None
        if optimum is None
        else float(optimum.states[-1, optimum.state_names.index("mass")]),
        paper_optimum_s=PAPER_OPTIMUM_S,
        mean_iterations=fmean(p.iterations for p in reliable) if reliable else None,
        regular_share=fmean(p.trusted for p in reliable) if reliable else None,
        compared=len(compared),
        across_kink=sum(p.trusted and p.across_kink for p in reliable),
        median_relative_error=median(p.relative_error for p in compared) if compared else None,
        max_relative_error=None if worst is None else worst.relative_error,
        max_relative_error_at_s=None if worst is None else worst.terminal_time_s,
        unflagged_gross_errors=sum(p.trusted and p.relative_error > GROSS_ERROR for p in points),
    )


@dataclass(frozen=True)
class SweepModel:
    """What a worker of the sweep needs. Calling it makes its function.

    Attributes:
        problem: Of the sweep.
        settings: Of the sweep.
    """

    problem: OptimalControlProblem
    settings: PlannerSettings

    def __call__(self) -> Callable[[float], SweepPoint]:
        """Compile the problem."""
        options = ScpOptions.for_gradients(solver=self.settings.options.solver)
        fixed = replace(self.settings, terminal_time=TerminalTime.FIXED, options=options)
        planner = Planner(self.problem, fixed)
        return lambda time_s: _point(planner, time_s)


def _point(planner: Planner, time_s: float) -> SweepPoint:
    scp, table = planner.scp, planner.problem.table
    trace = scp.run(table.pack({TERMINAL_TIME: time_s}, base=planner.parameters))
    point = SweepPoint(
        terminal_time_s=time_s,
        status=trace.status,
        iterations=len(trace.iterations),
        final_mass_kg=math.nan,
        virtual_control=math.nan,
        gradient_kg_s=math.nan,
        trusted=False,
        central_difference_kg_s=math.nan,
        uncertainty_kg_s=math.nan,
        across_kink=False,
        relative_error=math.nan,
        reasons=(trace.message,),
    )
    try:
        gradient = unrolled(scp, trace, _LOSS)
    except DifferentiationError:
        return point
    slope = float(gradient.parameters[table.slice(TERMINAL_TIME)][0])
    difference = RunDifferences(scp, trace, _LOSS).derivative(TERMINAL_TIME)
    value = math.nan if difference.value is None else difference.value
    error = relative_error(slope, difference, max(abs(slope), abs(value)))
    converged = trace.status is ScpStatus.CONVERGED
    return replace(
        point,
        final_mass_kg=gradient.value,
        virtual_control=planner.transcription.layout.relative(trace.iterations[-1].virtual_control),
        gradient_kg_s=slope,
        trusted=gradient.trusted and converged,
        central_difference_kg_s=value,
        uncertainty_kg_s=difference.uncertainty,
        across_kink=difference.crosses_active_set_change,
        relative_error=math.nan if error is None else error,
        reasons=gradient.reasons if converged else (*gradient.reasons, trace.message),
    )


def _zero(points: Sequence[SweepPoint]) -> float | None:
    """Last sign change of the gradient from plus to minus, linearly interpolated."""
    for left, right in reversed(list(pairwise(points))):
        before, after = left.gradient_kg_s, right.gradient_kg_s
        if before > 0.0 >= after:
            step = right.terminal_time_s - left.terminal_time_s
            return left.terminal_time_s + step * before / (before - after)
    return None

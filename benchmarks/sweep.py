"""The paper's case over the terminal time: gradients, iterations, optimum.

The dynamics are the paper's midpoint rule; the optimum is compared for propagated intervals too.

Every gradient is compared with a central difference of the whole SCP at the same number of
iterations. A point is *regular* if the gradient's verdict trusts it and the step of the difference
stays within the active sets of all iterations, to first order; at other points the difference is
no reference.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.report import Cell, Report, Table
from dscp_core import problems
from dscp_core.gradients.losses import FinalStateLoss
from dscp_core.gradients.run import implicit, tangent, unrolled
from dscp_core.planning.planner import Planner, PlannerSettings, TerminalTime
from dscp_core.problem.declaration import TERMINAL_TIME
from dscp_core.problem.flight import Discretisation
from dscp_core.problem.parameters import Value
from dscp_core.scp.scp import Scp, ScpOptions
from tests.oracles.powered_descent_nlp import NlpOptions, solve_free_time

PAPER_OPTIMUM_S = 32.81
FIRST_S, LAST_S = 32.1, 34.0
LOSS = FinalStateLoss("mass", -1.0)
RELATIVE_STEP = 1e-6
"""Of a difference, of the parameter's size: truncation and rounding then are near 1e-8."""

WEIGHT_STEP = 3e-4
"""The same for weights, on which the mass depends by grams."""

FLOOR_KG = 3e-5
"""Gradients that change the mass by less than this over one step are measured against this: near
an optimum the gradient is zero and a relative error means nothing.  The masses of neighbouring runs
scatter by 2e-11 kg (one standard deviation), so the worst of some hundred differences by 5e-11."""

CONVERGED_ITERATIONS = 30
"""After these, what is left of the fixed-point iteration is rounding."""

ERROR_BOUND = 1e-6
FLAGGED_ABOVE = 1e-3


@dataclass(frozen=True)
class Probe:
    """One component of one parameter, with the size that its step is relative to."""

    name: str
    component: int
    size: float
    relative_step: float = RELATIVE_STEP

    @property
    def step(self) -> float:
        """Step of the difference, SI."""
        return self.relative_step * self.size


@dataclass(frozen=True)
class Comparison:
    """A gradient beside its difference."""

    time_s: float
    probe: Probe
    gradient: float
    difference: float
    reasons: tuple[str, ...]
    radius_over_step: float
    forward_reverse: float

    @property
    def error(self) -> float:
        """Relative error of the gradient."""
        scale = max(abs(self.difference), FLOOR_KG / self.probe.step)
        return abs(self.gradient - self.difference) / scale

    @property
    def trusted(self) -> bool:
        """Whether the verdict trusts the gradient."""
        return not self.reasons

    @property
    def regular(self) -> bool:
        """Whether trusted, and the difference within the active sets."""
        return self.trusted and self.radius_over_step > 1.0


VEHICLE = (
    *(Probe("initial_position", i, 5000.0) for i in range(3)),
    *(Probe("initial_velocity", i, 150.0) for i in range(3)),
    Probe("initial_mass", 0, 38000.0),
    Probe("specific_impulse", 0, 282.0),
    Probe("thrust_min", 0, 169.0e3),
    Probe("thrust_max", 0, 845.2e3),
)
TRUST_REGION = {"trust_region_state": (1e-2,) * 7, "trust_region_control": (1e-2,) * 3}
WEIGHTS = tuple(
    Probe(name, i, weights[i], WEIGHT_STEP)
    for name, weights in TRUST_REGION.items()
    for i in range(len(weights))
)
SOFT = {"virtual_control_weight": 100.0}
VIRTUAL_CONTROL = (Probe("virtual_control_weight", 0, 100.0, WEIGHT_STEP),)


def measure(*, quick: bool) -> Report:
    """Sweep the terminal time, then the other parameters at fewer times."""
    report = Report("sweep")
    planner = Planner(
        problems.get("powered_descent"), PlannerSettings(discretisation=Discretisation.MIDPOINT)
    )
    scp = Scp(planner.transcription, ScpOptions.for_gradients())
    times = np.linspace(FIRST_S, LAST_S, 20 if quick else 96)
    few = np.linspace(32.2, 33.9, 2 if quick else 12)
    time = (Probe(TERMINAL_TIME, 0, PAPER_OPTIMUM_S),)
    groups = {
        "terminal time": _compare(planner, scp, times, time),
        "state, Isp, thrust bounds": _compare(planner, scp, few, VEHICLE),
        # At convergence weights have no influence: three iterations are differentiated.
        "trust-region weights (K = 3)": _compare(
            planner, scp.with_options(fixed_iterations=3), few, WEIGHTS, TRUST_REGION
        ),
        # At its default the weight rules virtual control out, and has no influence either.
        "virtual-control weight (100, K = 3)": _compare(
            planner, scp.with_options(fixed_iterations=3), few, VIRTUAL_CONTROL, SOFT
        ),
    }
    sweep = groups["terminal time"]
    regular = [c.error for c in sweep if c.regular]
    share = 100.0 * len(regular) / len(sweep)
    report.add(f"regular among {len(sweep)} terminal times", share, "%", (">=", 95.0))
    for label, compared in groups.items():
        worst = max((c.error for c in compared if c.regular), default=float("nan"))
        report.add(f"largest error at regular points, {label}", worst, "1", ("<=", ERROR_BOUND))
    everything = [c for compared in groups.values() for c in compared]
    off = [c for c in everything if c.trusted and c.error > FLAGGED_ABOVE]
    silent = sum(c.regular for c in off)
    report.add(f"error > {FLAGGED_ABOVE:g}, not flagged", silent, "1", ("<=", 0))
    report.add(f"error > {FLAGGED_ABOVE:g}, difference across a kink", len(off) - silent)
    modes = max(c.forward_reverse for c in everything if c.trusted)
    report.add("forward against reverse mode (dot product)", modes, "1", ("<=", 1e-10))
    _implicit(report, planner, scp, few)
    _iterations(report, planner, times)
    _optimum(report)
    report.tables += [_table(groups), _irregular(everything)]
    report.notes += [
        f"steps: {RELATIVE_STEP:g} of the parameter's size ({WEIGHT_STEP:g} for weights); errors "
        f"relative to the difference, or to one of {FLOOR_KG:g} kg per step where that is larger",
        "not trusted: flagged by the verdict; kink: the step crosses a change of an active set",
    ]
    return report


def _compare(
    planner: Planner,
    scp: Scp,
    times_s: Sequence[float] | np.ndarray,
    probes: Sequence[Probe],
    changed: Mapping[str, Value] | None = None,
) -> list[Comparison]:
    table, compared = planner.problem.table, []
    for time_s in times_s:
        parameters = table.pack({**(changed or {}), TERMINAL_TIME: time_s}, planner.parameters)
        trace = scp.run(parameters)
        gradient = unrolled(scp, trace, LOSS)
        explicit = LOSS.gradient(planner.transcription, trace).decisions[-1]
        repeat = scp.with_options(fixed_iterations=len(trace.iterations))
        for probe in probes:
            place = table.slice(probe.name).start + probe.component
            step = probe.step
            moved = np.zeros((2, parameters.size))
            moved[:, place] = step, -step
            ahead, behind = (
                LOSS.value(planner.transcription, repeat.run(parameters + m)) for m in moved
            )
            moving = tangent(scp, trace, moved[0] / step)
            change = moving.decisions[-1]
            found = float(gradient.parameters[place])
            size = float(np.linalg.norm(explicit) * np.linalg.norm(change))
            compared.append(
                Comparison(
                    time_s=float(time_s),
                    probe=probe,
                    gradient=found,
                    difference=(ahead - behind) / (2.0 * step),
                    reasons=gradient.reasons,
                    radius_over_step=moving.active_set_radius / step,
                    forward_reverse=abs(float(explicit @ change) - found) / size,
                )
            )
    return compared


def _implicit(report: Report, planner: Planner, scp: Scp, times_s: np.ndarray) -> None:
    """Implicit against unrolled gradient after many iterations."""
    table, errors = planner.problem.table, []
    converged = scp.with_options(fixed_iterations=CONVERGED_ITERATIONS)
    place = table.slice(TERMINAL_TIME)
    for time_s in times_s:
        trace = converged.run(table.pack({TERMINAL_TIME: time_s}, planner.parameters))
        pair = [method(converged, trace, LOSS) for method in (unrolled, implicit)]
        if all(gradient.trusted for gradient in pair):
            through, at_point = (float(gradient.parameters[place][0]) for gradient in pair)
            errors.append(abs(at_point - through) / abs(through))
    worst = max(errors, default=float("nan"))
    label = f"implicit against unrolled, K = {CONVERGED_ITERATIONS}, {len(errors)} trusted points"
    report.add(label, worst, "1", ("<=", ERROR_BOUND))


def _iterations(report: Report, planner: Planner, times_s: np.ndarray) -> None:
    table = planner.problem.table
    runs = [
        planner.scp.run(table.pack({TERMINAL_TIME: time_s}, planner.parameters))
        for time_s in times_s
    ]
    counts = [len(run.iterations) for run in runs]
    report.add("mean iterations, 32.1 .. 34 s", float(np.mean(counts)), "1", ("<=", 10.0))
    report.add("most iterations", max(counts))
    stopped = sum(not run.succeeded for run in runs)
    report.add("runs that did not converge", stopped, "", ("<=", 0))


def _optimum(report: Report) -> None:
    for discretisation in Discretisation:
        of, paper = f", {discretisation.value}", discretisation is Discretisation.MIDPOINT
        settings = PlannerSettings(terminal_time=TerminalTime.FREE, discretisation=discretisation)
        planner = Planner(problems.get("powered_descent"), settings)
        result = planner.scp.run(planner.parameters)
        found_s = planner.transcription.terminal_time(result.final_reference, result.parameters)
        mass = FinalStateLoss("mass").value(planner.transcription, result)
        oracle = solve_free_time(planner.initial_state, options=NlpOptions(propagated=not paper))
        report.add(f"optimal terminal time{of}", found_s, "s")
        if paper:
            label = f"its distance from the paper's {PAPER_OPTIMUM_S} s"
            report.add(label, abs(found_s - PAPER_OPTIMUM_S), "s", ("<=", 0.005))
        apart_s = abs(found_s - oracle.terminal_time_s)
        report.add(f"its distance from CasADi + IPOPT{of}", apart_s, "s", ("<=", 0.005))
        error = abs(mass - oracle.final_mass_kg) / oracle.final_mass_kg
        label = f"final mass against CasADi + IPOPT, relative{of}"
        report.add(label, error, "1", ("<=", 1e-6))
        least_s = planner.least_terminal_time(planner.initial_state)
        report.add(
            f"least feasible terminal time{of}", math.nan if least_s is None else least_s, "s"
        )


def _table(groups: dict[str, list[Comparison]]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for label, compared in groups.items():
        for name in dict.fromkeys(c.probe.name for c in compared):
            of_name = [c for c in compared if c.probe.name == name]
            regular = [c.error for c in of_name if c.regular]
            rows.append(
                (
                    name if len(groups) > 1 else label,
                    len(of_name),
                    len(regular),
                    sum(not c.trusted for c in of_name),
                    sum(c.trusted and not c.regular for c in of_name),
                    float(np.median(regular)) if regular else float("nan"),
                    max(regular, default=float("nan")),
                    max(c.error for c in of_name),
                )
            )
    header = (
        "parameter",
        "points",
        "regular",
        "not trusted",
        "kink",
        "median",
        "max",
        "max of all",
    )
    return Table("relative error of the gradient of -m(t_f), regular points", header, rows)


def _irregular(everything: Sequence[Comparison]) -> Table:
    rows: list[tuple[Cell, ...]] = [
        (
            f"{c.time_s:.3f} s",
            f"{c.probe.name}[{c.probe.component}]",
            c.error,
            c.radius_over_step,
            c.reasons[0] if c.reasons else "kink within the step",
        )
        for c in everything
        if not c.regular
    ]
    header = ("terminal time", "parameter", "error", "radius / step", "why")
    return Table("points that are not regular", header, rows)

"""Derivatives of one cone program of powered descent: time beside its solve, error, diffcp."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from benchmarks.diffcp_program import MODES, DiffcpProgram
from benchmarks.report import Cell, Report, Table
from benchmarks.timing import Array, alternated, clocked
from dscp_core import problems
from dscp_core.cone.derivative.sensitivity import KktSystem
from dscp_core.cone.program import ConeValues
from dscp_core.cone.solvers import SOLVER_NAMES, SolverSettings, make_solver
from dscp_core.planning.planner import Planner, PlannerSettings
from dscp_core.scp.scp import GRADIENT_TOLERANCE, Scp, ScpOptions

STEP = 1e-7
"""Of central differences, relative to every value of the program."""

DIRECTIONS = 5
REFERENCE = "clarabel"
TIGHT = SolverSettings(tolerance=GRADIENT_TOLERANCE)
DOT_PRODUCT_TARGET = 1e-10


def measure(*, quick: bool) -> Report:
    """Time solve, linearisation and derivatives of the paper's last subproblem."""
    report = Report("sensitivity")
    planner = Planner(problems.get("powered_descent"), PlannerSettings())
    pattern, layout = planner.transcription.pattern, planner.transcription.layout
    loop = Scp(planner.transcription, ScpOptions.for_gradients())
    last = loop.run(planner.parameters).iterations[-1]
    system, values, polished = loop.kkt, last.values, last.solution
    seed = np.zeros(pattern.n)
    seed[layout.state_index(layout.intervals, layout.nx - 1)] = 1.0  # the final mass
    theirs = {mode: DiffcpProgram(pattern, values, TIGHT.tolerance) for mode in MODES}

    solvers = {name: make_solver(name, pattern, SolverSettings()) for name in SOLVER_NAMES}
    rough = make_solver(REFERENCE, pattern, TIGHT).solve(values)
    change = _direction(values, np.random.default_rng(0))
    rounds = 20 if quick else 200
    times = _times(
        {
            **{f"solve, {name}": partial(s.solve, values) for name, s in solvers.items()},
            "linearise the solver's point, with polish": lambda: system.linearise(values, rough),
            "linearise a polished point": lambda: system.linearise(values, polished),
            "linearise without polish": lambda: system.linearise(values, rough, polish=False),
        },
        rounds,
    )
    kept = system.linearise(values, polished)
    times |= _times(
        {
            "adjoint (reverse mode)": lambda: kept.adjoint(seed),
            "tangent (forward mode)": lambda: kept.tangent(change),
        },
        rounds,
    )
    for mode, program in theirs.items():
        times[f"diffcp, {mode}: solve and set-up"] = clocked(partial(program.solve, mode))[1]
        times[f"diffcp, {mode}: adjoint"] = clocked(partial(program.adjoint, seed))[1]

    unit = times[f"solve, {REFERENCE}"]
    backward = times["linearise a polished point"] + times["adjoint (reverse mode)"]
    report.add(f"linearise a polished point and adjoint, over a {REFERENCE} solve", backward / unit)
    _errors(report, system, values, seed, theirs)
    rows: list[tuple[Cell, ...]] = [(what, 1e3 * s, s / unit) for what, s in times.items()]
    report.tables.append(
        Table(
            f"one subproblem: {pattern.n} variables, {pattern.n_equalities} equalities, "
            f"{pattern.n_cone_rows} cone rows",
            ("operation", "milliseconds", f"/ {REFERENCE}"),
            rows,
        )
    )
    report.notes += [
        f"solvers: default tolerance, data updates; medians of {rounds} rounds, in turns",
        "diffcp's dense and LSQR modes take no quadratic cost: it is one more cone there; solved "
        f"by Clarabel at {TIGHT.tolerance:g}; one run each",
        f"errors: derivative of the final mass along {DIRECTIONS} random relative changes of c, A, "
        f"b, G, h, over the largest one; differences: of polished solutions, step {STEP:g}",
    ]
    return report


def _times(calls: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Median seconds of each call."""
    medians = np.median(alternated(list(calls.values()), rounds), axis=0)
    return dict(zip(calls, medians.tolist(), strict=True))


def _direction(values: ConeValues, random: np.random.Generator) -> ConeValues:
    """Random change of every value, relative to its size; Q stays, for diffcp has none."""
    parts = {name: getattr(values, name) for name in ConeValues.FIELDS}
    changes = {name: part * random.uniform(-1.0, 1.0, part.size) for name, part in parts.items()}
    return replace(ConeValues(**changes), q=np.zeros_like(values.q))


def _moved(values: ConeValues, direction: ConeValues, step: float) -> ConeValues:
    names = ConeValues.FIELDS
    return ConeValues(*(getattr(values, n) + step * getattr(direction, n) for n in names))


def _errors(
    report: Report,
    system: KktSystem,
    values: ConeValues,
    seed: Array,
    theirs: dict[str, DiffcpProgram],
) -> None:
    """Errors of adjoint, tangent and diffcp against differences."""
    random = np.random.default_rng(1)
    solver = make_solver(REFERENCE, system.pattern, TIGHT)

    def mass(at: ConeValues) -> float:
        return float(seed @ system.linearise(at, solver.solve(at)).z)

    def slope(d: ConeValues) -> float:
        return (mass(_moved(values, d, STEP)) - mass(_moved(values, d, -STEP))) / (2.0 * STEP)

    directions = [_direction(values, random) for _ in range(DIRECTIONS)]
    differences = np.array([slope(d) for d in directions])
    base = system.linearise(values, solver.solve(values))
    gradient = base.adjoint(seed).to_flat()
    reverse = np.array([gradient @ d.to_flat() for d in directions])
    forward = np.array([seed @ base.tangent(d)[0] for d in directions])
    radius = min(base.active_set_radius(d) for d in directions)
    scale = float(np.abs(differences).max())

    def worst(one: Array, other: Array) -> float:
        return float(np.abs(one - other).max()) / scale

    report.add("adjoint against differences", worst(reverse, differences))
    report.add("tangent against differences", worst(forward, differences))
    for mode, program in theirs.items():
        products = np.array([program.derivative_along(d) for d in directions])
        report.add(f"diffcp, {mode}, against differences", worst(products, differences))
    dot_product = worst(reverse, forward)
    target = ("<=", DOT_PRODUCT_TARGET)
    report.add("adjoint against tangent (dot product)", dot_product, "1", target)
    report.add("active-set radius over the step of the differences", radius / STEP)

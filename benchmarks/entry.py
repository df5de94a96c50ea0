"""Entry: where the time of forward and backward runs goes, and how it grows with the intervals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from benchmarks.report import Cell, Report, Table
from benchmarks.timing import Array, alternated, clocked
from dscp_core import problems
from dscp_core.gradients.losses import CostLoss
from dscp_core.gradients.run import unrolled
from dscp_core.scp.scp import Scp, ScpOptions, ScpResult
from dscp_core.transcription.transcription import Transcription

INTERVALS = (50, 100, 200, 500, 1000)
ITERATIONS = 6
"""K of every run: what the default formulation takes at N = 100 with its own tolerances."""

OVERHEAD_TARGET = 15.0
BACKWARD_TARGET = 0.3
EXPONENT_TARGET = 1.15
_NOMINAL = 100
_RATIOS = ("backward / polished", "backward / planning", "(polish + backward) / gradients")
_PARTS = ("solver's own", "solver's wrapper", "assembly", "rest")


@dataclass(frozen=True)
class _Size:
    """Times of one mesh.

    Attributes:
        parts: (4,) seconds of a planning run by part, in the order of `_PARTS`.
        planning: CPU seconds of a planning run.
        gradients: CPU seconds of a run for gradients, its subproblems solved but not polished.
        polished: CPU seconds of the same with the polish.
        backward: CPU seconds of a backward run after it.
        ratio: Backward over polished, median of ratios within a round.
        solver_iterations: Interior-point iterations of the planning run.
    """

    parts: Array
    planning: float
    gradients: float
    polished: float
    backward: float
    ratio: float
    solver_iterations: int


def measure(*, quick: bool) -> Report:
    """Runs of the paper's vehicle on meshes of 50 to 1000 intervals."""
    report = Report("entry")
    sizes = {n: _measured(n, 3 if quick else 12) for n in INTERVALS}
    nominal = sizes[_NOMINAL]
    overhead = 100.0 * (1.0 - nominal.parts[0] / nominal.parts.sum())
    report.add(
        "forward overhead outside the solver, N = 100", overhead, "%", ("<=", OVERHEAD_TARGET)
    )
    report.add("backward / forward, N = 100", nominal.ratio, "1", ("<=", BACKWARD_TARGET))
    for label, times in (
        ("forward", [s.planning for s in sizes.values()]),
        ("forward, per interior-point iteration", _per_iteration(sizes)),
        ("backward", [s.backward for s in sizes.values()]),
    ):
        exponent = _exponent(np.array(times))
        target = ("<=", EXPONENT_TARGET) if "per" not in label else None
        report.add(f"{label}: exponent of N, 50 .. 1000", exponent, "1", target)
    report.add("derivative of the rollout / backward, N = 100", _rollout_share(_NOMINAL))
    report.tables += [
        Table(
            f"forward run of {ITERATIONS} iterations (milliseconds) and where its time goes",
            ("N", "run", *_PARTS, "interior-point iterations"),
            [_forward_row(n, s) for n, s in sizes.items()],
        ),
        Table(
            "CPU milliseconds (least of all rounds), and ratios of them",
            ("N", "planning", "gradients", "polished", "backward", *_RATIOS),
            [_cpu_row(n, s) for n, s in sizes.items()],
        ),
    ]
    report.notes += [
        "quadratic formulation, Clarabel; planning: tolerance 1e-8; gradients: 1e-12; polished: "
        "the same with the polish that a backward run starts from",
        "wrapper: checks of data and answer around the backend; rest: guess, tests, trace",
        "exponents are slopes of CPU time over N on logarithmic axes; interior-point methods take "
        "more iterations on finer meshes, which the second leaves out",
    ]
    return report


def _measured(intervals: int, rounds: int) -> _Size:
    transcription = Transcription(problems.get("entry"), intervals)
    parameters = transcription.problem.pack()
    plain = Scp(transcription, ScpOptions(fixed_iterations=ITERATIONS))
    polished = Scp(transcription, ScpOptions.for_gradients(fixed_iterations=ITERATIONS))
    bare = polished.with_options(polish=False)
    backward = partial(unrolled, polished, polished.run(parameters), CostLoss())
    backward()
    parts, rounds_s = [], []
    for _ in range(rounds):
        planned, _, planning_s = clocked(partial(plain.run, parameters))
        others: list[Callable[[], object]] = [
            partial(bare.run, parameters),
            partial(polished.run, parameters),
            backward,
        ]
        parts.append(_parts(planned))
        rounds_s.append([planning_s, *(clocked(call)[2] for call in others)])
    times = np.array(rounds_s)
    # The least: what others on the machine do to the caches only adds.
    planning, gradients, polished_s, backward_s = (float(t) for t in times.min(axis=0))
    return _Size(
        parts=np.median(parts, axis=0),
        planning=planning,
        gradients=gradients,
        polished=polished_s,
        backward=backward_s,
        ratio=float(np.median(times[:, 3] / times[:, 2])),
        solver_iterations=sum(i.solution.iterations for i in planned.iterations),
    )


def _parts(result: ScpResult) -> Array:
    """Seconds of a run by part, in the order of `_PARTS`."""
    own = sum(i.solution.seconds + i.solution.setup_seconds for i in result.iterations)
    solve = sum(i.solve_seconds for i in result.iterations)
    assembly = sum(i.assembly_seconds for i in result.iterations)
    return np.array([own, solve - own, assembly, result.seconds - solve - assembly])


def _forward_row(intervals: int, size: _Size) -> tuple[Cell, ...]:
    total = float(size.parts.sum())
    shares = (f"{100.0 * part / total:.1f} %" for part in size.parts)
    return (intervals, 1e3 * total, *shares, size.solver_iterations)


def _cpu_row(intervals: int, size: _Size) -> tuple[Cell, ...]:
    times = (size.planning, size.gradients, size.polished, size.backward)
    ratios = (
        size.backward / size.polished,
        size.backward / size.planning,
        (size.polished - size.gradients + size.backward) / size.gradients,
    )
    return (intervals, *(1e3 * t for t in times), *ratios)


def _per_iteration(sizes: dict[int, _Size]) -> list[float]:
    return [s.planning / s.solver_iterations for s in sizes.values()]


def _exponent(times: Array) -> float:
    """Slope of log(time) over log(N), least squares."""
    return float(np.polyfit(np.log(INTERVALS), np.log(times), 1)[0])


def _rollout_share(intervals: int) -> float:
    """Time of the rollout's derivative as a part of a backward run."""
    transcription = Transcription(problems.get("entry"), intervals)
    parameters = transcription.problem.pack()
    scp = Scp(transcription, ScpOptions.for_gradients(fixed_iterations=ITERATIONS))
    trace = scp.run(parameters)
    seed = np.ones(trace.initial_reference.size)
    times = alternated(
        [
            partial(transcription.initial_guess_pullback, parameters, seed),
            partial(unrolled, scp, trace, CostLoss()),
        ],
        10,
    )
    return float(np.median(times[:, 0] / times[:, 1]))

"""Small tunings of powered descent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from learning_support import network
from numpy.typing import NDArray

from dscp_core import problems
from dscp_core.planning.planner import PlannerSettings, TerminalTime
from dscp_core.planning.terminal_time_network import TerminalTimeNetwork
from dscp_core.problem.declaration import OptimalControlProblem
from dscp_core.tuning.choice import LossChoice
from dscp_core.tuning.evaluator import TuningModel
from dscp_core.tuning.network import trainable
from dscp_core.tuning.objective import Objective
from dscp_core.tuning.quantities import parse_tuned
from dscp_core.tuning.samples import StateSet
from dscp_core.tuning.settings import Sample, TuningSettings
from dscp_core.tuning.space import SearchSpace
from dscp_core.tuning.tuner import TuningResult, tune
from dscp_core.workers.processes import SerialEngine

Array = NDArray[np.float64]

INTERVALS = 24
TIME_S = 36.0
"""Long enough for every state of the paper's box that is used here."""

STATES = np.array(
    [
        [5100.0, 400.0, -300.0, -140.0, -10.0, 12.0, 38000.0],
        [5300.0, -200.0, 250.0, -130.0, 8.0, -15.0, 38000.0],
        [5200.0, 100.0, 500.0, -145.0, 20.0, 5.0, 38000.0],
    ]
)
# The raw guess of the printed formulation is of use for few states.
PRINTED_STATES = np.array(
    [
        [5000.0, 500.0, 500.0, -150.0, 30.0, -30.0, 38000.0],
        [5050.0, 480.0, 520.0, -148.0, 28.0, -33.0, 38000.0],
    ]
)
# Below all of them, some 32 s: no thrust is great enough.
SHORT_TIME_S = 29.0


def samples(count: int, log: str = "one", seed: int = 1) -> list[Sample]:
    rng = np.random.default_rng(seed)
    spread = np.array([100.0, 300.0, 300.0, 8.0, 15.0, 15.0, 0.0])
    centre = np.array([5200.0, 0.0, 0.0, -135.0, 0.0, 0.0, 38000.0])
    return [Sample(centre + spread * rng.uniform(-1.0, 1.0, 7), log) for _ in range(count)]


def planner(mode: TerminalTime = TerminalTime.FIXED, **changes: Any) -> PlannerSettings:
    values = {"terminal_time": TIME_S, **changes.pop("parameters", {})}
    given = {"intervals": INTERVALS, "parameters": values, "terminal_time": mode, **changes}
    return PlannerSettings(**given)


def settings(
    output: Path,
    tuned: str,
    planned: PlannerSettings,
    problem: OptimalControlProblem | None = None,
    **changes: Any,
) -> TuningSettings:
    problem = problem or problems.get("powered_descent")
    given = {"epochs": 3, "batch": 4, "workers": 1, **changes}
    return TuningSettings(problem, planned, parse_tuned(problem, tuned), output, **given)


def untrained() -> TerminalTimeNetwork:
    """A network for the default vehicle with random weights, all of whose times are near 36 s."""
    data = network().data
    problem = problems.get("powered_descent")
    table = problem.table
    return TerminalTimeNetwork(
        replace(
            data,
            weights=(*data.weights[:-1], 0.1 * data.weights[-1]),
            biases=(*data.biases[:-1], np.zeros(1)),
            vehicle=problem.vehicle_of(table.unpack(table.pack())),
        )
    )


def objective(
    tuned: str,
    loss: str,
    planned: PlannerSettings,
    *,
    fixed_iterations: int | None = None,
    envelope: bool = False,
    predictor: TerminalTimeNetwork | None = None,
    problem: OptimalControlProblem | None = None,
) -> Objective:
    problem = problem or problems.get("powered_descent")
    quantities = parse_tuned(problem, tuned)
    model = TuningModel(problem, planned, LossChoice.parse(loss), fixed_iterations, envelope)
    return Objective(
        problem,
        SerialEngine(model),
        SearchSpace(problem, quantities, problem.pack(planned.parameters)),
        None if predictor is None else trainable(predictor.data),
        tunes_network=any(quantity.is_network for quantity in quantities),
    )


def state_set(states: Array = STATES, times_s: Sequence[float] | None = None) -> StateSet:
    times = np.full(len(states), np.nan) if times_s is None else np.array(times_s)
    return StateSet(states, times, ("one",) * len(states), np.arange(len(states)))


def tiny(output: Path, **changes: Any) -> TuningSettings:
    """Settings of a tuning that takes seconds, of a parameter and the network's weights."""
    planned = PlannerSettings(intervals=INTERVALS, terminal_time=TerminalTime.PREDICTED)
    return settings(output, "thrust_max=8e5:9e5,network", planned, **changes)


def tune_tiny(output: Path, **changes: Any) -> TuningResult:
    """A tiny tuning."""
    return tune(tiny(output, **changes), samples(10), samples(4, "two", 2), network=untrained())

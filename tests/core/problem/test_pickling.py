"""Problems, transcriptions and loops cross process boundaries, lambdas and expressions included."""

from __future__ import annotations

import copy
import importlib.util
import pickle
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import casadi as ca
import cloudpickle
import numpy as np
import pytest
from core.toy_problems import Costs, cart

from dscp_core import problems
from dscp_core.planning.planner import Planner
from dscp_core.problem.declaration import OptimalControlProblem, PathConstraint
from dscp_core.scp.scp import Scp, ScpOptions
from dscp_core.transcription.transcription import Transcription
from dscp_core.workers.processes import ProcessEngine

DRAGS = [0.0, 0.2, 1.0]

OWN_PROBLEM = '''
"""A problem in a file that no worker can import."""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca
from core.toy_problems import cart

_SYMBOL = ca.SX.sym("symbol")
_SQUARE = _SYMBOL**2


@dataclass(frozen=True)
class Weights:
    effort: float = 0.5


def effort(x, u, p):
    return Weights().effort * ca.substitute(_SQUARE, _SYMBOL, u[0])


PROBLEM = replace(cart(), running_cost=effort)
'''


def symbolic() -> OptimalControlProblem:
    """Closures that share symbols and expressions of both kinds, and a compiled function."""
    symbol = ca.SX.sym("symbol")
    square = symbol**2
    half = ca.Function("half", [symbol], [symbol / 2])
    shift = ca.MX(ca.DM([0.1, 0.0]))
    guess = cart().initial_guess

    def shifted(p: Any, intervals: int) -> Any:
        built = guess(p, intervals)
        return replace(built, states=built.states + shift)

    return replace(
        cart(),
        running_cost=lambda x, u, p: half(ca.substitute(square, symbol, u[0])),
        path_constraints=(
            PathConstraint(
                "force_max",
                lambda at, p: ca.substitute(symbol, symbol, at.u[0]) - p["force_max"],
                3.0,
                "N",
                tolerance=lambda values: 0.01 * values["force_max"],
            ),
        ),
        initial_guess=shifted,
    )


def costs(problem: OptimalControlProblem) -> list[float]:
    function = Costs(problem)()
    return [function(drag) for drag in DRAGS]


def in_a_worker(problem: OptimalControlProblem) -> list[float]:
    engine = ProcessEngine(Costs(problem), 1)
    try:
        return list(engine.map(DRAGS))
    finally:
        engine.close()


def test_closures_over_expressions_go_to_spawned_workers() -> None:
    problem = symbolic()
    assert in_a_worker(problem) == costs(problem)


def load(path: Path) -> ModuleType:
    specification = importlib.util.spec_from_file_location(path.stem, path)
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    sys.modules[path.stem] = module
    specification.loader.exec_module(module)
    return module


def test_problems_of_a_file_go_by_value(tmp_path: Path) -> None:
    path = tmp_path / "own_problem_of_a_file.py"
    path.write_text(OWN_PROBLEM)
    module = load(path)
    try:
        cloudpickle.register_pickle_by_value(module)
        path.unlink()
        expected = costs(module.PROBLEM)
        assert in_a_worker(module.PROBLEM) == expected
    finally:
        cloudpickle.unregister_pickle_by_value(module)
        del sys.modules[path.stem]
    np.testing.assert_allclose(expected, costs(cart()), rtol=1e-12)


@pytest.mark.parametrize("name", problems.names())
def test_known_problems(name: str) -> None:
    problem = problems.get(name)
    other = pickle.loads(pickle.dumps(problem))
    assert other.table.names == problem.table.names
    first, second = (Transcription(p, 6) for p in (problem, other))
    parameters = problem.pack()
    reference = first.initial_guess(parameters)
    np.testing.assert_array_equal(
        first.values(reference, parameters).to_flat(),
        second.values(reference, parameters).to_flat(),
    )


def test_transcriptions_and_loops() -> None:
    transcription = Transcription(symbolic(), 6, free_terminal_time=False)
    options = ScpOptions.for_gradients(fixed_iterations=3)
    scp = pickle.loads(pickle.dumps(Scp(transcription, options)))
    assert scp.options == options
    assert scp.transcription.layout.intervals == 6
    assert not scp.transcription.layout.free_terminal_time
    parameters = transcription.table.pack()
    expected = Scp(transcription, options).run(parameters)
    np.testing.assert_array_equal(scp.run(parameters).final_reference, expected.final_reference)
    free = pickle.loads(pickle.dumps(Transcription(symbolic(), 4, free_terminal_time=True)))
    assert free.layout.free_terminal_time


def test_copies() -> None:
    problem = symbolic()
    for duplicate in (copy.copy(problem), copy.deepcopy(problem)):
        assert duplicate.name == problem.name
        assert costs(duplicate) == costs(problem)


def test_planners() -> None:
    planner = Planner(symbolic(), parameters={"drag": 0.3})
    restored = pickle.loads(pickle.dumps(planner))
    state = planner.initial_state
    plans = [p.plan(state) for p in (planner, restored)]
    assert all(outcome.plan is not None for outcome in plans)
    assert plans[1].cost == pytest.approx(plans[0].cost, rel=1e-9)
    assert restored.settings == planner.settings

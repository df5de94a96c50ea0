from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from core.toy_problems import cart

from dscp_core.errors import InvalidInputError
from dscp_core.planning.planner import Planner
from dscp_core.problem.concessions import Concessions, Shortfall
from dscp_core.problem.declaration import OptimalControlProblem, PathConstraint
from dscp_core.scp.scp import Scp
from dscp_core.transcription.transcription import Transcription

SHORTFALL: dict[str, Any] = {
    "name": "late",
    "error": lambda x, p: x[1] - p["target"][1],
    "unit": "m/s",
    "scale": 0.5,
    "frees": ("speed",),
    "price": lambda values: 1e3,
    "tolerance": 1e-4,
}


def conceding(**changes: Any) -> OptimalControlProblem:
    """The cart, which may be too fast at the end, and as far too fast as it has to be."""
    concessions = Concessions((Shortfall(**SHORTFALL),), **changes)
    return replace(cart(), concessions=concessions, free_terminal_time=False)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("name", ""),
        ("error", 1.0),
        ("price", 1.0),
        ("scale", 0.0),
        ("tolerance", -1.0),
        ("frees", "speed"),
    ],
)
def test_a_wrong_shortfall_is_refused_by_name(field: str, value: Any) -> None:
    with pytest.raises(InvalidInputError, match=field):
        Shortfall(**{**SHORTFALL, field: value})


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"anchors": ("y",)}, "anchors"),
        ({"constraints": (1,)}, "constraints"),
        ({"softened": {"force_max": 1.0}}, "softened force_max"),
        ({"widen": {}}, "widen"),
    ],
)
def test_wrong_concessions_are_refused_by_name(changes: dict[str, Any], named: str) -> None:
    with pytest.raises(InvalidInputError, match=named):
        Concessions((Shortfall(**SHORTFALL),), **changes)


def test_a_shortfall_twice_or_an_unknown_softened_constraint_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="late"):
        Concessions((Shortfall(**SHORTFALL),) * 2)
    with pytest.raises(InvalidInputError, match="softened of concessions"):
        Planner(conceding(softened={"force": lambda values: 1.0}), best_effort=True)


def test_what_is_no_concession_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="concessions"):
        replace(cart(), concessions=())  # type: ignore[arg-type]


def test_any_problem_that_concedes_has_a_best_effort() -> None:
    """A cart that cannot stop: it arrives, as slowly as full braking all the way allows."""
    problem = conceding()
    values = {"start": (0.0, 3.0), "target": (1.0, 0.0), "drag": 0.0, "terminal_time": 1.0}
    planner = Planner(problem, parameters=values, best_effort=True, intervals=40)
    outcome = planner.plan()
    assert outcome.best_effort is not None, outcome.message
    least = np.sqrt(3.0**2 - 2.0 * (2.0 / 1.5) * 1.0)
    end = outcome.best_effort.plan.states[-1]
    assert end[0] == pytest.approx(1.0, abs=1e-6)
    assert end[1] == pytest.approx(least, rel=2e-3)
    assert outcome.best_effort.violations[0].startswith(f"late {end[1]:.4g} m/s")


def test_a_softened_constraint_gives_way_only_where_it_must() -> None:
    soft = conceding(softened={"force_min": lambda values: 1e4})
    soft = replace(soft, concessions=replace(soft.concessions, shortfalls=()))
    fast = {"start": (0.0, 3.0), "target": (1.0, 0.0), "drag": 0.0, "terminal_time": 0.6}
    outcome = Planner(soft, parameters=fast, best_effort=True, intervals=40).plan()
    assert outcome.best_effort is not None, outcome.message
    assert any(line.startswith("force_min") for line in outcome.best_effort.violations)
    # The forwards limit is not softened, and holds.
    assert outcome.best_effort.plan.controls.max() <= 2.0 + 1e-6
    np.testing.assert_allclose(outcome.best_effort.plan.states[-1], [1.0, 0.0], atol=1e-6)


def test_a_free_initial_state_is_decided() -> None:
    """Where the cart starts is its own choice: nearest to the target, at rest, without force."""
    problem = replace(cart(), free_initial_states=("position",))
    scp = Scp(Transcription(problem, 20))
    result = scp.run(problem.pack({"start": (0.0, 0.0)}))
    states = scp.transcription.layout.states(result.final_reference)
    assert result.succeeded
    np.testing.assert_allclose(states[:, 0], 1.0, atol=1e-4)
    np.testing.assert_allclose(states[:, 1], 0.0, atol=1e-4)


def test_a_free_initial_state_has_to_be_a_state() -> None:
    with pytest.raises(InvalidInputError, match="free_initial_states"):
        replace(cart(), free_initial_states=("place",))


def test_a_path_constraint_at_the_end_only() -> None:
    late = PathConstraint("slow", lambda at, p: at.x[1] - 0.1, 0.5, "m/s", only_last=1)
    free = {n: value for n, value in cart().final_state.items() if n != "speed"}
    problem = replace(cart(), final_state=free, path_constraints=(*cart().path_constraints, late))
    scp = Scp(Transcription(problem, 20))
    result = scp.run(problem.pack())
    speeds = scp.transcription.layout.states(result.final_reference)[:, 1]
    assert result.succeeded
    assert speeds[-1] == pytest.approx(0.1, abs=1e-6)
    assert speeds.max() > 0.3

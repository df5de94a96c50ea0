import importlib

import numpy as np
import pytest
from core.random_programs import (
    EVERY_BLOCK,
    LINEAR_COST,
    ConeState,
    Sizes,
    moved,
    plant,
    random_direction,
)

from dscp_core.cone.program import ConeProgram, SolveStatus
from dscp_core.cone.solvers import SOLVER_NAMES, SolverSettings, SolverUnavailableError, make_solver
from dscp_core.cone.solvers.chain import ChainSolver
from dscp_core.errors import InvalidInputError

# A gap of 1e-10 leaves up to its square root, 1e-5, in directions where only the curvature of a
# cone holds the point, times the conditioning of the random programs, below 100. A wrong sign or
# row shows as an error of order one.
POINT_ERROR = 1e-3
# Asked: 1e-10. QOCO may stall earlier (and says so); ECOS stays at the root of its tolerance.
RESIDUAL = {"clarabel": 1e-9, "qoco": 1e-6, "ecos": 1e-5}


def solve(name, program, **limits):
    return make_solver(name, program.pattern).solve(program.values, **limits)


def infeasible():
    """z0 <= 1 and z0 >= 3."""
    return ConeProgram.from_matrices(
        np.eye(3), np.ones(3), np.ones((1, 3)), [0.5], [[1, 0, 0], [-1, 0, 0]], [1, -3], 2
    )


def unbounded():
    """z2 falls for ever; Q does not see it."""
    q = np.diag([1.0, 1.0, 0.0])
    return ConeProgram.from_matrices(q, [0, 1, 1], [[1, 1, 0]], [0.5], [[0, 0, 1.0]], [1], 1)


@pytest.mark.parametrize("sizes", [EVERY_BLOCK, LINEAR_COST], ids=["quadratic", "linear"])
@pytest.mark.parametrize("name", SOLVER_NAMES)
def test_every_backend_finds_the_planted_point_and_duals(name, sizes):
    for seed in range(5):
        planted = plant(seed, sizes)
        answer = solve(name, planted.program)
        assert answer.status is SolveStatus.SOLVED, answer.message
        assert answer.solver == name
        for found, expected in (
            (answer.z, planted.z),
            (answer.equality_dual, planted.nu),
            (answer.cone_dual, planted.y),
            (answer.slack, planted.slack),
        ):
            np.testing.assert_allclose(found, expected, atol=POINT_ERROR)
        # The residuals are ours: small at a good point whatever the backend calls small.
        assert max(answer.primal_residual, answer.dual_residual, answer.gap) < RESIDUAL[name]


@pytest.mark.parametrize(
    "sizes",
    [
        Sizes(n=5, p=2, active_rows=0, inactive_rows=0, cones=()),
        Sizes(n=5, p=0, active_rows=0, inactive_rows=0, cones=()),
        Sizes(n=5, p=0, active_rows=1, inactive_rows=2, cones=()),
        Sizes(n=5, p=2, active_rows=0, inactive_rows=0, cones=((3, ConeState.BOUNDARY),)),
        Sizes(n=5, p=0, active_rows=0, inactive_rows=0, cones=((4, ConeState.APEX),)),
    ],
    ids=["equalities only", "no constraint", "rows only", "no rows", "apex"],
)
@pytest.mark.parametrize("name", SOLVER_NAMES)
def test_missing_blocks_are_no_trouble(name, sizes):
    planted = plant(1, sizes)
    answer = solve(name, planted.program)
    assert answer.status is SolveStatus.SOLVED, answer.message
    np.testing.assert_allclose(answer.z, planted.z, atol=POINT_ERROR)


@pytest.mark.parametrize("name", SOLVER_NAMES)
def test_updated_data_give_the_same_answer_as_a_new_solver(name):
    base = plant(2).program
    kept = make_solver(name, base.pattern)
    direction = random_direction(base, 0)
    for step in (0.0, 0.01, -0.01, 0.02, 0.0):
        program = moved(base, direction, step)
        np.testing.assert_allclose(
            kept.solve(program.values).z, solve(name, program).z, atol=POINT_ERROR
        )


@pytest.mark.parametrize("name", SOLVER_NAMES)
def test_a_solver_recovers_from_an_infeasible_program(name):
    good = infeasible()
    good.values.h[1] = 0.0
    kept = make_solver(name, good.pattern)
    before = kept.solve(good.values)
    assert kept.solve(infeasible().values).status is SolveStatus.INFEASIBLE
    after = kept.solve(good.values)
    assert after.status is SolveStatus.SOLVED
    np.testing.assert_allclose(after.z, before.z, atol=POINT_ERROR)


@pytest.mark.parametrize("name", SOLVER_NAMES)
def test_infeasible_programs_are_certified(name):
    answer = solve(name, infeasible())
    assert answer.status is SolveStatus.INFEASIBLE, answer.message


@pytest.mark.parametrize("name", SOLVER_NAMES)
def test_unbounded_programs_are_certified(name):
    answer = solve(name, unbounded())
    assert answer.status is SolveStatus.UNBOUNDED, answer.message


@pytest.mark.parametrize("name", [*SOLVER_NAMES, "qoco,clarabel"])
def test_nan_never_reaches_a_backend(name):
    program = plant(0).program
    program.values.b[1] = np.nan
    with pytest.raises(InvalidInputError, match=r"b\[1\]"):
        solve(name, program)


@pytest.mark.parametrize("name", SOLVER_NAMES)
def test_an_iteration_limit_is_reported(name):
    program = plant(0).program
    solver = make_solver(name, program.pattern, SolverSettings(max_iterations=2))
    answer = solver.solve(program.values)
    assert answer.status is SolveStatus.ITERATION_LIMIT
    assert answer.iterations <= 2
    assert answer.message


def test_an_early_stop_at_an_acceptable_point_is_solved_and_said():
    # 1e-16 is beyond double precision: every backend gives up, at a point that is good enough.
    program = plant(0).program
    settings = SolverSettings(tolerance=1e-16, acceptable_tolerance=1e-5, max_iterations=60)
    answer = make_solver("clarabel", program.pattern, settings).solve(program.values)
    assert answer.status is SolveStatus.SOLVED
    assert "reduced accuracy" in answer.message


@pytest.mark.parametrize("name", [*SOLVER_NAMES, "qoco,clarabel"])
@pytest.mark.parametrize("limit", [0.0, -1.0])
def test_no_time_left_means_no_attempt(name, limit):
    answer = solve(name, plant(0).program, time_limit_s=limit)
    assert answer.status is SolveStatus.TIME_LIMIT
    assert answer.iterations == 0
    assert np.isnan(answer.z).all()


def test_clarabel_stops_at_its_time_limit_and_forgets_it():
    program = plant(0).program
    solver = make_solver("clarabel", program.pattern)
    # Shorter than any first iteration.
    assert solver.solve(program.values, time_limit_s=1e-9).status is SolveStatus.TIME_LIMIT
    assert solver.solve(program.values).status is SolveStatus.SOLVED


def test_chain_asks_the_next_solver_only_after_a_failure():
    program = plant(0).program
    answer = solve("clarabel,qoco", program)
    assert answer.solver == "clarabel"
    assert answer.attempts == ()


class Stubborn:
    """A solver that always gives up: what a chain does about it does not depend on why."""

    name = "stubborn"

    def __init__(self, program):
        self._inner = make_solver("qoco", program.pattern, SolverSettings(max_iterations=1))

    def solve(self, values, *, time_limit_s=None):
        return self._inner.solve(values, time_limit_s=time_limit_s)


def test_chain_records_every_failed_attempt():
    program = plant(0).program
    chain = ChainSolver(
        [Stubborn(program), Stubborn(program), make_solver("ecos", program.pattern)]
    )
    answer = chain.solve(program.values)
    assert answer.status is SolveStatus.SOLVED
    assert answer.solver == "ecos"
    assert [a.status for a in answer.attempts] == [SolveStatus.ITERATION_LIMIT] * 2
    assert all(a.message for a in answer.attempts)


def test_chain_of_failures_answers_with_the_last_one():
    program = plant(0).program
    answer = ChainSolver([Stubborn(program), Stubborn(program)]).solve(program.values)
    assert answer.status is SolveStatus.ITERATION_LIMIT
    assert len(answer.attempts) == 1


def test_chain_ends_at_a_certificate():
    answer = solve("clarabel,qoco,ecos", infeasible())
    assert answer.status is SolveStatus.INFEASIBLE
    assert answer.solver == "clarabel"
    assert answer.attempts == ()


@pytest.mark.parametrize(
    ("name", "match"), [("cplex", "clarabel"), ("qoco,qoco", "at most once"), ("", "clarabel")]
)
def test_wrong_names_are_refused(name, match):
    with pytest.raises(InvalidInputError, match=match):
        make_solver(name, plant(0).program.pattern)


@pytest.mark.parametrize(
    "settings",
    [
        {"tolerance": 0.0},
        {"tolerance": 1.0},
        {"tolerance": 1e-4, "acceptable_tolerance": 1e-5},
        {"max_iterations": 0},
    ],
)
def test_wrong_settings_are_refused(settings):
    with pytest.raises(InvalidInputError):
        SolverSettings(**settings)


@pytest.mark.parametrize("name", SOLVER_NAMES)
def test_a_missing_package_is_named(name, monkeypatch):
    real = importlib.import_module

    def without(package, *rest):
        if package == name:
            raise ModuleNotFoundError(f"No module named {package!r}", name=package)
        return real(package, *rest)

    monkeypatch.setattr(importlib, "import_module", without)
    with pytest.raises(SolverUnavailableError, match=name):
        make_solver(name, plant(0).program.pattern)

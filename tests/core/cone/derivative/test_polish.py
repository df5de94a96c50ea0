from dataclasses import replace

import numpy as np
import pytest
from core.random_programs import (
    EVERY_BLOCK,
    LINEAR_COST,
    ConeState,
    cone_projection,
    distance_to_disc,
    linearise,
    plant,
    sizes_with_unique_solution,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from dscp_core.cone.derivative.polish import PolishOptions
from dscp_core.cone.derivative.sensitivity import KktSystem, SensitivityOptions
from dscp_core.cone.derivative.verdict import TrustLimits
from dscp_core.cone.program import ConeProgram, SolveStatus
from dscp_core.cone.solvers import SOLVER_NAMES, make_solver

# A polished point has residuals of a few rounding errors; the random programs have condition
# numbers up to some 1e5, so the point itself is exact to better than 1e-9.
POLISHED = 1e-9
MANY_ROWS = replace(EVERY_BLOCK, n=14, active_rows=4, inactive_rows=4)
SETTINGS = settings(max_examples=60, deadline=None, derandomize=True)


# --- the point -------------------------------------------------------------------------------


@pytest.mark.parametrize("sizes", [EVERY_BLOCK, LINEAR_COST], ids=["quadratic", "linear"])
@pytest.mark.parametrize("solver", SOLVER_NAMES)
def test_polish_reaches_the_planted_point_from_every_backend(solver, sizes):
    for seed in range(10):
        planted = plant(seed, sizes)
        found = linearise(planted.program, solver)
        assert found.verdict.trusted, found.verdict.reasons
        assert found.verdict.polished
        # Rounding errors of sums of some 20 products of order one.
        assert found.verdict.kkt_residual < 1e-13
        np.testing.assert_allclose(found.z, planted.z, atol=POLISHED)
        np.testing.assert_allclose(found.equality_dual, planted.nu, atol=POLISHED)
        np.testing.assert_allclose(found.cone_dual, planted.y, atol=POLISHED)
        np.testing.assert_allclose(found.solution.slack, planted.slack, atol=POLISHED)


def test_verdict_counts_the_active_set():
    verdict = linearise(plant(0).program).verdict
    assert (verdict.n_active_linear, verdict.n_active_soc, verdict.n_apex) == (1, 3, 1)


def test_without_polish_the_point_is_the_solvers():
    planted = plant(0)
    solution = make_solver("clarabel", planted.program.pattern).solve(planted.program.values)
    found = KktSystem(planted.program.pattern).linearise(
        planted.program.values, solution, polish=False
    )
    assert found.solution is solution
    assert not found.verdict.polished


def test_a_polished_point_needs_no_further_step():
    program = plant(0).program
    system = KktSystem(program.pattern)
    first = linearise(program)
    second = system.linearise(program.values, first.solution)
    assert second.verdict.newton_steps == 0
    assert np.array_equal(second.z, first.z)


@given(sizes=sizes_with_unique_solution(), seed=st.integers(0, 2**20), flips=st.integers(1, 3))
@SETTINGS
def test_polish_repairs_a_wrong_active_set_or_says_so(sizes, seed, flips):
    planted = plant(seed, sizes)
    n_rows = planted.program.pattern.n_nonnegative
    rows = np.random.default_rng(seed).permutation(n_rows)[:flips]
    exact = planted.solution()
    # Exchange dual and slack: active rows look inactive and the other way round.
    y, slack = planted.y.copy(), planted.slack.copy()
    y[rows], slack[rows] = planted.slack[rows], planted.y[rows]
    wrong = replace(exact, cone_dual=y, slack=slack, dual_residual=1.0)
    found = KktSystem(planted.program.pattern).linearise(planted.program.values, wrong)
    if found.verdict.polished:
        np.testing.assert_allclose(found.z, planted.z, atol=POLISHED)
    else:
        assert not found.verdict.trusted
        assert any("polish failed" in reason for reason in found.verdict.reasons)
        assert found.solution is wrong


@pytest.mark.parametrize("weak", [1e-6, 1e-8])
def test_misjudged_rows_are_repaired_in_both_directions(weak):
    # What a solver's point leaves open are rows whose dual and slack are both small.
    for seed in range(10):
        planted = plant(seed, MANY_ROWS, row_margin=weak)
        for count in (1, 2, 4, 8):
            rows = np.random.default_rng(seed).permutation(8)[:count]
            y, slack = planted.y.copy(), planted.slack.copy()
            y[rows], slack[rows] = slack[rows], y[rows]
            wrong = replace(planted.solution(), cone_dual=y, slack=slack, dual_residual=weak)
            found = KktSystem(planted.program.pattern).linearise(planted.program.values, wrong)
            assert found.verdict.polished, found.verdict.reasons
            assert found.verdict.repairs > 0
            np.testing.assert_allclose(found.z, planted.z, atol=POLISHED)
            np.testing.assert_allclose(found.cone_dual, planted.y, atol=POLISHED)


@pytest.mark.parametrize("weak", [1e-6, 1e-8])
def test_misjudged_cones_are_repaired_in_both_directions(weak):
    for seed in range(10):
        planted = plant(seed, cone_margin=weak)
        starts = planted.program.pattern.soc_starts
        for cone, (dim, state) in enumerate(planted.sizes.cones):
            y, slack = planted.y.copy(), planted.slack.copy()
            block = slice(starts[cone], starts[cone] + dim)
            if state is ConeState.BOUNDARY:
                slack[starts[cone]] += y[starts[cone]]
                y[block] = 0.0
            elif state is ConeState.INACTIVE:
                y[block] = weak * slack[block] * np.r_[1.0, -np.ones(dim - 1)]
                slack[starts[cone]] = np.linalg.norm(slack[block][1:])
            else:
                continue
            wrong = replace(planted.solution(), cone_dual=y, slack=slack, dual_residual=weak)
            found = KktSystem(planted.program.pattern).linearise(planted.program.values, wrong)
            assert found.verdict.polished, found.verdict.reasons
            assert found.verdict.repairs > 0
            np.testing.assert_allclose(found.z, planted.z, atol=POLISHED)
            np.testing.assert_allclose(found.cone_dual, planted.y, atol=POLISHED)


def undecided(planted, seed):
    """The planted point as a solver would return it that stopped early.

    Products of slack and dual are 1e-7 instead of zero, scattered over two decades either way.
    """
    rng = np.random.default_rng(seed)
    rows = slice(0, planted.program.pattern.n_nonnegative)
    y, slack = planted.y.copy(), planted.slack.copy()
    larger = np.maximum(y, slack)[rows]
    y[rows] = np.where(y[rows] > 0.0, y[rows], 1e-7 / larger) * rng.uniform(0.1, 10.0, larger.size)
    slack[rows] = np.where(slack[rows] > 0.0, slack[rows], 1e-7 / larger) * rng.uniform(
        0.1, 10.0, larger.size
    )
    return replace(planted.solution(), z=planted.z + 1e-6, cone_dual=y, slack=slack, gap=1e-3)


def test_interior_steps_decide_what_newtons_method_does_not():
    # Two steps leave Newton's method no room for repairs, so it needs the right set at once.
    options = SensitivityOptions(polish=PolishOptions(max_steps=2))
    without_help = 0
    for seed in range(20):
        planted = plant(seed, MANY_ROWS, row_margin=1e-3)
        rough = undecided(planted, seed)
        system = KktSystem(planted.program.pattern, options)
        found = system.linearise(planted.program.values, rough)
        assert found.verdict.polished, (seed, found.verdict.reasons)
        np.testing.assert_allclose(found.z, planted.z, atol=POLISHED)
        np.testing.assert_allclose(found.cone_dual, planted.y, atol=POLISHED)
        # Judged by dual > slack alone:
        scaled = np.where(rough.cone_dual > rough.slack, 1, 0) == (planted.y > 0)
        without_help += scaled[: planted.program.pattern.n_nonnegative].all()
    assert without_help < 20  # else nothing was undecided


# --- verdict -----------------------------------------------------------------------------------


def row_at_its_kink(gap):
    """min (z - 1)^2 / 2 with z <= 1 + gap: multiplier max(0, -gap), slack max(0, gap)."""
    return ConeProgram.from_matrices([[1.0]], [-1.0], None, [], [[1.0]], [1.0 + gap], 1)


@pytest.mark.parametrize(
    ("gap", "word"), [(1e-11, "tiny slack"), (-1e-11, "tiny dual"), (0.0, "tiny")]
)
def test_a_weakly_active_row_is_not_trusted(gap, word):
    verdict = linearise(row_at_its_kink(gap)).verdict
    assert not verdict.trusted
    assert any(word in reason and "row 0" in reason for reason in verdict.reasons)


@pytest.mark.parametrize("gap", [1e-6, -1e-6])
def test_a_small_but_clear_margin_is_trusted(gap):
    found = linearise(row_at_its_kink(gap))
    assert found.verdict.trusted, found.verdict.reasons
    smallest = min(found.verdict.min_active_dual, found.verdict.min_inactive_slack)
    assert smallest == pytest.approx(1e-6, rel=1.0)
    # dz/dh is 1 at the bound, 0 inside.
    assert found.adjoint(np.ones(1)).h[0] == pytest.approx(float(gap < 0.0), abs=1e-12)


def test_a_cone_near_its_apex_is_not_trusted():
    # |z| <= radius with a radius of nothing: the curvature of the boundary is 1 / radius.
    verdict = linearise(distance_to_disc([3.0, 4.0], radius=1e-12)).verdict
    assert not verdict.trusted


def test_margins_of_rows_and_cones_by_hand():
    # Projections of (-2, 1) on the plane cone: at the apex, with the dual (2, -1) inside the cone.
    found = linearise(cone_projection([-2.0, 1.0]))
    assert found.verdict.n_apex == 1
    # The dual is 1 from the boundary; cost and cone pull with 2 each, through two unit rows.
    assert found.verdict.min_active_dual == pytest.approx(1.0 / (4.0 / np.sqrt(2.0)), rel=1e-9)
    assert found.verdict.min_inactive_slack == np.inf


def test_a_solution_that_is_not_unique_is_not_trusted():
    # Two equal rows: their multipliers are not unique.
    program = ConeProgram.from_matrices(
        np.eye(2), [-2.0, 0.0], None, [], [[1.0, 0.0], [1.0, 0.0]], [1.0, 1.0], 2
    )
    verdict = linearise(program).verdict
    assert not verdict.trusted
    assert any("singular" in reason for reason in verdict.reasons)


def test_a_flat_direction_is_not_trusted():
    # Nothing holds z1 but its bounds, which are far away.
    program = ConeProgram.from_matrices(
        None, [1.0, 0.0], None, [], [[-1, 0], [0, 1], [0, -1.0]], [0.0, 1.0, 1.0], 3
    )
    verdict = linearise(program).verdict
    assert not verdict.trusted
    assert any("singular" in reason for reason in verdict.reasons)


def test_a_point_that_is_not_solved_is_not_trusted():
    planted = plant(0)
    stopped = replace(planted.solution(), status=SolveStatus.ITERATION_LIMIT)
    verdict = KktSystem(planted.program.pattern).linearise(planted.program.values, stopped).verdict
    assert not verdict.trusted
    assert any("iteration limit" in reason for reason in verdict.reasons)


def test_a_rough_point_is_not_trusted_without_polish():
    planted = plant(0)
    rough = replace(planted.solution(), z=planted.z + 1e-3)
    found = KktSystem(planted.program.pattern).linearise(
        planted.program.values, rough, polish=False
    )
    assert any("KKT residual" in reason for reason in found.verdict.reasons)


def test_a_failed_polish_returns_the_solvers_point():
    planted = plant(0)
    rough = replace(planted.solution(), z=planted.z + 1e-3, primal_residual=1e-3)
    options = SensitivityOptions(polish=PolishOptions(max_steps=0))
    system = KktSystem(planted.program.pattern, options)
    found = system.linearise(planted.program.values, rough)
    assert found.solution is rough
    assert any("polish failed" in reason for reason in found.verdict.reasons)


def test_a_solve_that_misses_its_accuracy_adds_a_reason():
    program = plant(0).program
    options = SensitivityOptions(max_refinements=0, trust=TrustLimits(solve_residual=1e-16))
    system = KktSystem(program.pattern, options)
    found = system.linearise(program.values, linearise(program).solution)
    assert found.verdict.trusted
    found.adjoint(np.ones(program.pattern.n))
    assert not found.verdict.trusted
    assert any("derivative solve" in reason for reason in found.verdict.reasons)


def test_margins_have_no_units():
    # Multiplying the cost, or a row, by a factor changes neither the point nor the verdict.
    planted = plant(1)
    reference = linearise(planted.program)
    scaled = planted.program.values.copy()
    scaled.q *= 1e4
    scaled.c *= 1e4
    program = ConeProgram(planted.program.pattern, scaled)
    found = linearise(program)
    np.testing.assert_allclose(found.z, reference.z, atol=POLISHED)
    # Natural sizes are taken at the solver's point, 1e-6 off at worst.
    np.testing.assert_allclose(
        found.margins.active_duals, reference.margins.active_duals, rtol=1e-5
    )
    np.testing.assert_allclose(
        found.margins.inactive_slacks, reference.margins.inactive_slacks, rtol=1e-5
    )

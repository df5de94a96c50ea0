from dataclasses import replace

import diffcp
import numpy as np
import pytest
import scipy.sparse as sp
from core.random_programs import (
    EVERY_BLOCK,
    LINEAR_COST,
    ConeState,
    Sizes,
    cone_projection,
    distance_to_disc,
    linearise,
    moved,
    plant,
    random_direction,
    sizes_with_unique_solution,
)
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from dscp_core.cone.derivative.sensitivity import KktSystem, SensitivityOptions
from dscp_core.cone.program import ConeValues
from dscp_core.cone.solvers import SOLVER_NAMES, make_solver
from dscp_core.errors import InvalidInputError

# Central differences with step h = 1e-5: h^2 times third derivatives (1e-10 times up to 1e3 near
# the edge of an active set) plus the rounding errors of polished points, 1e-13, over h.
STEP = 1e-5
DIFFERENCE = 1e-6
SETTINGS = settings(max_examples=60, deadline=None, derandomize=True)


def central_difference(program, direction, step=STEP):
    """Change of z, nu, y along a direction, from two programs solved and polished afresh."""
    ends = [linearise(moved(program, direction, sign * step)) for sign in (1.0, -1.0)]
    assert all(end.verdict.polished for end in ends)
    return [
        (getattr(ends[0], name) - getattr(ends[1], name)) / (2.0 * step)
        for name in ("z", "equality_dual", "cone_dual")
    ]


def blocks(planted):
    """Flat positions of the values of every block, cones by their state."""
    pattern = planted.program.pattern
    starts = dict(zip(ConeValues.FIELDS, pattern.flat_offsets, strict=False))
    diagonal = pattern.q.indices == pattern.q.columns
    row_names = np.array(["row"] * pattern.n_nonnegative + ["?"] * sum(pattern.soc_dims), object)
    row_names[: pattern.n_nonnegative][planted.y[: pattern.n_nonnegative] > 0] = "active row"
    for start, (dim, state) in zip(pattern.soc_starts, planted.sizes.cones, strict=True):
        row_names[start] = f"{state.value} cone head"
        row_names[start + 1 : start + dim] = f"{state.value} cone tail"
    names = np.concatenate(
        (
            np.where(diagonal, "q diagonal", "q off-diagonal"),
            np.full(pattern.n, "c"),
            np.full(pattern.a.nnz, "a"),
            np.full(pattern.n_equalities, "b"),
            "g, " + row_names[pattern.g.indices],
            "h, " + row_names,
        )
    )
    assert names.size == pattern.n_values
    assert starts["h"] == names.size - pattern.n_cone_rows
    return names


# --- derivatives against central differences --------------------------------------------------


@pytest.mark.parametrize("sizes", [EVERY_BLOCK, LINEAR_COST], ids=["quadratic", "linear"])
def test_adjoint_of_every_block_against_central_differences(sizes):
    planted = plant(4, sizes, density=0.5)
    program = planted.program
    seed_of_loss = np.random.default_rng(1).standard_normal(sizes.n)
    adjoint = linearise(program).adjoint(seed_of_loss).to_flat()
    names = blocks(planted)
    # c, a, b; g and h of 2 states of a row, and of heads and tails in 3 states of a cone; Q.
    assert len(set(names)) == 3 + 2 * (2 + 2 * 3) + (2 if sizes.quadratic else 0)
    difference = np.empty_like(adjoint)
    for i in range(adjoint.size):
        unit = ConeValues.from_flat(program.pattern, np.eye(1, adjoint.size, i)[0])
        difference[i] = seed_of_loss @ central_difference(program, unit)[0]
    scale = np.abs(difference).max()
    for name in sorted(set(names)):
        of_block = names == name
        error = np.abs(adjoint - difference)[of_block].max()
        assert error <= DIFFERENCE * scale, f"{name}: {error:.1e} of {scale:.1e}"
        if "inactive" not in name and ", row" not in name:
            # The block has something to be wrong about.
            assert np.abs(difference[of_block]).max() > 1e-3 * scale, name


@given(sizes=sizes_with_unique_solution(), seed=st.integers(0, 2**20))
@SETTINGS
def test_tangent_against_central_differences(sizes, seed):
    program = plant(seed, sizes).program
    direction = random_direction(program, seed)
    found = linearise(program)
    # Central differences mean something only on one side of an active-set change.
    assume(found.active_set_radius(direction) > 1e3 * STEP)
    assume(found.verdict.condition_estimate < 1e6)
    for mine, theirs in zip(
        found.tangent(direction), central_difference(program, direction), strict=True
    ):
        # Third derivatives of a solution grow like the cube of its first.
        bound = DIFFERENCE * max(1.0, np.abs(theirs).max(initial=0.0)) ** 3
        assert np.abs(mine - theirs).max(initial=0.0) <= bound


@given(sizes=sizes_with_unique_solution(), seed=st.integers(0, 2**20))
@SETTINGS
def test_adjoint_and_tangent_are_transposes(sizes, seed):
    program = plant(seed, sizes).program
    direction = random_direction(program, seed)
    loss = np.random.default_rng(seed + 1).standard_normal(sizes.n)
    found = linearise(program)
    forward = loss * found.tangent(direction)[0]
    reverse = found.adjoint(loss).to_flat() * direction.to_flat()
    # Relative to the sums' terms: their rounding, and 1e-14 of refinement times conditioning.
    bound = 1e-10 * max(np.abs(forward).sum(), np.abs(reverse).sum())
    assert abs(forward.sum() - reverse.sum()) <= bound


def test_apex_and_boundary_change_their_duals_as_well():
    planted = plant(5)
    direction = random_direction(planted.program, 2)
    _, dnu, dy = linearise(planted.program).tangent(direction)
    _, expected_dnu, expected_dy = central_difference(planted.program, direction)
    np.testing.assert_allclose(dnu, expected_dnu, atol=1e-5 * np.abs(expected_dy).max())
    np.testing.assert_allclose(dy, expected_dy, atol=1e-5 * np.abs(expected_dy).max())


@pytest.mark.parametrize("solver", SOLVER_NAMES)
def test_derivatives_do_not_depend_on_the_backend(solver):
    planted = plant(7)
    loss = np.arange(1.0, planted.sizes.n + 1.0)
    exact = KktSystem(planted.program.pattern).linearise(planted.program.values, planted.solution())
    np.testing.assert_allclose(
        linearise(planted.program, solver).adjoint(loss).to_flat(),
        exact.adjoint(loss).to_flat(),
        atol=1e-7 * np.abs(exact.adjoint(loss).to_flat()).max(),
    )


# --- derivatives against diffcp ----------------------------------------------------------------


@pytest.mark.parametrize("seed", range(6))
def test_adjoint_agrees_with_diffcp(seed):
    # diffcp differentiates the residual map of the homogeneous embedding: another derivation.
    planted = plant(seed, LINEAR_COST)
    program, sizes = planted.program, planted.sizes
    pattern, values = program.pattern, program.values
    loss = np.random.default_rng(seed).standard_normal(sizes.n)
    stacked = np.concatenate((values.a, values.g))[pattern.stacked_order]
    result = diffcp.solve_and_derivative(
        sp.csc_matrix(pattern.stacked.matrix(stacked)),
        np.concatenate((values.b, values.h)),
        values.c,
        {
            diffcp.ZERO: pattern.n_equalities,
            diffcp.POS: pattern.n_nonnegative,
            diffcp.SOC: list(pattern.soc_dims),
        },
        mode="dense",
        solve_method="Clarabel",
        tol_gap_abs=1e-13,
        tol_gap_rel=1e-13,
        tol_feas=1e-13,
    )
    da, db, dc = result[4](loss, np.zeros(pattern.stacked.n_rows), np.zeros(pattern.stacked.n_rows))
    mine = linearise(program).adjoint(loss)
    mine_stacked = pattern.stacked.matrix(
        np.concatenate((mine.a, mine.g))[pattern.stacked_order]
    ).toarray()
    theirs = sp.csc_array(da).toarray()[pattern.stacked.indices, pattern.stacked.columns]
    ours = mine_stacked[pattern.stacked.indices, pattern.stacked.columns]
    # diffcp's solver leaves errors of 1e-7 in the point (no polish); its derivative inherits
    # them, times the conditioning of the program.
    scale = max(np.abs(theirs).max(), np.abs(db).max(), np.abs(dc).max())
    np.testing.assert_allclose(ours, theirs, atol=1e-4 * scale)
    np.testing.assert_allclose(np.concatenate((mine.b, mine.h)), db, atol=1e-4 * scale)
    np.testing.assert_allclose(mine.c, dc, atol=1e-4 * scale)


# --- textbook cases ------------------------------------------------------------------------------


def test_projection_on_a_disc_by_hand():
    centre = np.array([3.0, 4.0])
    program = distance_to_disc(centre)
    found = linearise(program)
    np.testing.assert_allclose(found.z, centre / 5.0, atol=1e-14)
    np.testing.assert_allclose(found.cone_dual, [4.0, -2.4, -3.2], atol=1e-13)
    # dz/dcentre = (I - u u') / 5 and dz/dradius = u.
    u = centre / 5.0
    for k in range(2):
        adjoint = found.adjoint(np.eye(2)[k])
        expected = (np.eye(2) - np.outer(u, u))[k] / 5.0
        np.testing.assert_allclose(-adjoint.c, expected, atol=1e-14)
        assert adjoint.h[0] == pytest.approx(u[k], abs=1e-14)


def test_radius_is_the_distance_to_the_change_of_the_active_set():
    # The constraint becomes inactive when the radius has grown from 1 to 5.
    program = distance_to_disc([3.0, 4.0])
    found = linearise(program)
    direction = ConeValues.from_flat(program.pattern, np.zeros(program.pattern.n_values))
    direction.h[0] = 1.0
    assert found.active_set_radius(direction) == pytest.approx(4.0, rel=1e-12)
    direction.h[0] = -1.0  # the multiplier grows, but the disc shrinks to its apex at 1
    assert found.active_set_radius(direction) == pytest.approx(1.0, rel=1e-12)


def test_radius_of_a_cone_at_its_apex():
    # The dual (2, -1) leaves the inside of the cone when the target's second entry reaches 2.
    program = cone_projection([-2.0, 1.0])
    direction = ConeValues.from_flat(program.pattern, np.zeros(program.pattern.n_values))
    direction.c[1] = -1.0
    assert linearise(program).active_set_radius(direction) == pytest.approx(1.0, rel=1e-12)
    direction.c[1] = 1.0  # the other way it crosses the cone's axis first: 1 + 2
    assert linearise(program).active_set_radius(direction) == np.inf


def test_radius_of_an_inactive_cone():
    # Inside the disc z follows the centre; moving right from (0.5, 0) it touches at 1.
    program = distance_to_disc([0.5, 0.0])
    direction = ConeValues.from_flat(program.pattern, np.zeros(program.pattern.n_values))
    direction.c[0] = -1.0
    found = linearise(program)
    assert found.active_set_radius(direction) == pytest.approx(0.5, rel=1e-12)
    direction.c[0] = 0.0
    assert found.active_set_radius(direction) == np.inf


@given(sizes=sizes_with_unique_solution(), seed=st.integers(0, 2**20))
@SETTINGS
def test_no_change_of_the_active_set_within_the_radius(sizes, seed):
    program = plant(seed, sizes).program
    direction = random_direction(program, seed)
    found = linearise(program)
    radius = found.active_set_radius(direction)
    assert radius > 0.0
    # To first order only: a tenth of the radius, at most the size where second order is small.
    after = linearise(moved(program, direction, min(0.1 * radius, 1e-3)))
    for name in ("n_active_linear", "n_active_soc", "n_apex"):
        assert getattr(after.verdict, name) == getattr(found.verdict, name)


# --- use of one system for many solutions --------------------------------------------------------


def test_earlier_linearisations_stay_valid():
    first_program = plant(0).program
    system = KktSystem(first_program.pattern)
    solver = make_solver("clarabel", first_program.pattern)
    loss = np.ones(first_program.pattern.n)
    first = system.linearise(first_program.values, solver.solve(first_program.values))
    before = first.adjoint(loss).to_flat()
    second_program = moved(first_program, random_direction(first_program, 1), 0.02)
    second = system.linearise(second_program.values, solver.solve(second_program.values))
    first_program.values.g[:] = 0.0  # the caller may reuse its arrays
    assert np.array_equal(first.adjoint(loss).to_flat(), before)
    assert not np.array_equal(second.adjoint(loss).to_flat(), before)


def test_wrong_sizes_and_numbers_are_refused():
    planted = plant(0)
    system = KktSystem(planted.program.pattern)
    values, solution = planted.program.values, planted.solution()
    with pytest.raises(InvalidInputError, match=r"solution\.z\.shape"):
        system.linearise(values, replace(solution, z=np.zeros(3)))
    with pytest.raises(InvalidInputError, match=r"solution\.slack"):
        system.linearise(values, replace(solution, slack=solution.slack * np.nan))
    found = system.linearise(values, solution)
    with pytest.raises(InvalidInputError, match=r"dz\.shape"):
        found.adjoint(np.zeros(3))
    with pytest.raises(InvalidInputError, match="dz"):
        found.adjoint(np.full(planted.sizes.n, np.nan))
    with pytest.raises(InvalidInputError, match=r"c\.shape"):
        found.tangent(replace(values, c=np.zeros(1)))
    broken = values.copy()
    broken.q[0] = np.inf
    with pytest.raises(InvalidInputError, match=r"q\[0\]"):
        system.linearise(broken, solution)


@pytest.mark.parametrize("options", [{"regularisation": 0.0}, {"max_refinements": -1}])
def test_wrong_options_are_refused(options):
    with pytest.raises(InvalidInputError):
        SensitivityOptions(**options)


def test_large_cone_with_shared_columns():
    # Rows of G that share columns: the curvature of the cone fills their block of the KKT matrix.
    sizes = Sizes(n=12, p=1, active_rows=1, inactive_rows=0, cones=((8, ConeState.BOUNDARY),))
    program = plant(3, sizes, density=1.0).program
    direction = random_direction(program, 3)
    mine = linearise(program).tangent(direction)[0]
    theirs = central_difference(program, direction)[0]
    np.testing.assert_allclose(mine, theirs, atol=DIFFERENCE * max(1.0, np.abs(theirs).max()))

import numpy as np
import pytest
import scipy.sparse as sp
from core.random_programs import EVERY_BLOCK, plant

from dscp_core.cone.program import ConePattern, ConeProgram, ConeValues, CscPattern
from dscp_core.cone.residuals import BoundMatrices, cone_violation, residuals
from dscp_core.cone.solvers import make_solver
from dscp_core.errors import InvalidInputError

Q = np.array([[2.0, 0.5, 0.0], [0.5, 1.0, 0.0], [0.0, 0.0, 0.0]])
C = np.array([1.0, -1.0, 0.5])
A = np.array([[1.0, 0.0, 2.0]])
B = np.array([0.3])
G = np.array([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0], [0, 2.0, 1.0]])
H = np.array([1.0, 2.0, 3.0, 4.0])


def program(**changes):
    matrices = {"Q": Q, "c": C, "A": A, "b": B, "G": G, "h": H}
    cones = {"n_nonnegative": 1, "soc_dims": [3]}
    return ConeProgram.from_matrices(**(matrices | cones | changes))


def pattern(**changes):
    base = program().pattern
    parts = {"q": base.q, "a": base.a, "g": base.g}
    cones = {"n": 3, "n_nonnegative": 1, "soc_dims": (3,)}
    return ConePattern(**(parts | cones | changes))


def test_matrices_come_back():
    made = program()
    values, shape = made.values, made.pattern
    assert np.array_equal(shape.q.matrix(values.q).toarray(), np.triu(Q))
    assert np.array_equal(shape.a.matrix(values.a).toarray(), A)
    assert np.array_equal(shape.g.matrix(values.g).toarray(), G)
    assert (shape.n, shape.n_equalities, shape.n_cone_rows) == (3, 1, 4)


def test_stored_zeros_of_sparse_input_stay_in_the_pattern():
    stored = sp.csc_array((np.zeros(1), ([0], [1])), shape=(1, 3))
    assert program(A=stored).pattern.a.nnz == 1
    assert program(A=np.zeros((1, 3))).pattern.a.nnz == 0


def test_duplicate_entries_are_summed():
    twice = sp.coo_array((np.array([1.0, 2.0]), ([0, 0], [1, 1])), shape=(1, 3))
    made = program(A=twice)
    assert made.values.a.tolist() == [3.0]


def test_input_arrays_are_not_shared():
    c = C.copy()
    made = program(c=c)
    c[0] = 99.0
    assert made.values.c[0] == 1.0


def test_flat_vector_is_in_the_stated_order_and_shared():
    made = program()
    flat = made.values.to_flat()
    expected = [made.values.q, C, made.values.a, B, made.values.g, H]
    assert np.array_equal(flat, np.concatenate(expected))
    views = ConeValues.from_flat(made.pattern, flat)
    flat[-1] = 7.0
    assert views.h[-1] == 7.0


def test_flat_vector_of_wrong_length_is_refused():
    made = program()
    with pytest.raises(InvalidInputError, match=r"flat\.shape"):
        ConeValues.from_flat(made.pattern, np.zeros(made.pattern.n_values + 1))


def test_stacked_pattern_is_a_above_g():
    made = plant(0).program
    shape, values = made.pattern, made.values
    data = np.concatenate((values.a, values.g))[shape.stacked_order]
    expected = np.vstack((shape.a.matrix(values.a).toarray(), shape.g.matrix(values.g).toarray()))
    assert np.array_equal(shape.stacked.matrix(data).toarray(), expected)


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"Q": Q[:2]}, "Q.shape"),
        ({"Q": Q + np.triu(np.ones((3, 3)), 1)}, "Q"),
        ({"A": A[:, :2]}, "A.shape"),
        ({"b": np.zeros(2)}, "b.shape"),
        ({"G": G[:, :2]}, "G.shape"),
        ({"h": np.zeros(3)}, "h.shape"),
        ({"c": np.zeros((3, 1))}, "c.shape"),
        ({"c": [1.0, np.nan, 0.0]}, "c[1]"),
        ({"h": [1.0, 2.0, np.inf, 0.0]}, "h[2]"),
        ({"soc_dims": [2]}, "n_nonnegative + sum(soc_dims)"),
        ({"soc_dims": [2, 1]}, "soc_dims[1]"),
        ({"n_nonnegative": -1, "soc_dims": [5]}, "n_nonnegative"),
    ],
)
def test_wrong_programs_are_refused_by_field(changes, field):
    with pytest.raises(InvalidInputError) as caught:
        program(**changes)
    assert caught.value.field == field


@pytest.mark.parametrize("solver", ["clarabel", "qoco"])
@pytest.mark.parametrize(
    ("parts", "expected"),
    [
        ({}, [-1.0, 1.0]),
        ({"A": None, "b": None, "G": None, "h": None}, [-1.0, 1.0]),
        ({"A": [[1.0, 1.0]], "b": [1.0]}, [-0.5, 1.5]),
        ({"A": None, "b": None, "G": [[0.0, 1.0]], "h": [0.5]}, [-1.0, 0.5]),
        (
            {"G": [[0.0, 0.0], [-1.0, 0.0], [0.0, -1.0]], "h": [1.0, 0.0, 0.0], "soc_dims": [3]},
            [-(0.5**0.5), 0.5**0.5],
        ),
    ],
)
def test_absent_parts_are_none(solver, parts, expected):
    program = ConeProgram.from_matrices(np.eye(2), [1.0, -1.0], **parts)
    solution = make_solver(solver, program.pattern).solve(program.values)
    np.testing.assert_allclose(solution.z, expected, atol=1e-7)


@pytest.mark.parametrize(
    ("parts", "message"),
    [({"b": [1.0]}, r"b.shape: got \(1,\)"), ({"G": [[1.0, 0.0]]}, r"h.shape: got \(0,\)")],
)
def test_half_a_part_is_refused(parts, message):
    with pytest.raises(InvalidInputError, match=message):
        ConeProgram.from_matrices(np.eye(2), [1.0, -1.0], **parts)


def test_off_diagonal_without_diagonal_is_refused():
    # z0 z1 alone is indefinite, whatever the numbers.
    with pytest.raises(InvalidInputError, match="positive semidefinite structure"):
        program(Q=np.array([[1.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]))


def test_lower_triangle_in_the_pattern_of_q_is_refused():
    full = CscPattern.from_matrix(sp.csc_array(Q))
    with pytest.raises(InvalidInputError, match="upper triangle"):
        pattern(q=full)


@pytest.mark.parametrize(
    ("indptr", "indices"),
    [
        ([0, 1], [0]),  # too short
        ([1, 1, 1], [0]),  # does not start at zero
        ([0, 2, 1], [0, 1]),  # decreasing
        ([0, 1, 1], [0, 1]),  # does not end at the number of entries
        ([0, 1, 2], [0, 2]),  # row out of range
        ([0, 2, 2], [1, 0]),  # rows not sorted
        ([0, 2, 2], [1, 1]),  # duplicate
    ],
)
def test_broken_sparse_structures_are_refused(indptr, indices):
    with pytest.raises(InvalidInputError):
        CscPattern(2, 2, np.array(indptr), np.array(indices))


def test_check_names_the_first_bad_entry():
    made = program()
    made.values.g[2] = np.nan
    with pytest.raises(InvalidInputError) as caught:
        made.values.check(made.pattern)
    assert caught.value.field == "g[2]"


def test_check_refuses_single_precision():
    made = program()
    made.values.c = made.values.c.astype(np.float32)
    with pytest.raises(InvalidInputError, match=r"c\.dtype"):
        made.values.check(made.pattern)


def test_residuals_vanish_at_the_planted_solution_and_see_every_condition():
    planted = plant(3)
    shape, values = planted.program.pattern, planted.program.values
    matrices = BoundMatrices(shape)
    matrices.bind(values)

    def at(z=planted.z, nu=planted.nu, y=planted.y, slack=planted.slack):
        duals = np.concatenate((nu, y))
        return residuals(shape, values, matrices.products(z, duals), z, duals, slack)

    # The planted data are rounded sums of some 20 products of order one.
    assert at().worst < 1e-14
    assert at(z=planted.z + 1e-3).primal > 1e-4
    assert at(nu=planted.nu + 1e-3).dual > 1e-4
    inactive = np.flatnonzero(planted.y[: EVERY_BLOCK.inactive_rows + 1] == 0.0)[0]
    wrong = planted.y.copy()
    wrong[inactive] = -1e-3
    assert at(y=wrong).dual > 1e-5
    wrong[inactive] = 1e-3
    assert at(y=wrong).gap > 1e-5
    assert at(z=np.full(shape.n, np.nan)).worst == np.inf


def test_cone_violation_measures_rows_and_cones():
    shape = program().pattern
    assert cone_violation(shape, np.array([0.0, 5.0, 3.0, 4.0])) == 0.0
    assert cone_violation(shape, np.array([-0.25, 5.0, 3.0, 4.0])) == 0.25
    assert cone_violation(shape, np.array([1.0, 4.5, 3.0, 4.0])) == 0.5

"""Which matrices of a cost pass as convex, against their eigenvalues."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from dscp_core.cone.convexity import (
    ConvexityCheck,
    NotConvexError,
    least_eigenvalue,
    require_convex,
)
from dscp_core.cone.program import ConeProgram
from dscp_core.cone.solvers import SOLVER_NAMES, make_solver

BOX = {"G": np.vstack([np.eye(2), -np.eye(2)]), "h": np.ones(4)}


@pytest.mark.parametrize("solver", SOLVER_NAMES)
@pytest.mark.parametrize("matrix", [np.diag([1.0, -1.0]), np.array([[1.0, 2.0], [2.0, 1.0]])])
def test_a_saddle_is_no_solution(solver, matrix):
    program = ConeProgram.from_matrices(matrix, [0.0, 0.0], **BOX)
    with pytest.raises(NotConvexError, match=r"Q: got 'least eigenvalue -1', .*semidefinite"):
        make_solver(solver, program.pattern).solve(program.values)


def test_a_zero_diagonal_with_products_is_no_convex_cost():
    matrix = sp.csc_array(np.array([[0.0, 1e-3], [1e-3, 0.0]]))
    matrix.setdiag(0.0)
    program = ConeProgram.from_matrices(matrix, [0.0, 0.0], **BOX)
    with pytest.raises(NotConvexError, match=r"least eigenvalue -0\.001"):
        make_solver("clarabel", program.pattern).solve(program.values)


@settings(max_examples=200, deadline=None)
@given(
    size=st.integers(1, 8),
    seed=st.integers(0, 2**32 - 1),
    spread=st.floats(0.0, 3.0),
    sign=st.sampled_from([-1.0, 0.0, 1.0]),
    margin=st.floats(-5.0, -1.0),
)
def test_verdict_is_that_of_the_eigenvalues(size, seed, spread, sign, margin):
    random = np.random.default_rng(seed)
    basis = np.linalg.qr(random.standard_normal((size, size)))[0]
    eigenvalues = random.uniform(0.1, 1.0, size)
    eigenvalues[0] = sign * 10.0**margin
    scales = 10.0 ** random.uniform(-spread / 2, spread / 2, size)
    matrix = scales[:, None] * (basis * eigenvalues @ basis.T) * scales
    matrix = (matrix + matrix.T) / 2
    program = ConeProgram.from_matrices(matrix, np.zeros(size))
    if sign < 0.0:
        with pytest.raises(NotConvexError):
            ConvexityCheck(program.pattern).check(program.values)
    else:
        ConvexityCheck(program.pattern).check(program.values)


def test_rounding_is_no_saddle():
    # Projections across a direction, which are singular, at very different sizes.
    random = np.random.default_rng(0)
    blocks = []
    for exponent in range(-6, 7):
        direction = random.standard_normal(3)
        direction[exponent % 3] = 0.0
        direction /= np.linalg.norm(direction)
        blocks.append(10.0**exponent * (np.eye(3) - np.outer(direction, direction)))
    program = ConeProgram.from_matrices(sp.block_diag(blocks), np.zeros(39))
    ConvexityCheck(program.pattern).check(program.values)
    for block in blocks:
        require_convex("projection", block)


def test_least_eigenvalue_counts_empty_rows():
    assert least_eigenvalue(np.diag([2.0, 0.0])) == 0.0
    assert least_eigenvalue(np.diag([2.0, 3.0])) == 2.0
    assert least_eigenvalue(np.zeros((3, 3))) == 0.0
    with pytest.raises(NotConvexError, match=r"cost term effort: .*-3 of its Hessian.*convex"):
        require_convex("cost term effort", np.diag([1.0, -3.0]))


@pytest.mark.parametrize("size", [8, 60])
def test_a_variable_that_all_others_multiply(size):
    # A narrow and a wide band: they are factored in different ways.
    arrow = np.eye(size)
    arrow[0, 1:] = arrow[1:, 0] = 0.5
    for own, convex in ((0.25 * (size - 1), True), (0.25 * (size - 1) - 1e-3, False)):
        arrow[0, 0] = own
        program = ConeProgram.from_matrices(arrow, np.zeros(size))
        if convex:
            ConvexityCheck(program.pattern).check(program.values)
        else:
            with pytest.raises(NotConvexError, match="least eigenvalue -"):
                ConvexityCheck(program.pattern).check(program.values)


def test_the_least_eigenvalue_of_a_large_program_is_found_without_a_dense_matrix():
    size = 4000
    matrix = sp.diags_array(np.linspace(1.0, 2.0, size), format="lil")
    matrix[7, 8] = matrix[8, 7] = 3.0
    program = ConeProgram.from_matrices(sp.csc_array(matrix), np.zeros(size))
    with pytest.raises(NotConvexError, match="least eigenvalue -2"):
        ConvexityCheck(program.pattern).check(program.values)

"""Random cone programs whose solution, duals and active set are known exactly.

The optimum is planted: z, nu and a strictly complementary pair (s, y) are drawn first, the data
follow as b = Az, h = Gz + s, c = -(Qz + A'nu + G'y).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
import scipy.sparse as sp
from hypothesis import strategies as st

from dscp_core.cone.derivative.sensitivity import KktSystem, Linearisation
from dscp_core.cone.program import ConeProgram, ConeSolution, ConeValues, FloatArray, SolveStatus
from dscp_core.cone.solvers import make_solver


class ConeState(Enum):
    INACTIVE = "inactive"
    BOUNDARY = "boundary"
    APEX = "apex"


@dataclass(frozen=True)
class Sizes:
    """Shape of a random program.

    Attributes:
        n: Variables.
        p: Equalities.
        active_rows: Active nonnegative rows.
        inactive_rows: Inactive nonnegative rows.
        cones: Dimension and state of each second-order cone.
        quadratic: Whether Q is positive definite; otherwise Q is empty.
    """

    n: int
    p: int
    active_rows: int
    inactive_rows: int
    cones: tuple[tuple[int, ConeState], ...]
    quadratic: bool = True

    @property
    def independent_conditions(self) -> int:
        """Active constraints, which must not exceed n for the duals to be unique."""
        per_cone = {ConeState.INACTIVE: 0, ConeState.BOUNDARY: 1}
        return (
            self.p + self.active_rows + sum(per_cone.get(state, dim) for dim, state in self.cones)
        )


@dataclass(frozen=True)
class PlantedProgram:
    program: ConeProgram
    sizes: Sizes
    z: FloatArray
    nu: FloatArray
    y: FloatArray
    slack: FloatArray

    def solution(self) -> ConeSolution:
        """The exact solution, as a solver would return it."""
        return ConeSolution(
            z=self.z,
            equality_dual=self.nu,
            cone_dual=self.y,
            slack=self.slack,
            status=SolveStatus.SOLVED,
            solver="planted",
            iterations=0,
            seconds=0.0,
            primal_residual=0.0,
            dual_residual=0.0,
            gap=0.0,
        )


# All three states of a cone, both states of a row, equalities, off-diagonal entries of Q.
EVERY_BLOCK = Sizes(
    n=9,
    p=2,
    active_rows=1,
    inactive_rows=2,
    cones=(
        (3, ConeState.BOUNDARY),
        (4, ConeState.BOUNDARY),
        (3, ConeState.INACTIVE),
        (2, ConeState.APEX),
    ),
)
# No quadratic term: a vertex but for one direction, which the curvature of a cone determines.
LINEAR_COST = replace(EVERY_BLOCK, active_rows=2, quadratic=False)


def plant(
    seed: int,
    sizes: Sizes = EVERY_BLOCK,
    density: float = 0.7,
    row_margin: float = 1.0,
    cone_margin: float = 1.0,
) -> PlantedProgram:
    """Random program of these sizes; margins of strict complementarity are at least 0.3.

    `row_margin` scales the slacks and multipliers of the nonnegative rows, `cone_margin` the
    multipliers of the cones on their boundary and the distance of the inactive ones from it.
    """
    rng = np.random.default_rng(seed)
    n, p = sizes.n, sizes.p
    n_rows = sizes.active_rows + sizes.inactive_rows
    m = n_rows + sum(dim for dim, _ in sizes.cones)
    z, nu = rng.standard_normal(n), rng.standard_normal(p)
    slack, y = np.zeros(m), np.zeros(m)
    active = rng.permutation(n_rows) < sizes.active_rows
    slack[:n_rows][~active] = row_margin * rng.uniform(0.3, 2.0, sizes.inactive_rows)
    y[:n_rows][active] = row_margin * rng.uniform(0.3, 2.0, sizes.active_rows)
    row = n_rows
    for dim, state in sizes.cones:
        block = slice(row, row + dim)
        direction = rng.standard_normal(dim - 1)
        direction /= np.linalg.norm(direction)
        interior = np.concatenate(([rng.uniform(1.0, 2.0)], 0.7 * direction))
        if state is ConeState.INACTIVE:
            slack[block] = interior
            slack[row] = 0.7 + cone_margin * (slack[row] - 0.7)
        elif state is ConeState.APEX:
            y[block] = interior
        else:
            slack[block] = rng.uniform(0.5, 2.0) * np.concatenate(([1.0], direction))
            y[block] = cone_margin * rng.uniform(0.3, 2.0) * np.concatenate(([1.0], -direction))
        row += dim
    a, g = _sparse(rng, p, n, density), _sparse(rng, m, n, density)
    if sizes.quadratic:
        factor = rng.standard_normal((n, n)) * (rng.random((n, n)) < 0.3)
        q = sp.csc_array(factor @ factor.T + np.diag(rng.uniform(0.5, 1.5, n)))
    else:
        q = sp.csc_array((n, n))
    c = -(q @ z + a.T @ nu + g.T @ y)
    program = ConeProgram.from_matrices(
        q, c, a, a @ z, g, g @ z + slack, n_rows, [dim for dim, _ in sizes.cones]
    )
    return PlantedProgram(program, sizes, z, nu, y, slack)


def linearise(program: ConeProgram, solver: str = "clarabel") -> Linearisation:
    """Solve and linearise, both from nothing."""
    solution = make_solver(solver, program.pattern).solve(program.values)
    assert solution.status is SolveStatus.SOLVED, solution.message
    return KktSystem(program.pattern).linearise(program.values, solution)


def distance_to_disc(centre: Sequence[float], radius: float = 1.0) -> ConeProgram:
    """Program min |z - centre|^2 / 2 with |z| <= radius: z = radius centre / |centre| outside."""
    return ConeProgram.from_matrices(
        np.eye(2),
        -np.asarray(centre),
        None,
        [],
        [[0, 0], [-1, 0], [0, -1]],
        [radius, 0, 0],
        0,
        [3],
    )


def cone_projection(target: Sequence[float]) -> ConeProgram:
    """Program min |z - target|^2 / 2 with z in the second-order cone."""
    dim = len(target)
    return ConeProgram.from_matrices(
        np.eye(dim), -np.asarray(target), None, [], -np.eye(dim), np.zeros(dim), 0, [dim]
    )


def random_direction(program: ConeProgram, seed: int) -> ConeValues:
    """Random change of every value."""
    rng = np.random.default_rng(seed)
    return ConeValues.from_flat(program.pattern, rng.standard_normal(program.pattern.n_values))


def moved(program: ConeProgram, direction: ConeValues, step: float) -> ConeProgram:
    """The program with all values moved by step times the direction."""
    flat = program.values.to_flat() + step * direction.to_flat()
    return ConeProgram(program.pattern, ConeValues.from_flat(program.pattern, flat))


@st.composite
def sizes_with_unique_solution(draw: st.DrawFn) -> Sizes:
    """Sizes for which a random program has a unique solution and unique duals."""
    cones = draw(
        st.lists(st.tuples(st.integers(2, 5), st.sampled_from(ConeState)), max_size=4).map(tuple)
    )
    sizes = Sizes(
        n=1,
        p=draw(st.integers(0, 3)),
        active_rows=draw(st.integers(0, 3)),
        inactive_rows=draw(st.integers(0, 3)),
        cones=cones,
    )
    # One spare variable at least: with as many conditions as variables z could not move at all.
    return replace(sizes, n=sizes.independent_conditions + draw(st.integers(1, 4)))


def _sparse(rng: np.random.Generator, rows: int, columns: int, density: float) -> sp.csc_array:
    """Random matrix without empty rows."""
    matrix = rng.standard_normal((rows, columns))
    keep = rng.random((rows, columns)) < density
    keep[np.arange(rows), rng.integers(0, columns, rows)] = True
    return sp.csc_array(matrix * keep)

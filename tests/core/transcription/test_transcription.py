from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from core.hand_built import MASS_KG, Subproblem, vehicle
from core.toy_problems import cart
from numpy.typing import NDArray
from oracles.powered_descent_physics import state_rate

from dscp_core import problems
from dscp_core.cone.program import ConeProgram, ConeValues
from dscp_core.planning.planner import Planner
from dscp_core.problem.declaration import CostTerm, Variable, Where
from dscp_core.problem.parameters import Value
from dscp_core.scp.scp import Scp, ScpOptions, ScpStatus
from dscp_core.transcription.transcription import Transcription

Array = NDArray[np.float64]

INTERVALS = 5
CASES = [
    (formulation, free)
    for formulation in problems.formulations("powered_descent")
    for free in (False, True)
]


class Case:
    """A transcription at a random reference and random parameters, no weight of which is zero."""

    def __init__(self, formulation: str, free: bool) -> None:
        self.printed, self.free = formulation == "printed", free
        problem = problems.get("powered_descent", formulation)
        self.transcription = Transcription(problem, INTERVALS, free_terminal_time=free)
        rng = np.random.default_rng(11)
        changes: dict[str, Value] = {
            "terminal_time": 30.0,
            "gate_height": 4.0,
            "contact_tilt_max": 0.3,
            "thrust_rate_max": 1e5,  # means that are held have none
            "final_position": [20.0, -30.0, 10.0],
            "final_velocity": [-1.0, 2.0, 0.5],
            "time_weight": 30.0,
            "trust_region_state": rng.uniform(0.1, 1.0, 7),
            "trust_region_control": rng.uniform(0.1, 1.0, 3),
            "trust_region_step": 0.7,
        }
        if not self.printed:
            changes["thrust_prox"] = 0.3
        self.parameters = problem.table.pack(changes)
        self.parameters *= 1.0 + 0.02 * rng.standard_normal(self.parameters.size)
        guess = self.transcription.initial_guess(self.parameters)
        self.reference = guess * (1.0 + 0.1 * rng.standard_normal(guess.size))
        self.rng = rng

    @property
    def joint(self) -> Array:
        return np.concatenate([self.reference, self.parameters])

    def split(self, joint: Array) -> tuple[Array, Array]:
        size = self.reference.size
        return joint[:size], joint[size:]

    def directions(self, count: int) -> Array:
        """Random directions of (reference, parameters), in proportion to the parameters."""
        size = self.parameters.size
        sizes = np.concatenate([np.ones(self.reference.size), np.maximum(self.parameters, 1e-3)])
        assert sizes.size == self.reference.size + size
        return np.asarray(self.rng.standard_normal((count, sizes.size)) * sizes)


@pytest.fixture(scope="module", params=CASES, ids=lambda c: f"{c[0]}-{'free' if c[1] else 'fixed'}")
def case(request: pytest.FixtureRequest) -> Case:
    return Case(*request.param)


def slope(function: Callable[[Array], Array], at: Array, direction: Array) -> Array:
    """Central difference along a direction, extrapolated once: the error is of fourth order."""

    def difference(step: float) -> Array:
        return (function(at + step * direction) - function(at - step * direction)) / (2 * step)

    return (4 * difference(5e-4) - difference(1e-3)) / 3


def close(actual: Array, expected: Array, tolerance: float) -> None:
    scale = max(1.0, float(np.abs(expected).max(initial=0.0)))
    np.testing.assert_allclose(actual, expected, rtol=0.0, atol=tolerance * scale)


def test_subproblem_matches_the_one_built_by_hand(case: Case) -> None:
    transcription = case.transcription
    layout, pattern = transcription.layout, transcription.pattern
    values = transcription.values(case.reference, case.parameters)
    by_hand = Subproblem(
        layout.states(case.reference),
        layout.controls(case.reference),
        transcription.terminal_time(case.reference, case.parameters),
        transcription.table.unpack(case.parameters),
        transcription.problem.cost_scale,
        free=case.free,
    ).build(printed=case.printed)
    upper = pattern.q.matrix(values.q).toarray()
    # Both are sums of a few products of rounded numbers of the same size.
    close(upper, np.triu(by_hand.Q), 1e-13)
    close(values.c, by_hand.c, 1e-13)
    close(pattern.a.matrix(values.a).toarray(), by_hand.A, 1e-13)
    close(values.b, by_hand.b, 1e-13)
    close(pattern.g.matrix(values.g).toarray(), by_hand.G, 1e-13)
    close(values.h, by_hand.h, 1e-13)


def test_cones_are_declared_in_the_order_of_the_rows(case: Case) -> None:
    pattern, nodes = case.transcription.pattern, INTERVALS + 1
    times = 2 * int(case.free)
    if case.printed:
        assert pattern.n_nonnegative == times + 2 * nodes + 1
        assert pattern.soc_dims == (3,) * (2 * nodes - 2)
    else:
        assert pattern.n_nonnegative == times + nodes + INTERVALS + 1
        assert pattern.soc_dims == (4,) * nodes + (3,) * (2 * nodes - 2)


def test_subproblem_is_a_valid_convex_program(case: Case) -> None:
    pattern = case.transcription.pattern
    values = case.transcription.values(case.reference, case.parameters)
    ConeProgram(pattern, values)
    upper = pattern.q.matrix(values.q).toarray()
    eigenvalues = np.linalg.eigvalsh(upper + np.triu(upper, 1).T)
    # Rounding of the largest eigenvalue, 1e3 to 1e5.
    assert eigenvalues.min() > -1e-9


def test_evaluation_matches_the_hand_written_dynamics(case: Case) -> None:
    transcription, layout = case.transcription, case.transcription.layout
    states, controls = layout.states(case.reference), layout.controls(case.reference)
    time_s = transcription.terminal_time(case.reference, case.parameters)
    values = transcription.table.unpack(case.parameters)
    evaluation = transcription.evaluate(case.reference, case.parameters)
    means = (states[1:] + states[:-1]) / 2, (controls[1:] + controls[:-1]) / 2
    rates = np.array([state_rate(x, u, vehicle(values)) for x, u in zip(*means, strict=True)])
    close(evaluation.defects, np.diff(states, axis=0) - time_s / INTERVALS * rates, 1e-12)
    cost = values["time_weight"] * time_s - values["fuel_weight"] * states[-1, 6]
    assert evaluation.cost == pytest.approx(cost, rel=1e-13)
    assert (time_s == values["terminal_time"]) is not case.free


def test_linearisation_point_leaves_the_defects(case: Case) -> None:
    # A z_ref - b is the defect of the reference, up to its virtual control.
    pattern, layout = case.transcription.pattern, case.transcription.layout
    values = case.transcription.values(case.reference, case.parameters)
    z = np.concatenate([case.reference, np.zeros(layout.size - case.reference.size)])
    residual = pattern.a.matrix(values.a) @ z - values.b
    defects = case.transcription.evaluate(case.reference, case.parameters).defects
    rows = residual[: INTERVALS * 7].reshape(INTERVALS, 7) * layout.state_scale
    close(rows, defects, 1e-12)


def test_pushforward_matches_differences(case: Case) -> None:
    def flat(joint: Array) -> Array:
        return case.transcription.values(*case.split(joint)).to_flat()

    for direction in case.directions(3):
        pushed = case.transcription.values_pushforward(
            case.reference, case.parameters, *case.split(direction)
        )
        # Rounding 1e-16/1e-3, and a fourth-order remainder of 1e-13 times high derivatives.
        close(pushed.to_flat(), slope(flat, case.joint, direction), 1e-8)


def test_pullback_is_the_transpose_of_the_pushforward(case: Case) -> None:
    pattern = case.transcription.pattern
    for direction in case.directions(5):
        cotangent = case.rng.standard_normal(pattern.n_values)
        pushed = case.transcription.values_pushforward(
            case.reference, case.parameters, *case.split(direction)
        ).to_flat()
        pulled = np.concatenate(
            case.transcription.values_pullback(
                case.reference, case.parameters, ConeValues.from_flat(pattern, cotangent)
            )
        )
        # Rounding of sums of a thousand terms.
        size = np.abs(cotangent * pushed).sum()
        assert abs(cotangent @ pushed - pulled @ direction) < 1e-13 * size


def test_pullback_matches_differences(case: Case) -> None:
    pattern = case.transcription.pattern
    values = case.transcription.values(case.reference, case.parameters).to_flat()
    # Every value counts alike, whatever its size.
    cotangent = case.rng.standard_normal(pattern.n_values) / np.maximum(1.0, np.abs(values))

    def product(joint: Array) -> Array:
        return np.array([cotangent @ case.transcription.values(*case.split(joint)).to_flat()])

    pulled = np.concatenate(
        case.transcription.values_pullback(
            case.reference, case.parameters, ConeValues.from_flat(pattern, cotangent)
        )
    )
    # One component at a time, of the reference and of the parameters.
    sizes = np.concatenate([np.ones(case.reference.size), np.maximum(case.parameters, 1e-3)])
    for index in range(pulled.size):
        direction = np.zeros(pulled.size)
        direction[index] = sizes[index]
        expected = slope(product, case.joint, direction)[0]
        # Rounding of a sum of terms of size 1 over the step, and a fourth-order remainder.
        assert pulled[index] * sizes[index] == pytest.approx(expected, rel=1e-8, abs=1e-8)


def test_cost_gradient_matches_differences(case: Case) -> None:
    def cost(joint: Array) -> Array:
        return np.array([case.transcription.evaluate(*case.split(joint)).cost])

    gradient = np.concatenate(case.transcription.cost_gradient(case.reference, case.parameters))
    for direction in case.directions(3):
        # Bilinear in reference and weights: only rounding of 3e4 kg over the step is left.
        assert gradient @ direction == pytest.approx(
            slope(cost, case.joint, direction)[0], rel=1e-9
        )


def test_derivatives_of_the_initial_guess(case: Case) -> None:
    transcription, parameters = case.transcription, case.parameters
    for _ in range(3):
        direction = case.rng.standard_normal(parameters.size) * np.maximum(parameters, 1e-3) * 0.1
        pushed = transcription.initial_guess_pushforward(parameters, direction)
        # Far from the kinks of the projection onto the thrust bounds; as for the values.
        close(pushed, slope(transcription.initial_guess, parameters, direction), 1e-8)
        seed = case.rng.standard_normal(pushed.size)
        pulled = transcription.initial_guess_pullback(parameters, seed)
        size = np.abs(seed * pushed).sum()
        assert abs(seed @ pushed - pulled @ direction) < 1e-13 * size


def test_layout_is_a_bijection(case: Case) -> None:
    layout = case.transcription.layout
    states, controls = layout.states(case.reference), layout.controls(case.reference)
    time_s = case.transcription.terminal_time(case.reference, case.parameters)
    close(layout.reference(states, controls, time_s), case.reference, 1e-15)
    virtual = np.zeros((INTERVALS, 7))
    virtual[:, layout.virtual_states] = case.rng.standard_normal(
        (INTERVALS, layout.virtual_states.size)
    )
    decision = np.concatenate([case.reference, layout.virtual_part(virtual)])
    assert decision.size == layout.size == case.transcription.pattern.n
    close(layout.virtual_control(decision), virtual, 1e-15)
    assert decision[layout.state_index(3, 6)] * MASS_KG == pytest.approx(states[3, 6])
    assert decision[layout.control_index(2, 1)] == pytest.approx(
        controls[2, 1] / layout.control_scale[1]
    )


def test_mean_and_node_terms_meet_where_they_share_entries() -> None:
    # Every sum of squares below contributes to the same entries of Q: duplicates must add up.
    terms = (
        CostTerm("node", lambda at, ref, p: (at.u[0] - ref.u[0]) ** 2, Where.NODE),
        CostTerm("again", lambda at, ref, p: 2 * (at.u[0] - ref.u[0]) ** 2, Where.NODE),
        CostTerm("mean", lambda at, ref, p: 4 * (at.u[0] - ref.u[0]) ** 2, Where.MEAN),
    )
    problem = replace(cart(), running_cost=None, cost_terms=terms)
    transcription = Transcription(problem, 3)
    parameters = problem.table.pack()
    values = transcription.values(transcription.initial_guess(parameters), parameters)
    upper = transcription.pattern.q.matrix(values.q).toarray()
    forces = [transcription.layout.control_index(n, 0) for n in range(4)]
    block = upper[np.ix_(forces, forces)]
    # Second derivative 2 * 3 at a node; 8 / 4 per mean, shared by two nodes; scale 3^2 / 2.
    expected = np.diag([8.0, 10.0, 10.0, 8.0]) + np.diag([2.0] * 3, 1)
    close(block, expected * 3.0**2 / 2.0, 1e-14)


@pytest.mark.parametrize(
    ("length", "speed", "mass", "thrust"),
    [(1000.0, 100.0, 1.0e4, 1.0e5), (20000.0, 60.0, 60000.0, 1.0e6)],
)
def test_optimum_does_not_depend_on_the_scales(
    length: float, speed: float, mass: float, thrust: float
) -> None:
    problem = problems.get("powered_descent")
    options = ScpOptions(cost_tolerance=1e-11)

    def optimum(states: tuple[Variable, ...], controls: tuple[Variable, ...]) -> Array:
        scaled = replace(problem, states=states, controls=controls)
        transcription = Transcription(scaled, 20)
        result = Scp(transcription, options).run(scaled.table.pack())
        assert result.status is ScpStatus.CONVERGED, result.message
        return transcription.layout.states(result.final_reference)

    declared = optimum(problem.states, problem.controls)
    scales = (length,) * 3 + (speed,) * 3 + (mass,)
    other = optimum(
        tuple(replace(s, scale=v) for s, v in zip(problem.states, scales, strict=True)),
        tuple(replace(c, scale=thrust) for c in problem.controls),
    )
    # Metres, metres per second and kilograms. The solver's 1e-10 leaves 1e-4 kg because the
    # virtual control is relaxed; positions hang on directions of little curvature.
    assert abs(other[-1, 6] - declared[-1, 6]) < 1e-3
    np.testing.assert_allclose(other[:, :6], declared[:, :6], rtol=0.0, atol=0.05)


def test_free_time_has_no_effect_on_a_fixed_problem_but_through_the_decision() -> None:
    # With the terminal time pinned by its bounds, the free problem is the fixed one.
    problem = problems.get("powered_descent")
    pinned = {"terminal_time_min": 32.9, "terminal_time_max": 32.9, "terminal_time": 32.9}
    masses = []
    for free in (False, True):
        transcription = Transcription(problem, 20, free_terminal_time=free)
        result = Scp(transcription, ScpOptions()).run(problem.table.pack(pinned))
        assert result.status is ScpStatus.CONVERGED, result.message
        masses.append(transcription.layout.states(result.final_reference)[-1, 6])
    # kg; the solver's 1e-10 of 38 t.
    assert masses[1] == pytest.approx(masses[0], abs=1e-4)


def test_without_time_bounds_those_of_the_parameter_count() -> None:
    transcription = Transcription(cart(), 4, free_terminal_time=True)
    parameters = transcription.table.pack()
    reference = transcription.initial_guess(parameters)
    assert transcription.pattern.n_cone_rows == 2 + 2 * 5
    groups = transcription.values(reference, parameters).h[:2] * transcription.layout.time_scale
    np.testing.assert_allclose(groups, [-0.1, 10.0])
    # Less effort takes longer, without end: the bound is where it stops.
    planner = Planner(cart(), intervals=10, terminal_time="free")
    assert planner.plan().terminal_time_used_s == pytest.approx(10.0, abs=1e-5)
    assert transcription.terminal_time(reference, parameters) == 2.0
    assert ca.DM(reference).shape == (1 + 5 * 3, 1)


def test_trust_region_per_second_grows_with_the_interval() -> None:
    weighted = replace(cart(), trust_region_state=(3.0, 0.0), trust_region_control=(5.0,))
    nodal, timed = (
        Transcription(p, 4) for p in (weighted, replace(weighted, trust_region_per_second=True))
    )
    parameters = nodal.table.pack()
    reference = nodal.initial_guess(parameters)
    without = Transcription(cart(), 4).values(reference, cart().table.pack()).q
    per_node = nodal.values(reference, parameters).q - without
    per_second = timed.values(reference, parameters).q - without
    step = 2.0 / 4
    assert per_node.max() == pytest.approx(10.0)
    np.testing.assert_allclose(per_second, step * per_node, rtol=1e-12, atol=1e-12)
    assert {timed.table[n].unit for n in ("trust_region_state", "trust_region_control")} == {"1/s"}

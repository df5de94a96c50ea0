from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from core.toy_problems import cart, effort_of, free_cart, least_effort
from numpy.typing import NDArray

from dscp_core import problems
from dscp_core.cone.program import SolveStatus
from dscp_core.cone.solvers import SolverSettings
from dscp_core.errors import InvalidInputError
from dscp_core.scp.scp import Scp, ScpOptions, ScpResult, ScpStatus, StoppingRule, objective
from dscp_core.transcription.transcription import Transcription

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def scp() -> Scp:
    return Scp(Transcription(problems.get("powered_descent"), 50))


@pytest.fixture(scope="module")
def nominal(scp: Scp) -> ScpResult:
    return scp.run(packed(scp))


def packed(scp: Scp, **values: Any) -> Array:
    return scp.transcription.table.pack(values)


def final_mass_kg(scp: Scp, result: ScpResult) -> float:
    return float(scp.transcription.layout.states(result.final_reference)[-1, 6])


def test_linear_quadratic_problem_needs_one_step() -> None:
    transcription = Transcription(free_cart(), 8)
    result = Scp(transcription).run(transcription.table.pack())
    assert result.status is ScpStatus.CONVERGED
    # The second iteration only confirms the first.
    assert len(result.iterations) == 2
    forces = transcription.layout.controls(result.final_reference)[:, 0]
    # The solver's tolerance of 1e-10 on forces of size 1.
    np.testing.assert_allclose(forces, least_effort(8, 2.0, 1.5), rtol=0.0, atol=1e-8)
    assert result.iterations[-1].cost == pytest.approx(effort_of(forces, 2.0), rel=1e-12)


def test_converges(scp: Scp, nominal: ScpResult) -> None:
    assert nominal.status is ScpStatus.CONVERGED
    assert nominal.succeeded
    assert len(nominal.iterations) <= 10
    assert nominal.failed is None
    assert f"{len(nominal.iterations)} iterations" in nominal.message
    scale = scp.transcription.layout.state_scale
    last = nominal.iterations[-1]
    assert np.max(np.abs(last.defects) / scale) < 1e-6
    assert np.max(np.abs(last.virtual_control) / scale) < 1e-6


def test_tolerances_are_the_problems_unless_given(scp: Scp) -> None:
    assert (scp.cost_tolerance, scp.defect_tolerance) == (1e-8, 1e-6)
    loose = Scp(Transcription(replace(cart(), cost_tolerance=1e-2, defect_tolerance=1e-1), 8))
    assert (loose.cost_tolerance, loose.defect_tolerance) == (1e-2, 1e-1)
    strict = loose.with_options(cost_tolerance=1e-9, defect_tolerance=1e-9)
    assert (strict.cost_tolerance, strict.defect_tolerance) == (1e-9, 1e-9)
    parameters = loose.transcription.table.pack()
    assert len(loose.run(parameters).iterations) < len(strict.run(parameters).iterations)


def test_small_costs_are_judged_by_the_declared_magnitude() -> None:
    # The cart's cost is 0.4: in units of 1000 every change of it is small.
    coarse = Scp(Transcription(replace(cart(), cost_magnitude=1000.0), 8))
    fine = Scp(Transcription(cart(), 8))
    parameters = fine.transcription.table.pack()
    options = {"cost_tolerance": 1e-3, "defect_tolerance": 1.0}
    counts = [len(s.with_options(**options).run(parameters).iterations) for s in (coarse, fine)]
    assert counts[0] == 2  # the least
    assert counts[1] > counts[0]


def test_the_papers_rule_looks_at_the_cost_alone() -> None:
    scp = Scp(Transcription(cart(), 8))
    parameters = scp.transcription.table.pack()
    by_rule = scp.with_options(stopping=StoppingRule.COST_CHANGE, cost_tolerance=1e-2)
    result = by_rule.run(parameters)
    assert result.status is ScpStatus.CONVERGED
    costs = [i.cost for i in result.iterations]
    assert abs(costs[-1] - costs[-2]) < 1e-2 * costs[-2]
    assert all(abs(b - a) >= 1e-2 * a for a, b in itertools.pairwise(costs[:-1]))
    # The first change is that from the reference it started from.
    again = by_rule.run(parameters, result.final_reference)
    assert len(again.iterations) == 1


@pytest.mark.parametrize("terminal_time", [31.0, 31.9, 32.0, 32.04])
def test_infeasible_terminal_time(scp: Scp, terminal_time: float) -> None:
    # The least feasible time is 32.0487 s.
    result = scp.run(packed(scp, terminal_time=terminal_time))
    assert result.status is ScpStatus.INFEASIBLE
    assert not result.succeeded
    assert "virtual control" in result.message
    last = result.iterations[-1]
    # The dynamics hold but for the virtual control, which is what is left of infeasibility.
    scale = scp.transcription.layout.state_scale
    assert np.max(np.abs(last.defects - last.virtual_control) / scale) < 1e-6
    assert np.max(np.abs(last.virtual_control) / scale) > 1e-5


def test_stationary_is_not_feasible(scp: Scp) -> None:
    # From its own end, an infeasible run is stationary at once, and as infeasible as before.
    parameters = packed(scp, terminal_time=31.0)
    end = scp.run(parameters).final_reference
    result = scp.with_options(cost_tolerance=1e-4).run(parameters, end)
    assert result.status is ScpStatus.INFEASIBLE
    assert len(result.iterations) == 1


def test_shortest_times_are_feasible(scp: Scp) -> None:
    for terminal_time in (32.06, 32.1):
        result = scp.run(packed(scp, terminal_time=terminal_time))
        assert result.status is ScpStatus.CONVERGED, result.message


def test_iteration_limit(scp: Scp) -> None:
    result = scp.with_options(max_iterations=3).run(packed(scp))
    assert result.status is ScpStatus.ITERATION_LIMIT
    assert len(result.iterations) == 3
    assert not result.succeeded


def test_subproblem_infeasible() -> None:
    # One metre in 0.3 s needs more force than the cart has, and it has no virtual control.
    transcription = Transcription(cart(), 8)
    result = Scp(transcription).run(transcription.table.pack({"terminal_time": 0.3}))
    assert result.status is ScpStatus.SUBPROBLEM_INFEASIBLE
    assert result.iterations == ()
    assert result.failed is not None
    assert result.failed.status is SolveStatus.INFEASIBLE
    assert result.message.startswith("iteration 1: ")
    np.testing.assert_array_equal(result.final_reference, result.initial_reference)


def test_unbounded_subproblem_is_a_failure() -> None:
    problem = replace(
        cart(),
        running_cost=None,
        path_constraints=(),
        terminal_cost=lambda x, time, p: -x[0],
        final_state={"speed": lambda p: p["target"][1]},
    )
    transcription = Transcription(problem, 4)
    result = Scp(transcription).run(transcription.table.pack())
    assert result.status is ScpStatus.SOLVER_FAILURE
    assert result.failed is not None
    assert result.failed.status is SolveStatus.UNBOUNDED
    assert "unbounded" in result.message


def test_solver_failure_keeps_the_answer(scp: Scp) -> None:
    options = {"solver": "qoco,clarabel", "solver_settings": SolverSettings(max_iterations=2)}
    result = scp.with_options(**options).run(packed(scp))
    assert result.status is ScpStatus.SOLVER_FAILURE
    assert result.failed is not None
    assert result.failed.status is SolveStatus.ITERATION_LIMIT
    assert result.failed.solver == "clarabel"
    assert [attempt.solver for attempt in result.failed.attempts] == ["qoco"]
    assert "iteration limit" in result.message


def test_no_time_at_all(scp: Scp) -> None:
    result = scp.with_options(deadline_s=1e-9).run(packed(scp))
    assert result.status is ScpStatus.DEADLINE
    assert result.iterations == ()
    assert not result.succeeded


def test_deadline_keeps_what_is_done(scp: Scp) -> None:
    ticks = iter(range(10**6))
    # A clock that only moves when it is read: one iteration reads it a fixed number of times.
    ticking = Scp(scp.transcription, ScpOptions(deadline_s=15.0), lambda: 1.0 * next(ticks))
    result = ticking.run(packed(scp))
    assert result.status is ScpStatus.DEADLINE
    assert 1 <= len(result.iterations) < 6
    done = result.iterations[-1].solution.z[: result.initial_reference.size]
    np.testing.assert_array_equal(result.final_reference, done)


@pytest.mark.parametrize(
    ("deadline_s", "status"), [(3.5, ScpStatus.DEADLINE), (60.0, ScpStatus.SOLVER_FAILURE)]
)
def test_a_solver_that_fails_when_the_time_is_over(
    scp: Scp, deadline_s: float, status: ScpStatus
) -> None:
    ticks = iter(range(10**6))
    settings = SolverSettings(max_iterations=2)
    options = ScpOptions(deadline_s=deadline_s, solver_settings=settings)
    failing = Scp(scp.transcription, options, lambda: 1.0 * next(ticks))
    assert failing.run(packed(scp)).status is status


def test_fixed_number_of_iterations(scp: Scp, nominal: ScpResult) -> None:
    for count in (1, 4, len(nominal.iterations) + 2):
        result = scp.with_options(fixed_iterations=count).run(packed(scp))
        assert result.status is ScpStatus.FIXED_ITERATIONS
        assert len(result.iterations) == count
        for here, there in zip(result.iterations, nominal.iterations, strict=False):
            # Backends keep scalings between runs, so that nearly undetermined thrusts differ by
            # 1e-5, but the cost only by the solver's tolerance of 1e-10.
            assert here.cost == pytest.approx(there.cost, rel=1e-8)


def test_fixed_number_wins_over_convergence_and_limit(scp: Scp) -> None:
    result = scp.with_options(fixed_iterations=12, max_iterations=2).run(packed(scp))
    assert len(result.iterations) == 12


def test_warm_start_at_the_optimum_confirms_it(scp: Scp, nominal: ScpResult) -> None:
    result = scp.run(packed(scp), nominal.final_reference)
    assert result.status is ScpStatus.CONVERGED
    assert result.warm_started
    assert not nominal.warm_started
    assert len(result.iterations) == 1
    np.testing.assert_array_equal(result.initial_reference, nominal.final_reference)
    # kg; the cost tolerance of 1e-8 of 32 t.
    assert final_mass_kg(scp, result) == pytest.approx(final_mass_kg(scp, nominal), abs=3e-4)


def test_warm_start_nearby_saves_iterations(scp: Scp, nominal: ScpResult) -> None:
    changed = packed(scp, terminal_time=32.9, initial_position=(4990.0, 505.0, 495.0))
    cold, warm = scp.run(changed), scp.run(changed, nominal.final_reference)
    assert cold.status is warm.status is ScpStatus.CONVERGED
    assert len(warm.iterations) < len(cold.iterations)
    assert final_mass_kg(scp, warm) == pytest.approx(final_mass_kg(scp, cold), abs=3e-4)


def test_trace_is_consistent(scp: Scp, nominal: ScpResult) -> None:
    transcription = scp.transcription
    layout, pattern = transcription.layout, transcription.pattern
    reference, previous_mass = nominal.initial_reference, None
    np.testing.assert_array_equal(reference, transcription.initial_guess(nominal.parameters))
    for iteration in nominal.iterations:
        np.testing.assert_array_equal(iteration.reference, reference)
        values = transcription.values(reference, nominal.parameters)
        np.testing.assert_array_equal(iteration.values.to_flat(), values.to_flat())
        z = iteration.solution.z
        evaluation = transcription.evaluate(z[: reference.size], nominal.parameters)
        assert iteration.cost == evaluation.cost
        np.testing.assert_array_equal(iteration.defects, evaluation.defects)
        np.testing.assert_array_equal(iteration.virtual_control, layout.virtual_control(z))
        # Powered descent's virtual control is in m/s, its weight in kg per squared m/s.
        weight = transcription.table.unpack(nominal.parameters)["virtual_control_weight"]
        penalty = weight * np.sum(iteration.virtual_control**2)
        scaled = (iteration.cost + penalty) / transcription.problem.cost_scale
        assert iteration.penalised_cost == pytest.approx(scaled, rel=1e-13)
        upper = pattern.q.matrix(values.q).toarray()
        full = upper + np.triu(upper, 1).T

        def cost_of(point: Array, full: Array = full, linear: Array = values.c) -> float:
            return float(point @ full @ point / 2 + linear @ point)

        # The virtual control that the reference would need has the size of its defects.
        defects = transcription.evaluate(reference, nominal.parameters).defects
        start = np.concatenate([reference, layout.virtual_part(defects)])
        predicted = cost_of(z) - cost_of(start)
        # Rounding of the quadratic terms, 1e3 scaled and more with virtual control.
        size = abs(cost_of(z)) + abs(cost_of(start)) + float(np.abs(full @ z) @ np.abs(z))
        assert iteration.predicted_change == pytest.approx(predicted, abs=1e-12 * size)
        assert iteration.assembly_seconds > 0.0
        assert iteration.solve_seconds > 0.0
        assert iteration.polish_seconds >= 0.0
        assert previous_mass != iteration.cost
        reference, previous_mass = z[: reference.size], iteration.cost
    np.testing.assert_array_equal(nominal.final_reference, reference)
    parts = sum(i.assembly_seconds + i.solve_seconds + i.polish_seconds for i in nominal.iterations)
    assert parts <= nominal.seconds


def test_objective_counts_both_halves_of_the_matrix(scp: Scp, nominal: ScpResult) -> None:
    pattern, iteration = scp.transcription.pattern, nominal.iterations[0]
    upper = pattern.q.matrix(iteration.values.q).toarray()
    z = np.random.default_rng(1).standard_normal(pattern.n)
    expected = z @ (upper + np.triu(upper, 1).T) @ z / 2 + iteration.values.c @ z
    assert objective(pattern, iteration.values, z) == pytest.approx(expected, rel=1e-12)


def test_run_leaves_its_arguments_alone(scp: Scp) -> None:
    parameters = packed(scp)
    reference = scp.transcription.initial_guess(parameters)
    kept = parameters.copy(), reference.copy()
    result = scp.with_options(fixed_iterations=2).run(parameters, reference)
    np.testing.assert_array_equal(parameters, kept[0])
    np.testing.assert_array_equal(reference, kept[1])
    parameters[:] = 0.0
    np.testing.assert_array_equal(result.parameters, kept[0])


@pytest.mark.parametrize("solver", ["qoco", "clarabel", "ecos"])
def test_every_backend_finds_the_optimum(scp: Scp, solver: str) -> None:
    transcription = Transcription(problems.get("powered_descent"), 20)
    default = Scp(transcription)
    other = Scp(transcription, ScpOptions(solver=solver))
    expected, result = default.run(packed(default)), other.run(packed(other))
    assert result.status is ScpStatus.CONVERGED, result.message
    assert {iteration.solution.solver for iteration in result.iterations} == {solver}
    # kg; the cost tolerance of 1e-8 of 32 t.
    assert final_mass_kg(other, result) == pytest.approx(final_mass_kg(default, expected), abs=3e-4)


def test_polished_iterates_are_closer_to_optimal(scp: Scp) -> None:
    def worst(polish: bool) -> float:
        options = {"fixed_iterations": 4, "polish": polish, "solver": "clarabel"}
        result = scp.with_options(**options).run(packed(scp, terminal_time=33.5))
        solutions = [iteration.solution for iteration in result.iterations]
        return max(max(s.primal_residual, s.dual_residual, s.gap) for s in solutions)

    # Newton's method ends at rounding, an interior-point method at its tolerance of 1e-10.
    assert worst(polish=True) < 0.1 * worst(polish=False)


def test_options_for_gradients() -> None:
    options = ScpOptions.for_gradients(max_iterations=7)
    assert options.polish
    assert options.max_iterations == 7
    assert options.solver_settings.tolerance < ScpOptions().solver_settings.tolerance


@pytest.mark.parametrize(
    ("reference", "bound"),
    [(np.zeros(3), "shape"), (np.zeros((2, 2)), "shape"), ("nan", "finite"), ("inf", "finite")],
    ids=["length", "dimensions", "nan", "inf"],
)
def test_bad_initial_reference(scp: Scp, reference: Any, bound: str) -> None:
    if isinstance(reference, str):
        value = float(reference)
        reference = scp.transcription.initial_guess(packed(scp))
        reference[7] = value
    with pytest.raises(InvalidInputError, match="initial_reference") as caught:
        scp.run(packed(scp), reference)
    assert bound in caught.value.bound


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("cost_tolerance", 0.0),
        ("defect_tolerance", -1e-6),
        ("virtual_control_tolerance", float("nan")),
        ("max_iterations", 0),
        ("fixed_iterations", 0),
        ("deadline_s", 0.0),
        ("deadline_s", float("nan")),
    ],
)
def test_bad_options(scp: Scp, name: str, value: float) -> None:
    with pytest.raises(InvalidInputError, match=name):
        scp.with_options(**{name: value})


def test_unknown_solver(scp: Scp) -> None:
    with pytest.raises(InvalidInputError, match="mosek"):
        scp.with_options(solver="qoco,mosek")


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("max_iterations", 2.5),
        ("max_iterations", "3"),
        ("fixed_iterations", True),
        ("cost_tolerance", float("inf")),
        ("defect_tolerance", "small"),
        ("stopping", "soon"),
    ],
)
def test_options_of_another_kind_are_refused(option: str, value: object) -> None:
    with pytest.raises(InvalidInputError) as caught:
        ScpOptions(**{option: value})  # type: ignore[arg-type]
    assert caught.value.field == option


def test_a_stopping_rule_by_its_name_is_that_rule() -> None:
    assert ScpOptions(stopping="cost_change").stopping is StoppingRule.COST_CHANGE  # type: ignore[arg-type]

"""Gradients by name of plans that were made, against differences of whole plans."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from core.toy_problems import cart
from core.whole_runs import difference

from dscp_core import (
    ConvergenceLoss,
    CostLoss,
    DifferentiationError,
    FinalStateLoss,
    InvalidInputError,
    Method,
    OptimalControlProblem,
    Planner,
    PlannerSettings,
    PlanOutcome,
    ScpOptions,
    TerminalTime,
    problems,
)

PROBLEMS = {
    "powered_descent": problems.get("powered_descent"),
    "entry": problems.get("entry"),
    "cart": replace(cart(), initial_state_parameters=("start",)),
}
# Iterated far beyond the usual test of convergence, so that differences are those of the optimum.
TIGHT = ScpOptions.for_gradients(fixed_iterations=40)


@pytest.fixture(scope="module")
def planners() -> dict[str, Planner]:
    return {name: Planner(problem) for name, problem in PROBLEMS.items()}


def optimum(problem: OptimalControlProblem, of: str, **changes: object) -> float:
    """Cost or final state of a whole plan."""
    settings = PlannerSettings.suited(problem, options=TIGHT)
    outcome = Planner(problem, settings, parameters=changes).plan()  # type: ignore[arg-type]
    assert outcome.plan is not None, outcome.headline
    if of == "cost":
        return outcome.cost
    return float(outcome.plan.states[-1, outcome.plan.state_names.index(of)])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "of", "parameter", "component", "step"),
    [
        ("powered_descent", "cost", "specific_impulse", 0, 0.05),
        ("powered_descent", "cost", "terminal_time", 0, 2e-3),
        ("powered_descent", "cost", "initial_velocity", 1, 0.02),
        ("powered_descent", "mass", "initial_mass", 0, 5.0),
        ("entry", "cost", "surface_to_mass_ratio", 0, 1e-3),
        ("entry", "cost", "initial_flight_path_angle", 0, 1e-5),
        ("entry", "cost", "drag_coefficients", 0, 3e-6),
        ("cart", "cost", "drag", 0, 1e-3),
        ("cart", "cost", "start", 0, 1e-3),
        ("cart", "cost", "target", 1, 1e-3),
        ("cart", "cost", "force_max", 0, 1e-4),
    ],
)
def test_a_gradient_is_the_difference_of_whole_plans(
    planners: dict[str, Planner], name: str, of: str, parameter: str, component: int, step: float
) -> None:
    planner = planners[name]
    gradient = planner.gradient(of)
    assert gradient.trusted, gradient.reasons
    assert gradient.converged
    declared = planner.problem.table[parameter]

    def whole(change: float) -> float:
        value = np.atleast_1d(np.array(declared.default, dtype=float))
        value[component] += change
        changed = value if declared.is_vector else float(value[0])
        return optimum(planner.problem, of, **{parameter: changed})

    found = np.atleast_1d(gradient[parameter])[component]
    # The penalty's virtual control is in what is differentiated, and in no plan: 4e-5 kg/s of the
    # slope by the terminal time, which goes from -67 to 67 kg/s within a second of the optimum.
    bias = 1e-4 if parameter == "terminal_time" else 0.0
    assert found == pytest.approx(difference(whole, step), rel=1e-5, abs=bias)


def test_names_give_floats_and_vectors(planners: dict[str, Planner]) -> None:
    gradient = planners["powered_descent"].gradient("cost")
    assert isinstance(gradient["specific_impulse"], float)
    velocity = gradient["initial_velocity"]
    assert isinstance(velocity, np.ndarray)
    assert velocity.shape == (3,)
    state = gradient["initial_state"]
    assert isinstance(state, np.ndarray)
    np.testing.assert_array_equal(state[3:6], velocity)
    assert state[6] == gradient["initial_mass"]
    everything = gradient.as_dict()
    assert tuple(everything) == gradient.keys() == tuple(gradient)
    assert all(np.array_equal(everything[name], gradient[name]) for name in gradient)
    with pytest.raises(InvalidInputError, match="specific_impulse"):
        gradient["specific_impuls"]


def test_a_gradient_travels(planners: dict[str, Planner]) -> None:
    gradient = planners["cart"].gradient("cost")
    copy = pickle.loads(pickle.dumps(gradient))
    assert copy["drag"] == gradient["drag"]
    assert copy.headline == gradient.headline


def test_what_is_differentiated_is_said(planners: dict[str, Planner]) -> None:
    descent, entry = planners["powered_descent"], planners["entry"]
    headline = descent.gradient("mass").headline
    assert headline == descent.gradient("final_mass").headline
    assert headline.startswith("gradient of final_mass, mass(t_f) [kg]; implicit")
    assert "terminal time fixed at 32.81 s; run feasible, converged: trusted" in headline
    assert "terminal time free" in entry.gradient("cost").headline
    metric = descent.gradient("convergence")
    assert metric.method is Method.UNROLLED
    assert metric.headline.startswith("gradient of convergence, sum |J_k - J_K| [kg]; unrolled, 7")
    assert descent.gradient(ConvergenceLoss()).value == metric.value
    weighted = descent.gradient(FinalStateLoss("mass", -2.0))
    assert weighted.of.name == "-2 * final_mass"
    assert weighted["initial_mass"] == -2.0 * descent.gradient("mass")["initial_mass"]
    with pytest.raises(InvalidInputError, match="did you mean final_mass"):
        descent.gradient("final_mas")
    with pytest.raises(InvalidInputError, match="final iterate only"):
        descent.gradient("convergence", method=Method.IMPLICIT)


def test_the_optimum_does_not_depend_on_the_way_there(planners: dict[str, Planner]) -> None:
    descent = planners["powered_descent"]
    implicit, unrolled = (
        descent.gradient("cost", method=method) for method in (Method.IMPLICIT, Method.UNROLLED)
    )
    assert np.all(implicit["trust_region_control"] == 0.0)
    assert np.any(unrolled["trust_region_control"] != 0.0)
    assert unrolled["initial_mass"] == pytest.approx(implicit["initial_mass"], rel=1e-6)


def at_other_state(planner: Planner, warm: PlanOutcome | None) -> PlanOutcome:
    state = planner.initial_state.copy()
    state[0] += 20.0
    return planner.plan(state, warm_start=None if warm is None else warm.plan)


@pytest.mark.parametrize("warm", [False, True])
def test_the_gradient_is_that_of_the_plan_it_is_asked_at(
    planners: dict[str, Planner], warm: bool
) -> None:
    descent = planners["powered_descent"]
    outcome = at_other_state(descent, descent.plan() if warm else None)
    assert outcome.warm_started is warm
    gradient = descent.gradient("cost", at=outcome)
    assert gradient.trusted, gradient.reasons
    assert gradient.value == pytest.approx(outcome.cost, rel=1e-7)
    assert gradient["specific_impulse"] != descent.gradient("cost")["specific_impulse"]
    # Another planner of the same problem, for another vehicle: the plan's own vehicle counts.
    other = Planner(descent.problem, parameters={"specific_impulse": 200.0})
    again = other.gradient("cost", at=outcome)
    assert again["specific_impulse"] == gradient["specific_impulse"]
    assert again["specific_impulse"] != other.gradient("cost")["specific_impulse"]


def test_a_predicted_terminal_time_is_held_fixed() -> None:
    class Predictor:
        def predict(self, state: np.ndarray) -> float:
            return 33.5

    settings = PlannerSettings(terminal_time=TerminalTime.PREDICTED)
    planner = Planner(problems.get("powered_descent"), settings, Predictor())
    gradient = planner.gradient("cost")
    assert "terminal time fixed at 33.5 s" in gradient.headline
    fixed = Planner(planner.problem, parameters={"terminal_time": 33.5}).gradient("cost")
    assert gradient["terminal_time"] == pytest.approx(fixed["terminal_time"], rel=1e-6)


def test_plans_of_others_are_refused(planners: dict[str, Planner]) -> None:
    outcome = planners["cart"].plan()
    with pytest.raises(InvalidInputError, match="powered_descent"):
        planners["powered_descent"].gradient("cost", at=outcome)
    coarse = Planner(PROBLEMS["cart"], PlannerSettings.suited(PROBLEMS["cart"], intervals=10))
    with pytest.raises(InvalidInputError, match="10 intervals"):
        coarse.gradient("cost", at=outcome)
    free = PlannerSettings(terminal_time=TerminalTime.FREE)
    descent = Planner(PROBLEMS["powered_descent"], free)
    with pytest.raises(InvalidInputError, match="terminal time free"):
        descent.gradient("cost", at=planners["powered_descent"].plan())


def test_a_method_by_its_name_is_that_method(planners: dict[str, Planner]) -> None:
    planner = planners["cart"]
    outcome = planner.plan()
    for method in Method:
        by_name = planner.gradient("cost", at=outcome, method=method.value)  # type: ignore[arg-type]
        expected = planner.gradient("cost", at=outcome, method=method)
        assert (by_name.method, by_name.iterations) == (method, expected.iterations)
        assert planner.layer("cost", inputs=("start",), method=method.value)._method is method  # type: ignore[arg-type]
    with pytest.raises(InvalidInputError, match="method: got 'adjoint'"):
        planner.gradient("cost", at=outcome, method="adjoint")  # type: ignore[arg-type]


def test_only_outcomes_and_losses_are_differentiated(planners: dict[str, Planner]) -> None:
    planner = planners["cart"]
    with pytest.raises(InvalidInputError, match=r"at: got 'a Plan', expected an outcome of plan"):
        planner.gradient("cost", at=planner.plan().plan)  # type: ignore[arg-type]
    for wrong in (3, None, CostLoss):
        with pytest.raises(InvalidInputError, match=r"quantity: got .*, expected a name or a loss"):
            planner.gradient(wrong)  # type: ignore[arg-type]


def test_without_a_plan_there_is_no_gradient(planners: dict[str, Planner]) -> None:
    descent = planners["powered_descent"]
    state = descent.initial_state.copy()
    state[0] = -100.0
    refused = descent.plan(state)
    with pytest.raises(DifferentiationError, match="invalid state"):
        descent.gradient("cost", at=refused)


def test_a_gradient_without_a_feasible_plan_is_not_trusted() -> None:
    planner = Planner(problems.get("powered_descent"), parameters={"terminal_time": 31.0})
    for method in Method:
        gradient = planner.gradient("cost", method=method)
        assert not gradient.trusted
        assert not gradient.feasible
        assert not gradient.converged
        assert any("no feasible trajectory" in reason for reason in gradient.reasons)
        assert "NOT FEASIBLE, NOT CONVERGED: NOT TRUSTED" in gradient.headline


def test_a_plan_cut_short_is_not_what_is_differentiated() -> None:
    problem = problems.get("entry")
    short = ScpOptions(max_iterations=2)
    planner = Planner(problem, PlannerSettings.suited(problem, options=short))
    outcome = planner.plan()
    assert not outcome.converged
    gradient = planner.gradient("cost", at=outcome)
    assert not gradient.trusted
    assert any("iteration limit" in reason for reason in gradient.reasons)

"""Plans in PyTorch: named tensors in, one loss per sample out, failures visible."""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from core.toy_problems import Array, cart

from dscp_core import (
    InvalidInputError,
    Method,
    Planner,
    PlannerSettings,
    ScpOptions,
    TerminalTime,
    problems,
)
from dscp_core.gradients.samples import SampleReport
from dscp_core.scp.trace import ScpStatus


@pytest.fixture(scope="module")
def descent() -> Planner:
    return Planner(problems.get("powered_descent"), PlannerSettings(intervals=20))


@pytest.fixture(scope="module")
def small() -> Planner:
    problem = replace(cart(), initial_state_parameters=("start",))
    return Planner(problem, PlannerSettings(intervals=6))


def states(planner: Planner, count: int) -> torch.Tensor:
    return torch.tensor(np.tile(planner.initial_state, (count, 1)), requires_grad=True)


@pytest.mark.parametrize("method", list(Method))
def test_named_tensors_in_losses_out(descent: Planner, method: Method) -> None:
    layer = descent.layer("cost", ("initial_state", "terminal_time"), method=method)
    x = states(descent, 2)
    t = torch.tensor([32.81, 34.0], dtype=torch.float64, requires_grad=True)
    loss = layer(initial_state=x, terminal_time=t)
    assert loss.shape == (2,)
    loss.sum().backward()
    assert x.grad is not None
    assert t.grad is not None
    for row, seconds in enumerate((32.81, 34.0)):
        planner = Planner(descent.problem, descent.settings, parameters={"terminal_time": seconds})
        gradient = planner.gradient("cost", method=method)
        assert float(loss[row].detach()) == pytest.approx(gradient.value, rel=1e-7)
        expected = gradient["initial_state"]
        # The fixed point is reached from two sides, to 1e-5 of the states' scales.
        np.testing.assert_allclose(x.grad[row], expected, rtol=1e-3, atol=1e-6)
        assert float(t.grad[row]) == pytest.approx(gradient["terminal_time"], rel=1e-2, abs=1e-4)
        assert layer.samples[row].trusted is gradient.trusted
        assert layer.samples[row].status is ScpStatus.CONVERGED


def test_it_passes_gradcheck(small: Planner) -> None:
    layer = small.layer("cost", ("initial_state", "drag"))
    start = torch.tensor([[0.0, 0.0], [0.05, 0.1]], dtype=torch.float64, requires_grad=True)
    drag = torch.tensor([0.2, 0.4], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda x, d: layer(initial_state=x, drag=d), (start, drag), eps=1e-5, atol=1e-6
    )
    assert all(sample.trusted for sample in layer.samples)


def test_a_failed_sample_is_seen_and_harms_no_other(descent: Planner) -> None:
    layer = descent.layer("mass", ("initial_state", "terminal_time"))
    x = states(descent, 4)
    with torch.no_grad():
        x[2, 0] = -100.0  # below ground
        x[3, 6] = torch.nan
    t = torch.tensor([33.0, 25.0, 33.0, 33.0], dtype=torch.float64, requires_grad=True)
    loss = layer(initial_state=x, terminal_time=t)
    assert torch.isnan(loss).tolist() == [False, True, True, True]
    loss.square().nansum().backward()
    assert x.grad is not None
    assert torch.all(torch.isfinite(x.grad))
    assert torch.all(x.grad[1:] == 0.0)
    assert torch.any(x.grad[0] != 0.0)
    good, infeasible, below, bad = layer.samples
    assert good.usable
    assert good.trusted
    assert (good.certified, good.converged) == (True, True)
    assert 0.0 < good.cost_to_gain < 1.0  # kg
    assert infeasible.status is ScpStatus.INFEASIBLE
    assert below.message.startswith("x: got -100")
    assert "initial_mass" in bad.message
    for sample in (infeasible, below, bad):
        assert not sample.usable
        assert (sample.certified, sample.cost_to_gain) == (None, None)
        assert not sample.converged
        assert sample.trusted is False
        assert sample.reasons[0].startswith("zero gradient: ")


def test_certified_converged_and_stopped_are_three_things(descent: Planner) -> None:
    def sample(iterations: int, **options: Any) -> SampleReport:
        limited = ScpOptions(max_iterations=iterations, **options)
        planner = Planner(descent.problem, descent.settings, options=limited, intervals=50)
        layer = planner.layer("cost", ("terminal_time",), method=Method.UNROLLED)
        layer(terminal_time=torch.tensor([33.0], dtype=torch.float64))
        return layer.samples[0]

    early, later = sample(1), sample(5, cost_tolerance=1e-14)
    assert (early.certified, early.converged) == (False, False)
    assert (later.certified, later.converged) == (True, False)
    assert early.status is later.status is ScpStatus.ITERATION_LIMIT
    assert early.cost_to_gain is not None
    assert later.cost_to_gain is not None
    assert early.cost_to_gain > later.cost_to_gain > 0.0


def test_a_copy_of_a_layer_certifies_too(descent: Planner) -> None:
    layer = pickle.loads(pickle.dumps(descent.layer("cost", ("terminal_time",))))
    layer(terminal_time=torch.tensor([33.0], dtype=torch.float64))
    assert layer.samples[0].certified is True


def test_a_network_learns_through_it(small: Planner) -> None:
    torch.manual_seed(0)
    network = torch.nn.Linear(2, 1).double()
    layer = small.layer("cost", ("initial_state", "terminal_time"))
    start = torch.tensor([[0.0, 0.0], [0.1, 0.0]], dtype=torch.float64)
    optimiser = torch.optim.Adam(network.parameters(), lr=0.1)
    losses = []
    for _ in range(5):
        optimiser.zero_grad()
        seconds = 1.5 + torch.nn.functional.softplus(network(start)[:, 0])
        loss = layer(initial_state=start, terminal_time=seconds).mean()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < losses[0]


def test_inputs_are_checked(descent: Planner) -> None:
    with pytest.raises(InvalidInputError, match="each given once"):
        descent.layer("cost", ("initial_state", "initial_mass"))
    with pytest.raises(InvalidInputError, match="each given once"):
        descent.layer("cost", ())
    with pytest.raises(InvalidInputError, match="did you mean"):
        descent.layer("cost", ("inital_mass",))
    free = Planner(descent.problem, PlannerSettings(intervals=20, terminal_time=TerminalTime.FREE))
    with pytest.raises(InvalidInputError, match="a decision of the solver"):
        free.layer("cost", ("terminal_time",))
    layer = descent.layer("cost", ("initial_state",))
    with pytest.raises(InvalidInputError, match="exactly"):
        layer(terminal_time=torch.zeros(1))
    with pytest.raises(InvalidInputError, match="shape"):
        layer(initial_state=torch.zeros(2, 3))
    with pytest.raises(InvalidInputError, match=r"got 'shape \(7,\)', expected shape \(7, 7\)"):
        layer(initial_state=torch.zeros(7))
    for wrong in (np.zeros((2, 7)), [[0.0] * 7], 1.0, torch.zeros(2, 7, dtype=torch.complex64)):
        with pytest.raises(InvalidInputError, match="expected a tensor of real numbers"):
            layer(initial_state=wrong)  # type: ignore[arg-type]


def test_checks_of_the_declaration_fail_their_sample_only() -> None:
    def check(state: Array, values: Mapping[str, Any]) -> None:
        if state[0] > 0.05:
            raise InvalidInputError("position", state[0], "at most 0.05")
        assert values["mass"] < 1.6

    # No initial_state_parameters: the state is what initial_state makes of the parameters.
    problem = replace(cart(), check_state=check)
    layer = Planner(problem, PlannerSettings(intervals=6)).layer("cost", ("start", "mass"))
    start = torch.tensor([[0.0, 0.0], [0.1, 0.0], [0.0, 0.0]])
    loss = layer(start=start, mass=torch.tensor([1.5, 1.5, 1.7]))
    assert torch.isnan(loss).tolist() == [False, True, True]
    assert [sample.message.partition(":")[0] for sample in layer.samples[1:]] == [
        "position",
        "check_state",
    ]


def test_a_problem_without_named_initial_state_says_so() -> None:
    with pytest.raises(InvalidInputError, match="initial_state"):
        Planner(cart()).layer("cost", ("initial_state",))

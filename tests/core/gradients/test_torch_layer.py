from __future__ import annotations

import pickle
import subprocess
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from core.toy_problems import cart

from dscp_core import problems
from dscp_core.errors import InvalidInputError
from dscp_core.gradients.losses import ConvergenceLoss, CostLoss, FinalStateLoss
from dscp_core.gradients.run import Method, implicit, unrolled
from dscp_core.gradients.torch_layer import DscpLossLayer, DscpTrajectoryLayer, LossBatch, SeedLoss
from dscp_core.scp.scp import Scp, ScpOptions, ScpStatus
from dscp_core.transcription.transcription import Transcription

OPTIONS = ScpOptions.for_gradients(solver="clarabel", fixed_iterations=4)


@pytest.fixture(scope="module")
def scp() -> Scp:
    return Scp(Transcription(cart(), 4), OPTIONS)


@pytest.fixture(scope="module")
def descent() -> Scp:
    options = replace(OPTIONS, fixed_iterations=None)
    return Scp(Transcription(problems.get("powered_descent"), 15), options)


def column(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64, requires_grad=True)


def gradcheck(function: Any, *inputs: torch.Tensor) -> bool:
    # Curvatures are of size 1, so that a step of 1e-5 leaves 1e-10, and 1e-12 of the solver 1e-7.
    return bool(torch.autograd.gradcheck(function, inputs, eps=1e-5, atol=1e-6, rtol=1e-6))


def test_loss_passes_gradcheck(scp: Scp) -> None:
    layer = DscpLossLayer(scp, ("drag", "target"), CostLoss())
    target = torch.tensor([[1.0, 0.1], [1.2, -0.1]], dtype=torch.float64, requires_grad=True)
    assert gradcheck(
        lambda drag, target: layer(drag=drag, target=target).values, column(0.2, 0.5), target
    )


def test_trajectory_passes_gradcheck(scp: Scp) -> None:
    layer = DscpTrajectoryLayer(scp, ("drag", "terminal_time"))

    def outputs(drag: torch.Tensor, time: torch.Tensor) -> tuple[torch.Tensor, ...]:
        batch = layer(drag=drag, terminal_time=time)
        return batch.states, batch.controls, batch.terminal_time_s

    assert gradcheck(outputs, column(0.3), column(2.2))


def test_free_terminal_time_passes_gradcheck() -> None:
    # The effort alone would stretch the time for ever; a weight on the time balances it.
    problem = replace(
        cart(), terminal_cost=lambda x, time, p: time + time**2 / 4, path_constraints=()
    )
    scp = Scp(
        Transcription(problem, 4, free_terminal_time=True), replace(OPTIONS, fixed_iterations=5)
    )
    layer = DscpTrajectoryLayer(scp, ("drag",))

    def outputs(drag: torch.Tensor) -> tuple[torch.Tensor, ...]:
        batch = layer(drag=drag)
        return batch.states, batch.terminal_time_s

    assert gradcheck(outputs, column(0.3))
    assert layer(drag=column(0.3)).terminal_time_s[0] != 2.0


def test_initial_reference_passes_gradcheck(scp: Scp) -> None:
    # One iteration, so that the start still matters.
    layer = DscpLossLayer(scp.with_options(fixed_iterations=1), ("drag",), CostLoss())
    start = scp.transcription.initial_guess(scp.transcription.table.pack()) + 0.1
    reference = torch.from_numpy(start[None, :]).requires_grad_()
    assert gradcheck(
        lambda drag, reference: layer(reference, drag=drag).values, column(0.3), reference
    )
    layer(reference, drag=column(0.3)).values.sum().backward()
    assert reference.grad is not None
    assert reference.grad.abs().max() > 1e-3


@pytest.mark.parametrize("method", Method)
def test_batch_is_the_core_sample_by_sample(descent: Scp, method: Method) -> None:
    loss = FinalStateLoss("mass", -1.0)
    layer = DscpLossLayer(
        descent,
        ("terminal_time", "initial_velocity"),
        loss,
        parameters={"initial_mass": 37500.0},
        method=method,
    )
    times = column(33.3, 34.0)
    velocities = torch.tensor(
        [[-150.0, 30.0, -30.0], [-140.0, 20.0, 10.0]], dtype=torch.float64, requires_grad=True
    )
    batch = layer(terminal_time=times, initial_velocity=velocities)
    assert batch.values.shape == (2,)
    assert [report.trusted for report in batch.samples] == [None, None]
    (batch.values * torch.tensor([1.0, -2.0], dtype=torch.float64)).sum().backward()
    table = descent.transcription.table
    assert times.grad is not None
    assert velocities.grad is not None
    for sample, weight in enumerate((1.0, -2.0)):
        packed = table.pack(
            {
                "terminal_time": times[sample].item(),
                "initial_velocity": velocities[sample].detach().numpy(),
                "initial_mass": 37500.0,
            }
        )
        trace = descent.run(packed)
        function = unrolled if method is Method.UNROLLED else implicit
        expected = function(descent, trace, loss)
        report = batch.samples[sample]
        assert report.status is trace.status is ScpStatus.CONVERGED
        assert (report.usable, report.iterations) == (True, len(trace.iterations))
        assert (report.trusted, report.reasons) == (expected.trusted, expected.reasons)
        # The same computation, but for the state that the solver keeps between runs.
        assert batch.values[sample].item() == pytest.approx(expected.value, rel=1e-12)
        gradient = weight * expected.parameters
        np.testing.assert_allclose(
            times.grad[sample].numpy(), gradient[table.slice("terminal_time")][0], rtol=1e-6
        )
        np.testing.assert_allclose(
            velocities.grad[sample].numpy(), gradient[table.slice("initial_velocity")], rtol=1e-6
        )


def test_trajectory_is_in_si(descent: Scp) -> None:
    layer = DscpTrajectoryLayer(descent, ("initial_position", "terminal_time"))
    position = torch.tensor([[5000.0, 500.0, 500.0]], dtype=torch.float64)
    batch = layer(initial_position=position, terminal_time=torch.tensor([33.3]))
    layout = descent.transcription.layout
    trace = descent.run(
        descent.transcription.table.pack({"terminal_time": float(np.float32(33.3))})
    )
    assert batch.states.shape == (1, 16, 7)
    assert batch.controls.shape == (1, 16, 3)
    np.testing.assert_allclose(batch.states[0].numpy(), layout.states(trace.final_reference))
    np.testing.assert_allclose(
        batch.controls[0].numpy(), layout.controls(trace.final_reference), atol=1.0
    )
    assert batch.terminal_time_s.dtype is torch.float64
    assert float(batch.terminal_time_s[0]) == pytest.approx(33.3, abs=1e-5)  # single precision


def test_failed_samples_harm_no_other(scp: Scp) -> None:
    layer = DscpLossLayer(scp, ("terminal_time", "force_max"), CostLoss())
    good = layer(terminal_time=column(2.0, 2.5), force_max=column(2.0, 2.0))
    good.values.sum().backward()
    # Not a number; too little time for the force; good; out of bounds; good.
    times = column(float("nan"), 0.3, 2.0, -1.0, 2.5)
    batch = layer(terminal_time=times, force_max=column(*[2.0] * 5))
    statuses = [report.status for report in batch.samples]
    done = ScpStatus.FIXED_ITERATIONS
    assert statuses == [None, ScpStatus.SUBPROBLEM_INFEASIBLE, done, None, done]
    assert [report.usable for report in batch.samples] == [False, False, True, False, True]
    assert "terminal_time" in batch.samples[0].message
    assert "finite" in batch.samples[0].message
    assert "infeasible" in batch.samples[1].message
    assert "[0.1, 10] s" in batch.samples[3].message
    np.testing.assert_array_equal(batch.values.detach()[[0, 1, 3]].numpy(), np.zeros(3))
    # rtol: the state that the solver keeps between runs.
    torch.testing.assert_close(batch.values[[2, 4]], good.values, rtol=1e-9, atol=0.0)
    batch.values.sum().backward()
    assert times.grad is not None
    assert torch.isfinite(times.grad).all()
    np.testing.assert_array_equal(times.grad[[0, 1, 3]].numpy(), np.zeros(3))
    assert (times.grad[[2, 4]] < 0.0).all()
    assert [report.trusted for report in batch.samples] == [False, False, True, False, True]
    assert all("zero gradient" in batch.samples[i].reasons[0] for i in (0, 1, 3))


def test_failed_trajectory_is_zero(scp: Scp) -> None:
    layer = DscpTrajectoryLayer(scp, ("terminal_time",))
    times = column(float("nan"), 2.0)
    batch = layer(terminal_time=times)
    for output in (batch.states, batch.controls, batch.terminal_time_s):
        assert torch.isfinite(output).all()
        assert not output[0].any()
        assert output[1].any()
    (batch.states.sum() + 3.0 * batch.terminal_time_s.sum()).backward()
    assert times.grad is not None
    assert times.grad[0] == 0.0
    assert times.grad[1] > 1.0


def test_bad_start_fails_its_sample(scp: Scp) -> None:
    start = torch.from_numpy(scp.transcription.initial_guess(scp.transcription.table.pack()))
    starts = torch.stack([start, start])
    starts[0, 3] = float("inf")
    batch = DscpLossLayer(scp, ("drag",), CostLoss())(starts, drag=column(0.2, 0.2))
    assert [report.usable for report in batch.samples] == [False, True]
    assert "initial_reference" in batch.samples[0].message


def test_non_finite_cotangent_is_stopped(scp: Scp) -> None:
    drag = column(0.2, 0.3)
    batch = DscpLossLayer(scp, ("drag",), CostLoss())(drag=drag)
    batch.values.backward(torch.tensor([float("nan"), 1.0], dtype=torch.float64))
    assert drag.grad is not None
    assert drag.grad[0] == 0.0
    assert drag.grad[1] != 0.0
    assert batch.samples[0].trusted is False
    assert "not finite" in batch.samples[0].reasons[0]


def test_infeasible_descent_keeps_its_gradient(descent: Scp) -> None:
    # A run that converged with virtual control has a gradient: training can leave that region.
    times = column(31.0)
    batch = DscpLossLayer(descent, ("terminal_time",), CostLoss())(terminal_time=times)
    assert batch.samples[0].status is ScpStatus.INFEASIBLE
    assert batch.samples[0].usable
    batch.values.sum().backward()
    assert times.grad is not None
    assert times.grad.abs() > 1.0


def test_loss_of_earlier_iterates_is_refused_by_the_implicit_method(scp: Scp) -> None:
    layer = DscpLossLayer(scp, ("drag",), ConvergenceLoss(), method=Method.IMPLICIT)
    drag = column(0.2)
    with pytest.raises(InvalidInputError, match="ConvergenceLoss"):
        layer(drag=drag).values.sum().backward()


def test_no_gradient_asked_for(scp: Scp) -> None:
    layer = DscpLossLayer(scp, ("drag",), CostLoss())
    with torch.no_grad():
        batch = layer(drag=torch.tensor([0.2]))
    assert not batch.values.requires_grad
    assert batch.samples[0].trusted is None
    assert layer(drag=torch.zeros(0)).values.shape == (0,)


def test_layer_inside_a_network(scp: Scp) -> None:
    network = torch.nn.Linear(1, 1).double()
    torch.nn.init.zeros_(network.weight)
    torch.nn.init.zeros_(network.bias)
    layer = DscpLossLayer(scp, ("terminal_time",), CostLoss())
    features = torch.tensor([[0.1], [0.2], [0.3]], dtype=torch.float64)
    optimiser = torch.optim.SGD(network.parameters(), lr=0.01)
    losses = []
    for _ in range(4):
        optimiser.zero_grad()
        batch = layer(terminal_time=2.0 + network(features))
        assert all(report.usable for report in batch.samples)
        batch.values.mean().backward()
        optimiser.step()
        losses.append(batch.values.mean().item())
    # Less effort with more time: the network learns to ask for it.
    assert losses == sorted(losses, reverse=True)
    assert losses[-1] < losses[0]


@pytest.mark.parametrize(
    ("inputs", "match"),
    [((), "one or more"), (("drag", "drag"), "each given once"), (("dreg",), "did you mean drag")],
)
def test_bad_input_names(scp: Scp, inputs: tuple[str, ...], match: str) -> None:
    with pytest.raises(InvalidInputError, match=match):
        DscpLossLayer(scp, inputs, CostLoss())


def test_bad_fixed_parameter(scp: Scp) -> None:
    with pytest.raises(InvalidInputError, match="mass"):
        DscpLossLayer(scp, ("drag",), CostLoss(), parameters={"mass": -1.0})


@pytest.mark.parametrize(
    ("inputs", "match"),
    [
        ({"drag": torch.ones(2)}, "exactly"),
        ({"drag": torch.ones(2), "target": torch.ones(2, 2), "mass": torch.ones(2)}, "exactly"),
        ({"drag": torch.ones(2), "target": torch.ones(2)}, "target: got 'shape"),
        ({"drag": torch.ones(2), "target": torch.ones(3, 2)}, "shape"),
        ({"drag": torch.ones(()), "target": torch.ones(1, 2)}, "shape"),
    ],
)
def test_bad_shapes(scp: Scp, inputs: dict[str, torch.Tensor], match: str) -> None:
    layer = DscpLossLayer(scp, ("drag", "target"), CostLoss())
    with pytest.raises(InvalidInputError, match=match):
        layer(**inputs)


def test_bad_initial_reference_shape(scp: Scp) -> None:
    layer = DscpLossLayer(scp, ("drag",), CostLoss())
    with pytest.raises(InvalidInputError, match="initial_reference"):
        layer(torch.zeros(1, 3), drag=column(0.2))


def test_seed_loss_is_its_own_gradient(scp: Scp) -> None:
    transcription = scp.transcription
    trace = scp.run(transcription.table.pack())
    seed = np.random.default_rng(2).standard_normal(transcription.layout.reference_size)
    loss = SeedLoss(seed)
    assert loss.value(transcription, trace) == pytest.approx(seed @ trace.final_reference)
    gradient = loss.gradient(transcription, trace)
    np.testing.assert_array_equal(gradient.decisions[-1][: seed.size], seed)
    assert not gradient.decisions[:-1].any()
    assert not gradient.parameters.any()


def test_core_does_not_import_torch() -> None:
    code = (
        "import sys, dscp_core.planning.planner, dscp_core.gradients.run\n"
        "sys.exit('torch' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_layers_can_be_pickled(scp: Scp) -> None:
    # The cart's functions are lambdas.
    layers = (
        DscpLossLayer(scp, ("drag", "target"), CostLoss(), parameters={"mass": 1.2}),
        DscpTrajectoryLayer(scp, ("drag", "target"), parameters={"mass": 1.2}),
    )
    target = torch.tensor([[1.0, 0.1]], dtype=torch.float64)
    for layer in layers:
        outputs = []
        for module in (layer, pickle.loads(pickle.dumps(layer))):
            drag = column(0.3)
            batch = module(drag=drag, target=target)
            output = batch.values if isinstance(batch, LossBatch) else batch.states
            output.sum().backward()
            assert drag.grad is not None
            outputs.append((output.detach().numpy(), drag.grad.numpy()))
        for given, restored in zip(*outputs, strict=True):
            # A backend keeps scalings between runs; tolerance 1e-12 of the solver.
            np.testing.assert_allclose(restored, given, rtol=1e-9, atol=1e-12)
            assert np.any(given)

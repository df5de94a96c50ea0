"""Gauss-Newton fit, against dense linear algebra on an explicit Jacobian."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dscp_core.learning.gauss_newton import FitError, GaussNewton, Targets
from dscp_core.learning.network_torch import TorchNetwork
from dscp_core.learning.recipes import Fit
from dscp_core.learning.sampling import PAPER_BOX
from dscp_core.planning.terminal_time_network import FeatureMap, TerminalTimeNetwork

STATES = PAPER_BOX.uniform(60, np.random.default_rng(0))


def small_network(hidden: tuple[int, ...] = (8, 6)) -> TorchNetwork:
    return TorchNetwork(FeatureMap.AXISYMMETRIC, hidden, (30.0, 42.0), STATES, seed=1)


def smooth_times(states: np.ndarray) -> np.ndarray:
    scaled = (states[:, :6] - np.array(PAPER_BOX.center)) / np.array(PAPER_BOX.half_width)
    lateral = scaled[:, 1] * scaled[:, 4] + scaled[:, 2] * scaled[:, 5]
    return 34.0 + scaled[:, 0] - 0.8 * scaled[:, 3] + 0.5 * np.tanh(2.0 * lateral)


def jacobian(network: TorchNetwork, inputs: torch.Tensor) -> np.ndarray:
    rows = []
    for output in network(inputs):
        gradients = torch.autograd.grad(output, list(network.parameters()), retain_graph=True)
        rows.append(torch.cat([g.ravel() for g in gradients]).numpy())
    return np.array(rows)


@pytest.mark.parametrize("decay", [0.0, 1e-2])
def test_step_is_the_damped_least_squares_solution(decay: float) -> None:
    network = small_network()
    rng = np.random.default_rng(2)
    inputs = network.inputs(STATES)
    weights = rng.uniform(0.2, 2.0, len(STATES))
    wanted = 34.0 + rng.normal(size=len(STATES))
    targets = Targets(inputs, torch.from_numpy(wanted), torch.from_numpy(weights))
    settings = Fit(
        steps=100, batch=1000, step_length=0.3, momentum=0.8, weight_decay=decay, damping=(0.1, 0.1)
    )
    fit = GaussNewton(network, settings)
    fit.last = rng.normal(size=fit.last.size) * 1e-2
    start = torch.nn.utils.parameters_to_vector(network.parameters()).detach().numpy().copy()
    root = np.sqrt(weights / weights.mean())[:, None]
    derivative = root * jacobian(network, inputs)
    residual = root[:, 0] * (wanted - network.predict(STATES))
    n = len(STATES)
    # Normal equations of |J d - r|^2 + n damping |d - momentum last|^2 + n decay |d + start|^2.
    matrix = derivative.T @ derivative + n * (0.1 + decay) * np.eye(start.size)
    right = derivative.T @ residual + n * (0.1 * 0.8 * fit.last - decay * start)
    expected = np.linalg.solve(matrix, right)
    loss = fit.step(targets, rng)
    assert loss == pytest.approx(np.mean(residual**2), rel=1e-10)
    # The condition of the normal equations, some 1e4, times rounding.
    np.testing.assert_allclose(fit.last, expected, rtol=1e-7, atol=1e-10)
    after = torch.nn.utils.parameters_to_vector(network.parameters()).detach().numpy()
    np.testing.assert_allclose(after, start + 0.3 * expected, rtol=1e-7, atol=1e-10)


def test_steps_get_shorter_and_end() -> None:
    network = small_network()
    targets = Targets(
        network.inputs(STATES), torch.from_numpy(smooth_times(STATES)), torch.ones(60).double()
    )
    fit = GaussNewton(network, Fit(steps=10, batch=60, step_length=0.1))
    moved = []
    while not fit.done:
        before = torch.nn.utils.parameters_to_vector(network.parameters()).detach().clone()
        fit.step(targets, np.random.default_rng(0))
        after = torch.nn.utils.parameters_to_vector(network.parameters()).detach()
        moved.append(float(torch.linalg.norm(after - before)) / np.linalg.norm(fit.last))
    np.testing.assert_allclose(moved[:6], 0.1)
    np.testing.assert_allclose(moved[6:], [0.08, 0.06, 0.04, 0.02])


def test_numbers_that_are_not_finite_are_an_error() -> None:
    network = small_network()
    before = network.tensors()
    times = torch.full((len(STATES),), 34.0, dtype=torch.float64)
    times[7] = torch.nan
    inputs = network.inputs(STATES)
    fit = GaussNewton(network, Fit(steps=3, batch=len(STATES)))
    with pytest.raises(FitError, match="step 1"):
        fit.step(Targets(inputs, times, torch.ones_like(times)), np.random.default_rng(0))
    inputs[3, 2] = torch.nan
    with pytest.raises(FitError, match="step 1"):
        fit.step(
            Targets(inputs, torch.nan_to_num(times), torch.ones_like(times)),
            np.random.default_rng(0),
        )
    for name, tensor in network.tensors().items():
        np.testing.assert_array_equal(tensor, before[name])


def test_fits_a_smooth_function() -> None:
    rng = np.random.default_rng(3)
    states, unseen = PAPER_BOX.uniform(1500, rng), PAPER_BOX.uniform(300, rng)
    network = TorchNetwork(FeatureMap.AXISYMMETRIC, (32, 32), (30.0, 42.0), states, seed=1)
    times = smooth_times(states)
    network.start_at(float(times.mean()))
    assert network.predict(states).mean() == pytest.approx(times.mean(), abs=1.0)
    targets = Targets(network.inputs(states), torch.from_numpy(times), torch.ones(1500).double())
    fit = GaussNewton(network, Fit(steps=150, batch=400, weight_decay=0.0))
    while not fit.done:
        fit.step(targets, rng)
    error = network.predict(unseen) / smooth_times(unseen) - 1.0
    # The function varies by 3e-2; a fit that learnt only its linear part would be off by 5e-3.
    assert np.sqrt(np.mean(error**2)) < 2e-4


def test_export_predicts_the_same() -> None:
    network = small_network((64, 64, 64))
    lower, upper = PAPER_BOX.bounds()
    data = network.export(lower=lower, upper=upper, vehicle={}, intervals=50, provenance={})
    exported = TerminalTimeNetwork(data)
    # Rounding of three layers of 64 sums.
    np.testing.assert_allclose(exported.evaluate(STATES), network.predict(STATES), rtol=1e-12)
    copy = small_network((64, 64, 64))
    with torch.no_grad():
        for parameter in copy.parameters():
            parameter.zero_()
    assert not np.allclose(copy.predict(STATES), network.predict(STATES))
    copy.set_tensors(network.tensors())
    np.testing.assert_array_equal(copy.predict(STATES), network.predict(STATES))


def test_seed_decides_the_weights() -> None:
    first, again = small_network(), small_network()
    np.testing.assert_array_equal(first.predict(STATES), again.predict(STATES))
    other = TorchNetwork(FeatureMap.AXISYMMETRIC, (8, 6), (30.0, 42.0), STATES, seed=2)
    assert not np.array_equal(first.predict(STATES), other.predict(STATES))

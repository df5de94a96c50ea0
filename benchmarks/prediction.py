"""The built-in terminal-time network: time of one prediction, and PyTorch beside it."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import torch

from benchmarks.cases import box_states
from benchmarks.report import Report
from benchmarks.timing import Array, alternated, clocked, median_ms, p99_ms
from dscp_core.learning.network_torch import TorchNetwork
from dscp_core.planning.terminal_time_network import NetworkData, TerminalTimeNetwork
from dscp_core.problems.powered_descent.definition import NETWORK

TIME_TARGET_MS = 0.2
DIFFERENCE_TARGET = 1e-12
STATES = 10000
IMPORTS = (
    "import sys, dscp_core.planning.terminal_time_network as t; "
    "from dscp_core.problems.powered_descent.definition import NETWORK; "
    "t.TerminalTimeNetwork.load(NETWORK); "
    "print('torch' in sys.modules)"
)


def measure(*, quick: bool) -> Report:
    """Time predictions one at a time, as the planner asks for them."""
    report = Report("prediction")
    torch.set_num_threads(1)
    network, load_s, _ = clocked(lambda: TerminalTimeNetwork.load(NETWORK))
    theirs = torch_network(network.data)
    states = box_states(STATES, seed=1)
    rounds = 300 if quick else 3000
    numpy_s, torch_s = alternated(
        [lambda: network.predict(states[0]), lambda: theirs.predict(states[:1])], rounds
    ).T
    target = ("<=", TIME_TARGET_MS)
    report.add("NumPy, one prediction, median", median_ms(numpy_s), "ms", target)
    report.add("NumPy, one prediction, p99", p99_ms(numpy_s), "ms", target)
    report.add("PyTorch, one prediction, median", median_ms(torch_s), "ms")
    difference = np.abs(network.evaluate(states) / theirs.predict(states) - 1.0)
    report.add(
        "NumPy against PyTorch, greatest relative difference",
        float(difference.max()),
        "1",
        ("<=", DIFFERENCE_TARGET),
    )
    report.add("reading the file", 1e3 * load_s, "ms")
    found = subprocess.run(
        [sys.executable, "-c", IMPORTS], capture_output=True, text=True, check=True
    )
    report.add("torch is imported (0 no, 1 yes)", float("True" in found.stdout), target=("<=", 0.0))
    report.notes.append(
        f"{rounds} rounds, in turns, both with one thread; difference: {STATES} random states of "
        "the paper's box"
    )
    return report


def torch_network(data: NetworkData) -> TorchNetwork:
    """The same network in PyTorch."""
    hidden = [len(bias) for bias in data.biases[:-1]]
    network = TorchNetwork(data.features, hidden, data.interval_s, corners(data), seed=0)
    network.feature_center, network.feature_scale = data.feature_center, data.feature_scale
    tensors: dict[str, Array] = {}
    for number, (weight, bias) in enumerate(zip(data.weights, data.biases, strict=True)):
        tensors |= {f"layers.{number}.weight": weight, f"layers.{number}.bias": bias}
    network.set_tensors(tensors)
    return network


def corners(data: NetworkData) -> Array:
    """(2, 7) opposite corners of the network's box."""
    return np.stack([data.lower, data.upper])

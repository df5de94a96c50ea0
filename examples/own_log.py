"""Own log to tuned planner: states from a CSV file become a bag, and the bag a parameter set.

The log has states in which a quadrotor asked for plans (here drawn at random about hover). Its
planner weighs changes of the pitch heavily and converges slowly. `dscp tune` finds a better weight
through the derivatives of whole runs from the first 80 % of the log, and judges it by the others.
"""

import argparse
import csv
import json
import subprocess
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import yaml
from builtin_interfaces.msg import Time
from quadrotor_past_obstacle import quadrotor
from sensor_msgs.msg import JointState

from dscp_core import Planner, ScpOptions
from dscp_ros.bag.writer import BagWriter

HERE = Path(__file__).parent
LOG, CAUTIOUS = HERE / "data" / "quadrotor_log.csv", HERE / "data" / "quadrotor_cautious.yaml"
TOPIC = "/planner/vehicle_state"


def write_bag(path):
    """The log as a bag: a JointState per row, as the planner node takes them."""
    with BagWriter(path, overwrite=True) as bag, LOG.open() as file:
        bag.add_topic(TOPIC, JointState)
        for row in csv.DictReader(file):
            time_ns = round(float(row.pop("time_s")) * 1e9)
            message = JointState(name=list(row), position=[float(v) for v in row.values()])
            message.header.stamp = Time(sec=time_ns // 10**9, nanosec=time_ns % 10**9)
            message.header.frame_id = "world"
            bag.write(TOPIC, message, time_ns)


def tune(bag, output):
    """Report of `dscp tune`, which writes a parameter set to a directory."""
    command = [Path(sys.executable).with_name("dscp"), "tune", bag]
    command += ["--output", output, "--overwrite", "--json"]
    command += ["--problem", f"{HERE / 'quadrotor_past_obstacle.py'}:quadrotor"]
    command += ["--params-file", CAUTIOUS, "--parameters", "trust_region_state.pitch"]
    command += ["--loss", "iterations", "--epochs", "4", "--batch", "8", "--learning-rate", "0.5"]
    return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)


def iterations(weights, states):
    """Iterations of the plans from some states, with the options of the node that flew."""
    options = ScpOptions(max_iterations=60, cost_tolerance=1e-6)
    planner = Planner(quadrotor, parameters=weights, options=options)
    return np.array([planner.plan(state).iterations for state in states])


def main(output):
    """Convert, tune, plan with the old and the new weight, print and draw."""
    output.mkdir(parents=True, exist_ok=True)
    write_bag(output / "quadrotor_log")
    result = tune(output / "quadrotor_log", output / "quadrotor_set")
    print(f"wrote {result['parameter_set']}: {result['tuned_values']}")
    held_out = result["held_out"]
    for when in ("before", "after"):
        mean, failures = held_out[when]["iterations"], held_out[when]["failures"]
        print(f"{when:6}: {mean:.2f} iterations per held-out state, {failures} without a plan")

    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
    epochs = [epoch["epoch"] for epoch in result["loss_history"]]
    left.plot(epochs, [epoch["loss"] for epoch in result["loss_history"]], "o-")
    left.set(title="training loss: log sum |J_k - J_K|", xlabel="epoch", xticks=epochs)
    states = np.loadtxt(LOG, delimiter=",", skiprows=1)[:, 1:]
    flown = yaml.safe_load(CAUTIOUS.read_text())["/**"]["ros__parameters"]["parameters"]
    slow, fast = iterations(flown, states), iterations(result["tuned_values"], states)
    right.plot(slow, "o", color="0.7", label=f"before, mean {slow.mean():.1f}")
    right.plot(fast, "o", label=f"after, mean {fast.mean():.1f}")
    right.axvline(len(states) - held_out["after"]["states"] - 0.5, color="k", linestyle=":")
    right.set(title="iterations of a plan", xlabel="state (right of the line: held out)")
    right.set_ylim(0, 75)
    right.legend(loc="upper right", ncols=2)
    figure.savefig(output / "own_log.png", dpi=120)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, default=Path("out"))
    main(parser.parse_args().output)

"""A batch of states of which some cannot be planned from: every one gets its own verdict.

A lander that touches down 34 s after ignition, ignited at different places. From some it cannot get
there in time; one is under the ground, and one came from a sensor that returned no number. A sample
that fails has the loss NaN and the gradient zero; the others have theirs as if they were alone.
"""

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import torch

from dscp_core import Planner, problems

torch.set_default_dtype(torch.float64)
descent = problems.get("powered_descent")
planner = Planner(descent, intervals=20, parameters={"terminal_time": 34.0})
layer = planner.layer("mass", inputs=("initial_state",))


def ignitions():
    """States (B, 7), SI, at different heights and distances; two of them spoilt."""
    heights, distances = torch.linspace(3000.0, 5500.0, 5), torch.linspace(-1500.0, 2000.0, 6)
    states = torch.tensor(planner.initial_state).repeat(30, 1)
    states[:, :2] = torch.cartesian_prod(heights, distances)
    states[3, 0], states[16, 3] = -50.0, torch.nan
    return states


def differentiate(states):
    """Mass at touchdown in kg, (B,), its gradient by the states, (B, 7), and verdicts."""
    states = states.clone().requires_grad_()
    masses = layer(initial_state=states)
    masses.nansum().backward()
    return masses.detach(), states.grad, layer.samples


def main(output):
    """Plan the batch, print what failed, compare what did not, draw."""
    output.mkdir(parents=True, exist_ok=True)
    states = ignitions()
    masses, gradients, samples = differentiate(states)
    good = torch.tensor([sample.usable for sample in samples])
    trusted = torch.tensor([sample.trusted for sample in samples])
    print(f"{len(samples)} states, {good.sum()} with a plan, {trusted.sum()} gradients trusted")
    for number, sample in enumerate(samples):
        if not sample.trusted:
            verdict = "refused" if sample.status is None else sample.status.value
            print(f"  state {number:2}: {verdict}; {sample.reasons[0]}")
    alone, gradients_alone, _ = differentiate(states[good])
    apart_kg = (masses[good] - alone).abs().max()
    apart = (gradients[good] - gradients_alone).abs().max() / gradients_alone.abs().max()
    print(f"planned without those that fail: {apart_kg:.1g} kg apart, gradients {apart:.1g}")

    figure, axes = plt.subplots(figsize=(8, 5), layout="constrained")
    height, distance, uphill = states[:, 0], states[:, 1], gradients[good]
    propellant = states[good, 6] - masses[good]
    points = axes.scatter(distance[good], height[good], c=propellant, s=80)
    figure.colorbar(points, label="propellant [kg]")
    axes.quiver(distance[good], height[good], uphill[:, 1], uphill[:, 0], width=0.003)
    axes.plot(distance[~good], height[~good], "rx", markersize=9, label="no plan")
    axes.set(xlabel="distance [m]", ylabel="height [m]")
    axes.set_title("propellant by place of ignition; arrows: gradient, to where it is less")
    axes.legend()
    figure.savefig(output / "batch_with_failures.png", dpi=120)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, default=Path("out"))
    main(parser.parse_args().output)

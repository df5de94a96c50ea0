"""The gradient of a plan in PyTorch: a small network learns through the planner when to land.

It maps the state at ignition to a terminal time. It is never shown a good one: its loss is the
propellant of the plans that its times lead to, whose gradient the planner gives. It is judged on
states that it never saw, by the propellant beyond that of plans with a free terminal time.
"""

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import torch

from dscp_core import Planner, problems

VEHICLE = Path(__file__).parents[1] / "config" / "vehicles" / "mars_lander.yaml"
STEPS, BATCH = 30, 5

torch.set_default_dtype(torch.float64)
torch.manual_seed(0)
descent = problems.get("powered_descent")
planner = Planner(descent, vehicle=VEHICLE, intervals=20)
centre = torch.tensor(planner.initial_state)
spread = torch.tensor([200.0, 300.0, 300.0, 10.0, 10.0, 10.0, 50.0])
final_mass = planner.layer("mass", inputs=("initial_state", "terminal_time"))


def draw(count):
    """States at ignition, (count, 7), SI, in a box."""
    return centre + spread * (2 * torch.rand(count, 7) - 1)


def best_flights(states):
    """Propellant in kg and terminal time in s of plans with a free terminal time."""
    free = Planner(descent, vehicle=VEHICLE, intervals=20, terminal_time="free")
    plans = [free.plan(state).plan for state in states.numpy()]
    masses = torch.tensor([plan.states[-1, 6] for plan in plans])
    return states[:, 6] - masses, torch.tensor([plan.terminal_time_s for plan in plans])


def make_network():
    """A network from the scaled state to the scaled terminal time."""
    return torch.nn.Sequential(torch.nn.Linear(7, 16), torch.nn.Tanh(), torch.nn.Linear(16, 1))


def flight_time(network, states):
    """Terminal time in s, (B,), of states (B, 7)."""
    return 85.0 + 5.0 * network((states - centre) / spread)[:, 0]


def main(output):
    """Train, judge on held-out states, draw."""
    output.mkdir(parents=True, exist_ok=True)
    held_out = draw(12)
    least_kg, best_s = best_flights(held_out)
    network = make_network()
    before_s = flight_time(network, held_out).detach()
    optimiser = torch.optim.Adam(network.parameters(), lr=0.03)
    cooling = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, STEPS + 1)
    excess = {}
    for step in range(STEPS + 1):
        if step % 5 == 0:
            with torch.no_grad():
                masses = final_mass(
                    initial_state=held_out, terminal_time=flight_time(network, held_out)
                )
            excess[step] = (held_out[:, 6] - masses - least_kg).mean().item()
            print(f"step {step:2}: {excess[step]:7.3f} kg of propellant beyond the least")
        states = draw(BATCH)
        masses = final_mass(initial_state=states, terminal_time=flight_time(network, states))
        optimiser.zero_grad()
        (states[:, 6] - masses).nanmean().backward()
        optimiser.step()
        cooling.step()

    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    left.plot(excess.keys(), excess.values(), "o-")
    left.set(
        title="propellant beyond the least, held-out states [kg]",
        xlabel="training step",
        ylim=(0, None),
    )
    right.plot(best_s, before_s, "o", color="0.7", label="before training")
    right.plot(best_s, flight_time(network, held_out).detach(), "o", label="after training")
    right.axline((best_s.mean(), best_s.mean()), slope=1, color="k", linestyle="--")
    right.set(xlabel="best terminal time [s]", title="network's terminal time [s]")
    right.legend()
    figure.savefig(output / "gradient_in_torch.png", dpi=120)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, default=Path("out"))
    main(parser.parse_args().output)

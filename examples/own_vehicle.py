"""Powered descent of one's own vehicle: a certified plan, and what its propellant depends on.

The vehicle is a YAML file of parameter names and SI values. One gradient tells for every parameter
what a change of it is worth; plans of changed vehicles show how far that holds.
"""

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from dscp_core import Planner, problems

VEHICLE = Path(__file__).parent / "data" / "lunar_lander.yaml"
VARIED = ("initial_mass", "specific_impulse", "thrust_max", "pointing_angle_max")

descent = problems.get("powered_descent")


def planner(**changed):
    """A planner of the vehicle, with changed parameters."""
    return Planner(descent, vehicle=VEHICLE, parameters=changed, terminal_time="free")


def touchdown_mass(name, value):
    """Mass at touchdown of a changed vehicle, kg; NaN where it has no certified plan."""
    outcome = planner(**{name: value}).plan()
    return outcome.plan.states[-1, 6] if outcome.certified else np.nan


def main(output):
    """Plan, differentiate, plan again with changed vehicles, draw."""
    output.mkdir(parents=True, exist_ok=True)
    own = planner()
    outcome = own.plan()
    print(outcome.headline)
    own.figure(outcome).savefig(output / "own_vehicle.png")

    gradient = own.gradient("mass", at=outcome)
    print(gradient.headline)
    print(f"{'parameter':20} {'value':>8}       kg at touchdown per 1 %")
    figure, panels = plt.subplots(1, len(VARIED), figsize=(13, 3), layout="constrained")
    percent = np.linspace(-5.0, 5.0, 7)
    for name, panel in zip(VARIED, panels, strict=True):
        value, unit = outcome.parameters[name], descent.table[name].unit
        per_percent = gradient[name] * value / 100
        print(f"{name:20} {value:8g} {unit:4} {per_percent:+8.4f}")
        again = [touchdown_mass(name, value * (1 + change / 100)) for change in percent]
        panel.plot(percent, gradient.value + per_percent * percent, label="gradient")
        panel.plot(percent, again, "o", label="planned again")
        panel.set(title=name, xlabel="change [%]")
    panels[0].set_ylabel("mass at touchdown [kg]")
    panels[0].legend()
    figure.savefig(output / "own_vehicle_sensitivities.png", dpi=120)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, default=Path("out"))
    main(parser.parse_args().output)

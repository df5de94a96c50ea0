"""A car past discs: it goes to a parking place in free time and keeps clear of three discs.

A disc is no convex constraint: it is linearised about the last trajectory, again and again. It is
imposed at the nodes with a margin, of which the certificate lets the drive between them take some.
"""

import argparse
from pathlib import Path

import casadi as ca
import matplotlib.pyplot as plt
import numpy as np

import dscp_core as dscp

DISCS = ((12.0, 1.0, 4.0), (25.0, 9.0, 5.0), (36.0, 2.0, 4.0))  # centre x, y and radius in m


def dynamics(x, u, p):
    """The car rolls along its heading, on a path of the curvature that the steering sets."""
    heading, speed, curvature = x[2], x[3], u[1]
    return ca.vertcat(speed * ca.cos(heading), speed * ca.sin(heading), speed * curvature, u[0])


def straight(p, intervals):
    """Initial guess: straight to the goal at a steady pace, whatever is in the way."""
    share = ca.DM(np.linspace(0.0, 1.0, intervals + 1)).T
    way = p["goal"] - p["start"][:2]
    heading, speed = ca.atan2(way[1], way[0]), ca.norm_2(way) / p["terminal_time"]
    start = ca.vertcat(p["start"][:2], heading, speed)
    states = ca.repmat(start, 1, intervals + 1) + ca.mtimes(ca.vertcat(way, 0, 0), share)
    return dscp.InitialGuess(states, ca.MX(ca.DM.zeros(2, intervals + 1)))


def slip(at, p):
    """Squared acceleration, along and across the path, relative to what the tyres hold."""
    across = at.x[3] ** 2 * at.u[1]
    return (at.u[0] ** 2 + across**2) / p["grip"] ** 2 - 1


def clear_of(name, x_m, y_m, radius_m):
    """The car stays outside of a disc."""

    def overlap(at, p):
        return radius_m + p["margin"] - ca.norm_2(at.x[:2] - ca.vertcat(x_m, y_m))

    return dscp.PathConstraint(name, overlap, 5.0, "m", tolerance=lambda v: v["margin"])


car = dscp.OptimalControlProblem(
    name="car",
    states=(
        dscp.Variable("x", "m", 20.0, "to the east"),
        dscp.Variable("y", "m", 20.0, "to the north"),
        dscp.Variable("heading", "rad", 1.0, "from the east, positive to the left"),
        dscp.Variable("speed", "m/s", 5.0, "forwards"),
    ),
    controls=(
        dscp.Variable("acceleration", "m/s^2", 3.0, "along the path"),
        dscp.Variable("curvature", "1/m", 0.2, "of the path, positive to the left"),
    ),
    parameters=(
        dscp.Parameter("terminal_time", 9.0, "s", "first guess of it", lower=1.0, upper=60.0),
        dscp.Parameter("start", (0.0, 0.0, 0.0, 5.0), "SI", "state at the start"),
        dscp.Parameter("goal", (48.0, 8.0), "m", "where to stop"),
        dscp.Parameter("curvature_max", 0.2, "1/m", "of the tightest turn", lower=0.01),
        dscp.Parameter("grip", 4.0, "m/s^2", "greatest acceleration", lower=0.1),
        dscp.Parameter("margin", 0.3, "m", "kept from the discs at the nodes", lower=0.0),
        dscp.Parameter("comfort", 0.05, "s^4/m^2", "price of squared acceleration", lower=0.0),
        dscp.Parameter("calm", 10.0, "m^2", "price of squared curvature", lower=0.0),
    ),
    dynamics=dynamics,
    initial_state=lambda p: p["start"],
    initial_state_parameters=("start",),
    final_state={"x": lambda p: p["goal"][0], "y": lambda p: p["goal"][1], "speed": lambda p: 0},
    free_terminal_time=True,
    terminal_time_bounds=lambda p: (1, 60),
    running_cost=lambda x, u, p: 1 + p["comfort"] * u[0] ** 2 + p["calm"] * u[1] ** 2,
    cost_unit="s",
    cost_scale=1.0,
    path_constraints=(
        dscp.PathConstraint("grip", slip, 1.0, "1", tolerance=0.1),
        dscp.PathConstraint("left_turn", lambda at, p: at.u[1] - p["curvature_max"], 0.2, "1/m"),
        dscp.PathConstraint("right_turn", lambda at, p: -at.u[1] - p["curvature_max"], 0.2, "1/m"),
        *(clear_of(f"disc_{n}", *disc) for n, disc in enumerate(DISCS, start=1)),
    ),
    # Small weights leave every subproblem one solution only, which gradients need.
    trust_region_state=(0.01,) * 4,
    trust_region_control=(0.01,) * 2,
    initial_guess=straight,
    misses=(dscp.Miss("miss_position", lambda x, p: ca.norm_2(x[:2] - p["goal"]), "m", 0.3),),
)


def main(output):
    """Plan, print what was checked, draw."""
    output.mkdir(parents=True, exist_ok=True)
    outcome = dscp.Planner(car).plan()
    print(outcome.headline)
    for check in outcome.certificate.checks:
        print(f"  {check.name:14} {check.worst_value:9.4f} <= {check.bound:.4g} {check.unit}")
    plan, flight = outcome.plan, outcome.certificate
    figure, (plane, tyres) = plt.subplots(1, 2, figsize=(12, 4), width_ratios=(2, 1))
    for x_m, y_m, radius_m in DISCS:
        plane.add_patch(plt.Circle((x_m, y_m), radius_m, color="0.75"))
    plane.plot(flight.states[:, 0], flight.states[:, 1], label="driven (certificate)")
    plane.plot(plan.states[:, 0], plan.states[:, 1], "o", markersize=3, label="planned (nodes)")
    plane.set(title=outcome.headline, xlabel="x [m]", ylabel="y [m]", aspect="equal")
    plane.legend()
    tyres.plot(flight.controls[:, 0], flight.states[:, 3] ** 2 * flight.controls[:, 1])
    tyres.add_patch(plt.Circle((0, 0), outcome.parameters["grip"], fill=False, linestyle="--"))
    tyres.set(title="acceleration [m/s²]", xlabel="along", ylabel="across", aspect="equal")
    figure.savefig(output / "car_past_discs.png", dpi=120, bbox_inches="tight")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, default=Path("out"))
    main(parser.parse_args().output)

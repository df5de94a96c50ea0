"""A quadrotor in a vertical plane flies from hover to hover, over an obstacle, with least effort.

The declaration is all that planner, command line, tuner and node need:

    dscp plan examples/quadrotor_past_obstacle.py:quadrotor --set obstacle=4,1,1.5 --plot other.png
"""

import argparse
from pathlib import Path

import casadi as ca
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle

import dscp_core as dscp


def dynamics(x, u, p):
    """A rigid body under the thrusts of two rotors and gravity."""
    thrust, turning = ca.sum1(u) / p["mass"], p["arm"] * (u[1] - u[0]) / p["inertia"]
    lift = ca.vertcat(-thrust * ca.sin(x[2]), thrust * ca.cos(x[2]) - p["gravity"])
    return ca.vertcat(x[3:], lift, turning)


def straight(p, intervals):
    """Initial guess: straight to the goal, level and at hover thrust, whatever is in the way."""
    share = ca.DM(np.linspace(0.0, 1.0, intervals + 1)).T
    way = p["goal"] - p["start"][:2]
    start = ca.vertcat(p["start"][:2], 0, way / p["terminal_time"], 0)
    states = ca.repmat(start, 1, intervals + 1) + ca.mtimes(ca.vertcat(way, 0, 0, 0, 0), share)
    return dscp.InitialGuess(states, ca.repmat(p["mass"] * p["gravity"] / 2, 2, intervals + 1))


def overlap(at, p):
    """How far the vehicle's circle reaches into the obstacle and its margin, m."""
    reach = p["obstacle"][2] + p["margin"] + p["arm"]
    return reach - ca.norm_2(at.x[:2] - p["obstacle"][:2])


def figure(plan, certificate, parameters, title=None):
    """The flight in its plane, with the vehicle at every third node, and the rotors' thrusts."""
    drawing = Figure(figsize=(12, 4), dpi=120, layout="constrained")
    plane, thrusts = drawing.subplots(1, 2, width_ratios=(2, 1))
    plane.add_patch(Circle(parameters["obstacle"][:2], parameters["obstacle"][2], color="0.75"))
    plane.plot(certificate.states[:, 0], certificate.states[:, 1])
    for y, z, pitch in plan.states[::3, :3]:
        tip = parameters["arm"] * np.array([np.cos(pitch), np.sin(pitch)])
        plane.plot([y - tip[0], y + tip[0]], [z - tip[1], z + tip[1]], "k", linewidth=2)
    plane.set(title=title or "flight", xlabel="y [m]", ylabel="z [m]", aspect="equal")
    thrusts.plot(certificate.times_s, certificate.controls, label=plan.control_names)
    thrusts.axhline(parameters["thrust_max"], color="grey", linestyle=":", label="limit")
    thrusts.set(title="thrust [N]", xlabel="time [s]", ylim=(0, None))
    thrusts.legend()
    return drawing


quadrotor = dscp.OptimalControlProblem(
    name="quadrotor",
    states=(
        dscp.Variable("y", "m", 5.0, "to the right"),
        dscp.Variable("z", "m", 5.0, "upwards"),
        dscp.Variable("pitch", "rad", 1.0, "to the left"),
        dscp.Variable("vy", "m/s", 3.0, "to the right"),
        dscp.Variable("vz", "m/s", 3.0, "upwards"),
        dscp.Variable("pitch_rate", "rad/s", 3.0, "to the left"),
    ),
    controls=tuple(dscp.Variable(f"{s}_thrust", "N", 4.0, "of a rotor") for s in ("left", "right")),
    parameters=(
        dscp.Parameter("terminal_time", 3.0, "s", "flight time", lower=0.5, upper=20.0),
        dscp.Parameter("start", (0.0, 2.0, 0.0, 0.0, 0.0, 0.0), "SI", "state at the start"),
        dscp.Parameter("goal", (8.0, 2.0), "m", "where to hover at the end"),
        dscp.Parameter("obstacle", (3.5, 1.2, 1.5), "m", "centre and radius"),
        dscp.Parameter("margin", 0.05, "m", "kept from it at the nodes", lower=0.0),
        dscp.Parameter("mass", 0.8, "kg", "of the vehicle", lower=0.1),
        dscp.Parameter("inertia", 0.01, "kg m^2", "about the axis of pitch", lower=1e-4),
        dscp.Parameter("arm", 0.2, "m", "from the centre to a rotor", lower=0.01),
        dscp.Parameter("thrust_max", 6.0, "N", "of one rotor", lower=0.1),
        dscp.Parameter("gravity", 9.81, "m/s^2", "gravitational acceleration", lower=0.0),
    ),
    dynamics=dynamics,
    initial_state=lambda p: p["start"],
    initial_state_parameters=("start",),
    final_state={"y": lambda p: p["goal"][0], "z": lambda p: p["goal"][1]}
    | dict.fromkeys(("pitch", "vy", "vz", "pitch_rate"), lambda p: 0),
    running_cost=lambda x, u, p: ca.sumsqr(2 * u / (p["mass"] * p["gravity"]) - 1),
    cost_unit="s",
    cost_scale=0.1,
    path_constraints=(
        dscp.PathConstraint("obstacle", overlap, 5.0, "m", tolerance=lambda v: v["margin"]),
        dscp.PathConstraint("left_max", lambda at, p: at.u[0] - p["thrust_max"], 4.0, "N"),
        dscp.PathConstraint("left_min", lambda at, p: -at.u[0], 4.0, "N"),
        dscp.PathConstraint("right_max", lambda at, p: at.u[1] - p["thrust_max"], 4.0, "N"),
        dscp.PathConstraint("right_min", lambda at, p: -at.u[1], 4.0, "N"),
    ),
    # Of the pitch: in place of the curvature of thrust times sine, which linearising drops.
    trust_region_state=(0.01, 0.01, 0.1, 0.01, 0.01, 0.01),
    trust_region_control=(0.01, 0.01),
    initial_guess=straight,
    misses=(dscp.Miss("miss_position", lambda x, p: ca.norm_2(x[:2] - p["goal"]), "m", 0.1),),
    extras=dscp.Extras(figure=figure),
)


def main(output):
    """Plan, print what was checked, draw."""
    output.mkdir(parents=True, exist_ok=True)
    planner = dscp.Planner(quadrotor)
    outcome = planner.plan()
    print(outcome.headline)
    for check in outcome.certificate.checks:
        print(f"  {check.name:14} {check.worst_value:9.4f} <= {check.bound:.4g} {check.unit}")
    planner.figure(outcome, outcome.headline).savefig(output / "quadrotor_past_obstacle.png")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, default=Path("out"))
    main(parser.parse_args().output)

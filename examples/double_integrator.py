"""Minimum-energy double integrator with a speed limit, against its analytic solution.

A cart goes 100 m in 20 s from rest to rest, no faster than 6 m/s, with the least integral of a^2/2.
By Pontryagin's principle its acceleration falls linearly to zero until the speed limit is reached,
at t1, stays zero, and goes on falling linearly in the last t1 seconds. With a distance D, a time T
and a limit V:

    a ramp      a = a0 (1 - t/t1),  V = a0 t1/2,  it covers 2/3 V t1
    the whole   D = V T - 2/3 V t1,  so that t1 = 3/2 (T - D/V),  at a cost of 4/3 V^2/t1
"""

import argparse
from pathlib import Path

import casadi as ca
import matplotlib.pyplot as plt
import numpy as np

import dscp_core as dscp

DISTANCE_M, TIME_S, SPEED_M_S = 100.0, 20.0, 6.0


def steady(p, intervals):
    """Initial guess: constant speed."""
    share = ca.DM(np.linspace(0.0, 1.0, intervals + 1)).T
    speed = ca.repmat(p["distance"] / p["terminal_time"], 1, intervals + 1)
    return dscp.InitialGuess(ca.vertcat(p["distance"] * share, speed), ca.MX(0 * share))


double_integrator = dscp.OptimalControlProblem(
    name="double_integrator",
    states=(
        dscp.Variable("position", "m", 100.0, "distance covered"),
        dscp.Variable("speed", "m/s", 10.0, "its rate"),
    ),
    controls=(dscp.Variable("acceleration", "m/s^2", 1.0, "rate of the speed"),),
    parameters=(
        dscp.Parameter("terminal_time", TIME_S, "s", "duration", lower=1.0, upper=100.0),
        dscp.Parameter("start", (0.0, 0.0), "m and m/s", "position and speed at the start"),
        dscp.Parameter("distance", DISTANCE_M, "m", "position at the end", lower=0.0),
        dscp.Parameter("speed_max", SPEED_M_S, "m/s", "speed limit", lower=0.1),
    ),
    dynamics=lambda x, u, p: ca.vertcat(x[1], u[0]),
    initial_state=lambda p: p["start"],
    initial_state_parameters=("start",),
    final_state={"position": lambda p: p["distance"], "speed": lambda p: ca.SX(0)},
    running_cost=lambda x, u, p: u[0] ** 2 / 2,
    cost_unit="m^2/s^3",
    cost_scale=1.0,
    path_constraints=(
        dscp.PathConstraint(
            "speed_max", lambda at, p: at.x[1] - p["speed_max"], 10.0, "m/s", tolerance=1e-6
        ),
    ),
    initial_guess=steady,
)


def optimum(t):
    """Analytic speed and acceleration at the times t, the cost, and its slope by the limit."""
    ramp_s = 1.5 * (TIME_S - DISTANCE_M / SPEED_M_S)
    steepest = 2 * SPEED_M_S / ramp_s
    first, last = (1 - np.minimum(s, ramp_s) / ramp_s for s in (t, TIME_S - t))
    cost = 4 / 3 * SPEED_M_S**2 / ramp_s
    slope = cost * (2 / SPEED_M_S - 1.5 * DISTANCE_M / SPEED_M_S**2 / ramp_s)
    return SPEED_M_S * (1 - first**2 - last**2), steepest * (first - last), cost, slope


def main(output):
    """Plan with more and more intervals, print and draw the errors."""
    output.mkdir(parents=True, exist_ok=True)
    t = np.linspace(0.0, TIME_S, 501)
    speed, acceleration, least, slope = optimum(t)
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(12, 3.6), layout="constrained")
    left.plot(t, speed, label="analytic")
    middle.plot(t, acceleration, label="analytic")

    errors = {}
    print(f"{'N':>4} {'cost':>9} {'error':>8}   (analytic cost {least:.4f} m^2/s^3)")
    for intervals in (10, 20, 40, 80, 160):
        planner = dscp.Planner(double_integrator, intervals=intervals)
        outcome = planner.plan()
        errors[intervals] = abs(outcome.cost - least)
        print(f"{intervals:4} {outcome.cost:9.5f} {errors[intervals]:8.5f}")
        if intervals == 20:
            left.plot(outcome.plan.times_s, outcome.plan.states[:, 1], "o", label="planned, N = 20")
            middle.plot(outcome.plan.times_s, outcome.plan.controls[:, 0], "o")
    gradient = planner.gradient("cost")
    print(outcome.headline)
    print(f"d cost / d speed_max: {gradient['speed_max']:.4f}, analytic {slope:.4f}")

    right.loglog(errors.keys(), errors.values(), "o-", label="error of the cost")
    counts = np.array(list(errors))
    right.loglog(counts, errors[160] * (160 / counts) ** 2, "k--", label="second order")
    left.axhline(SPEED_M_S, color="grey", linestyle=":", label="limit")
    for axes, title in ((left, "speed [m/s]"), (middle, "acceleration [m/s²]")):
        axes.set(title=title, xlabel="time [s]")
    right.set(title="error [m²/s³]", xlabel="number of intervals N")
    right.set_xticks(counts, counts)
    right.minorticks_off()
    left.legend()
    right.legend()
    figure.savefig(output / "double_integrator.png", dpi=120)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, default=Path("out"))
    main(parser.parse_args().output)

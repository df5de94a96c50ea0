"""Initial guess of powered descent: the appendix's simplified problem, solved in closed form."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dscp_core.problem.declaration import TERMINAL_TIME, InitialGuess
from dscp_core.transcription.compiled import Symbol


def norm(vector: ca.SX) -> ca.SX:
    """Euclidean norm with a finite derivative at zero (1 uN against 1e5 N)."""
    return ca.sqrt(ca.sumsqr(vector) + 1e-12)


def target(p: Mapping[str, Symbol]) -> Symbol:
    """Where a plan ends: the gate above the landing point, (3, 1)."""
    return p["final_position"] + ca.vertcat(p["gate_height"], 0, 0)


def _trapezoid_sums(intervals: int) -> NDArray[np.float64]:
    """Matrix M with (M f)_n = sum over k < n of (f_k + f_{k+1}) / 2."""
    sums = np.zeros((intervals + 1, intervals + 1))
    for n in range(1, intervals + 1):
        sums[n] = sums[n - 1]
        sums[n, n - 1] += 0.5
        sums[n, n] += 0.5
    return sums


def _least_norm_flight(p: Mapping[str, ca.MX], intervals: int) -> tuple[ca.MX, ca.MX, ca.MX]:
    """Position, velocity, thrust of the appendix's simplified problem, each (3, N+1).

    With the mass constant the axes decouple and the two end conditions of each are linear in the
    acceleration, so that the least-norm solution is explicit.
    """
    step = p[TERMINAL_TIME] / intervals
    sums = _trapezoid_sums(intervals)
    ends = np.vstack([sums[-1], sums[-1] @ sums])
    right_inverse = ca.DM(ends.T @ np.linalg.inv(ends @ ends.T))
    gravity = ca.vertcat(-p["gravity"], 0, 0)
    ones = ca.DM.ones(1, intervals + 1)
    elapsed = step * ca.DM(np.arange(intervals + 1.0)).T
    coasting = ca.mtimes(p["initial_velocity"], ones) + ca.mtimes(gravity, elapsed)
    speed_gap = p["final_velocity"] - coasting[:, -1]
    travelled = step * ca.mtimes(coasting, ca.DM(sums[-1]))
    position_gap = target(p) - p["initial_position"] - travelled
    gaps = ca.horzcat(speed_gap / step, position_gap / step**2)
    acceleration = ca.mtimes(gaps, right_inverse.T)
    velocity = coasting + step * ca.mtimes(acceleration, ca.DM(sums.T))
    position = ca.mtimes(p["initial_position"], ones) + step * ca.mtimes(velocity, ca.DM(sums.T))
    return position, velocity, p["initial_mass"] * acceleration


def _thrust_projection() -> ca.Function:
    """Projection of a thrust onto the pointing cone and [thrust_min, thrust_max].

    Without it the first subproblem is infeasible for about half of the states: a reference that
    points away from the cone turns the linearised lower bound against it.
    """
    thrust = ca.SX.sym("thrust", 3)
    low, high, angle = ca.SX.sym("low"), ca.SX.sym("high"), ca.SX.sym("angle")
    lateral = norm(thrust[1:3])
    inside = lateral * ca.cos(angle) <= thrust[0] * ca.sin(angle)
    along = thrust[0] * ca.cos(angle) + lateral * ca.sin(angle)
    on_cone = along * ca.vertcat(ca.cos(angle), thrust[1:3] * (ca.sin(angle) / lateral))
    on_axis = ca.vertcat(low, 0, 0)
    pointed = ca.if_else(inside, thrust, ca.if_else(along > 0, on_cone, on_axis))
    size = norm(pointed)
    bounded = pointed * (ca.fmin(ca.fmax(size, low), high) / size)
    usable = ca.if_else(size > 1e-3 * low, bounded, on_axis)
    return ca.Function("thrust_projection", [thrust, low, high, angle], [usable])


def raw_guess(p: Mapping[str, ca.MX], intervals: int) -> InitialGuess:
    """The appendix's guess: thrust bounds and mass flow disregarded."""
    position, velocity, thrust = _least_norm_flight(p, intervals)
    mass = ca.repmat(p["initial_mass"], 1, intervals + 1)
    return InitialGuess(ca.vertcat(position, velocity, mass), thrust)


def projected_guess(p: Mapping[str, ca.MX], intervals: int) -> InitialGuess:
    """The appendix's guess with the thrust projected onto its bounds and the mass it burns."""
    position, velocity, raw = _least_norm_flight(p, intervals)
    project = _thrust_projection().map("project", "serial", intervals + 1, [1, 2, 3], [])
    thrust = project(raw, p["thrust_min"], p["thrust_max"], p["pointing_angle_max"])
    size = ca.sqrt(ca.sum1(thrust**2))
    flow = size / (p["specific_impulse"] * p["standard_gravity"])
    step = p[TERMINAL_TIME] / intervals
    burnt = step * ca.mtimes(flow, ca.DM(_trapezoid_sums(intervals).T))
    mass = ca.fmax(p["initial_mass"] - burnt, 0.1 * p["initial_mass"])
    return InitialGuess(ca.vertcat(position, velocity, mass), thrust)

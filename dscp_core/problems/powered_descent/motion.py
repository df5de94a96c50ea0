"""True motion of a landing: point mass, engine and attitude, to contact or the last propellant."""

from __future__ import annotations

import math
from enum import Enum

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dscp_core.problem.crossing import crossing
from dscp_core.transcription.compiled import CompiledFunction

Array = NDArray[np.float64]

LONGEST_STEP_S = 0.0125
POSITION, VELOCITY = slice(0, 3), slice(3, 6)
MASS, THRUST, DIRECTION = 6, 7, slice(8, 11)


class Event(Enum):
    """What ends a stretch of motion early: contact with the ground, or the last propellant."""

    CONTACT = "contact"
    DRY = "out of propellant"


class TrueMotion:
    """Motion of point mass, engine and attitude by fixed Runge-Kutta steps; events by bisection.

    The state (11,) is position, velocity, mass, thrust in N, direction of the thrust.
    """

    def __init__(self) -> None:
        """Compile the equations of motion, once for any vehicle and flight."""
        x, u, wind = ca.SX.sym("x", 11), ca.SX.sym("u", 4), ca.SX.sym("wind", 3)
        p, step = ca.SX.sym("p", 8), ca.SX.sym("step")
        rate = ca.Function("rate", [x, u, wind, p], [_rates(x, u, wind, p)])
        half = 0.5 * step
        k1 = rate(x, u, wind, p)
        k2 = rate(x + half * k1, u, wind, p)
        k3 = rate(x + half * k2, u, wind, p)
        k4 = rate(x + step * k3, u, wind, p)
        after = x + step / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        self._step = CompiledFunction("step", [x, u, wind, p, step], [after])

    def fly(
        self,
        state: Array,
        command: Array,
        wind: Array,
        parameters: Array,
        duration_s: float,
        ground_m: float,
        dry_kg: float,
    ) -> tuple[float, Array, Event | None]:
        """Time flown, state then, and the event that it is, if it is one.

        Args:
            state: (11,) at the start, above the ground.
            command: (4,) thrust in N and direction that the engine goes for.
            wind: (3,) acceleration, m/s^2.
            parameters: (8,) of `true_parameters`.
            duration_s: How long to fly.
            ground_m: Altitude of the ground.
            dry_kg: Mass without propellant.
        """
        shortest = min((c for c in parameters[1:3] if c > 0.0), default=math.inf)
        steps = max(1, math.ceil(duration_s / min(LONGEST_STEP_S, 0.25 * shortest) - 1e-9))
        step = duration_s / steps
        for number in range(steps):

            def after(part: float, start: Array = state) -> Array:
                return self._step(start, command, wind, parameters, np.array([part]))[0]

            end, end_s = after(step), step
            dry = state[MASS] > dry_kg >= end[MASS]
            if dry:
                end_s = crossing(lambda part: dry_kg - after(part)[MASS], step)
                end = after(end_s)
            low, low_s = end, end_s
            if end[0] > ground_m and state[3] < 0.0 < end[3]:  # it may dip below in between
                low_s = crossing(lambda part: after(part)[3], end_s)
                low = after(low_s)
            if low[0] <= ground_m:
                part = crossing(lambda part: ground_m - after(part)[0], low_s)
                return number * step + part, after(part), Event.CONTACT
            if dry:
                return number * step + end_s, end, Event.DRY
            state = end
        return duration_s, state, None


def _rates(x: ca.SX, u: ca.SX, wind: ca.SX, p: ca.SX) -> ca.SX:
    exhaust, lag, response, most, gravity, drag, thins, ground = ca.vertsplit(p)
    velocity, mass, thrust, direction = x[VELOCITY], x[MASS], x[THRUST], x[DIRECTION]
    ahead = direction / ca.sqrt(ca.sumsqr(direction))
    speed = ca.sqrt(ca.sumsqr(velocity) + 1e-30)
    air = drag * ca.exp(-(x[0] - ground) / thins) * speed * velocity
    acceleration = (thrust * ahead - air) / mass + wind - ca.vertcat(gravity, 0, 0)
    change = ca.fmin(ca.fmax((u[0] - thrust) / ca.fmax(lag, 1e-9), -most), most)
    turn = (u[1:4] - direction) / ca.fmax(response, 1e-9)
    return ca.vertcat(
        velocity,
        acceleration,
        -thrust / exhaust,
        ca.if_else(lag > 0, change, 0),
        ca.if_else(response > 0, turn, ca.DM.zeros(3)),
    )

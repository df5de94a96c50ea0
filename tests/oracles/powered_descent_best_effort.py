"""Least landing error of a powered descent as nonlinear programs, solved by IPOPT.

Three programs, one after the other, on the midpoint rule, none of it linearised: the least contact
speed; the least distance from the target at that speed; the least fuel at both. The altitude at
the end is that of the target, the glideslope has its apex where the vehicle lands, and the
terminal time is free. Neither transcription nor SCP has a part in it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_IPOPT: dict[str, Any] = {
    "tol": 1e-9,
    "constr_viol_tol": 1e-9,
    "max_iter": 500,
    "print_level": 0,
    "sb": "yes",
}
_ROUGHNESS = 1e-7
"""Weight of the thrust's changes from node to node, which else leave it undetermined."""


@dataclass(frozen=True)
class LeastError:
    """What was found.

    Attributes:
        contact_speed_m_s: Least speed error at the end.
        contact_position_m: Least distance from the target at that speed.
        final_mass_kg: Greatest mass at both.
        terminal_time_s: Flight time of the last program that was solved.
        solved: How many of the three programs were.
    """

    contact_speed_m_s: float
    contact_position_m: float
    final_mass_kg: float
    terminal_time_s: float
    solved: int


class LeastErrorDescent:
    """The three programs of one vehicle's numbers; parameters by name as the product has them."""

    def __init__(self, values: Mapping[str, Any], intervals: int = 50) -> None:
        self._values = values
        self._count = intervals
        position = np.asarray(values["initial_position"], dtype=float)
        velocity = np.asarray(values["initial_velocity"], dtype=float)
        self._mass = float(values["initial_mass"])
        self._target = np.asarray(values["final_position"], dtype=float)
        self._speed_target = np.asarray(values["final_velocity"], dtype=float)
        self._length = max(float(np.linalg.norm(position - self._target)), 1.0)
        self._speed = max(float(np.linalg.norm(velocity)), 10.0)
        self._state_scale = np.array([self._length] * 3 + [self._speed] * 3 + [self._mass])
        self._thrust = float(values["thrust_max"])
        self._time = self._length / self._speed
        self._initial = np.concatenate([position, velocity, [self._mass]]) / self._state_scale
        self._build()

    def _build(self) -> None:
        v, count = self._values, self._count
        x = ca.SX.sym("x", 7, count + 1)
        u = ca.SX.sym("u", 3, count + 1)
        time = ca.SX.sym("time")
        speed_bound, position_bound = ca.SX.sym("speed_bound"), ca.SX.sym("position_bound")
        si = ca.DM(self._state_scale)
        states, thrust = x * ca.repmat(si, 1, count + 1), u * self._thrust
        mean_x, mean_u = (states[:, 1:] + states[:, :-1]) / 2, (thrust[:, 1:] + thrust[:, :-1]) / 2
        size = ca.sqrt(ca.sum1(mean_u**2))
        exhaust = float(v["specific_impulse"]) * float(v["standard_gravity"])
        gravity = ca.repmat(ca.DM([float(v["gravity"]), 0.0, 0.0]), 1, count)
        rates = ca.vertcat(
            mean_x[3:6, :], mean_u / ca.repmat(mean_x[6, :], 3, 1) - gravity, -size / exhaust
        )
        step = time * self._time / count
        defects = (states[:, 1:] - states[:, :-1] - step * rates) / ca.repmat(si, 1, count)
        target = ca.DM(self._target / self._length)
        equalities = [
            x[:, 0] - ca.DM(self._initial),
            ca.vec(defects),
            x[0, -1] - target[0],
        ]
        low, high = float(v["thrust_min"]) / self._thrust, 1.0
        pointing = np.tan(float(v["pointing_angle_max"]))
        slope = np.tan(float(v["glideslope_angle_max"]))
        above = x[0, 1:-1] - target[0]
        away = x[1:3, 1:-1] - ca.repmat(x[1:3, -1], 1, count - 1)
        speed_error = (x[3:6, -1] - ca.DM(self._speed_target / self._speed)) * self._speed
        position_error = (x[1:3, -1] - target[1:3]) * self._length
        fraction = float(v["mean_thrust_fraction"])
        inequalities = [
            low**2 - ca.sum1(u**2).T,
            ca.sum1(u**2).T - high**2,
            (fraction * low) ** 2 - (size.T / self._thrust) ** 2,
            ca.sum1(u[1:3, :] ** 2).T - (pointing * u[0, :].T) ** 2,
            -u[0, :].T,
            ca.sum1(away**2).T - (slope * above.T) ** 2,
            -above.T,
            float(v.get("dry_mass", 0.0)) / self._mass - x[6, 1:].T,
            (ca.sumsqr(speed_error) - speed_bound**2) / self._speed**2,
            (ca.sumsqr(position_error) - position_bound**2) / self._length**2,
        ]
        g = ca.vertcat(*equalities, *inequalities)
        n_equal = sum(e.numel() for e in equalities)
        z = ca.vertcat(time, ca.vec(x), ca.vec(u))
        rough = _ROUGHNESS * ca.sumsqr(u[:, 1:] - u[:, :-1]) / count
        costs = {
            "speed": ca.sumsqr(speed_error) / self._speed**2,
            "position": ca.sumsqr(position_error) / self._length**2,
            "fuel": -x[6, -1],
        }
        bounds = ca.vertcat(speed_bound, position_bound)
        options: dict[str, Any] = {
            "ipopt": _IPOPT,
            "print_time": False,
            "error_on_fail": False,
        }
        self._solvers = {
            name: ca.nlpsol(name, "ipopt", {"x": z, "p": bounds, "f": f + rough, "g": g}, options)
            for name, f in costs.items()
        }
        self._lower = np.concatenate([np.zeros(n_equal), np.full(g.numel() - n_equal, -np.inf)])
        self._upper = np.zeros(g.numel())
        self._g = ca.Function("g", [z, bounds], [g])
        self._n_equal = n_equal
        self._ends = ca.Function("ends", [z], [speed_error, position_error, x[6, -1] * self._mass])
        self._low = np.full(z.numel(), -np.inf)
        self._low[0] = 1e-3 * float(v["terminal_time_min"]) / self._time
        self._high = np.full(z.numel(), np.inf)
        self._high[0] = float(v["terminal_time_max"]) / self._time

    def _run(self, name: str, z: Array, speed_m_s: float, position_m: float) -> Array | None:
        solver = self._solvers[name]
        answer = solver(
            x0=z,
            p=[speed_m_s, position_m],
            lbx=self._low,
            ubx=self._high,
            lbg=self._lower,
            ubg=self._upper,
        )
        found = solver.stats()["return_status"] in ("Solve_Succeeded", "Solved_To_Acceptable_Level")
        return np.asarray(answer["x"]).ravel() if found else None

    def violation(self, states: Array, controls: Array, terminal_time_s: float) -> float:
        """Largest violation of a trajectory, (N+1, 7) and (N+1, 3), in the programs' scales."""
        z = np.concatenate(
            [
                [terminal_time_s / self._time],
                (states / self._state_scale).ravel(),
                (controls / self._thrust).ravel(),
            ]
        )
        rows = np.asarray(self._g(z, [1e9, 1e9])).ravel()
        equal, rest = rows[: self._n_equal], rows[self._n_equal :]
        return float(max(np.abs(equal).max(), rest.max()))

    def _guess(self, seconds: float, seed: int) -> Array:
        """A straight line, and a shaken thrust that hovers."""
        along = np.linspace(0.0, 1.0, self._count + 1)[:, None]
        end = np.concatenate([self._target / self._length, self._speed_target / self._speed, [0.8]])
        states = (1.0 - along) * self._initial + along * end
        hover = self._mass * float(self._values["gravity"]) / self._thrust
        thrust = np.zeros((self._count + 1, 3))
        thrust[:, 0] = np.clip(hover, float(self._values["thrust_min"]) / self._thrust, 1.0)
        thrust += 0.01 * np.random.default_rng(seed).standard_normal(thrust.shape)
        return np.concatenate([[seconds / self._time], states.ravel(), thrust.ravel()])

    def solve(
        self, times_s: Iterable[float], speed_tolerance: float, position_tolerance: float
    ) -> LeastError | None:
        """The lexicographic optimum, the best of several starts; None where no start leads to one.

        Args:
            times_s: First terminal times.
            speed_tolerance: What the later programs may add to the least speed, m/s.
            position_tolerance: What the last may add to the least distance, m.
        """
        far = 1e9
        best: LeastError | None = None
        for seed, seconds in enumerate(times_s):
            z = self._run("speed", self._guess(seconds, seed), far, far)
            if z is None:
                continue
            speed = float(np.linalg.norm(np.asarray(self._ends(z)[0])))
            if best is not None and speed > 1.001 * best.contact_speed_m_s + speed_tolerance:
                continue
            found = LeastError(speed, np.nan, np.nan, float(z[0]) * self._time, 1)
            bound = 1.001 * speed + speed_tolerance
            nearer = self._run("position", z, bound, far)
            if nearer is not None:
                position = float(np.linalg.norm(np.asarray(self._ends(nearer)[1])))
                found = LeastError(speed, position, np.nan, float(nearer[0]) * self._time, 2)
                limit = 1.001 * position + position_tolerance
                last = self._run("fuel", nearer, bound, limit)
                if last is not None:
                    mass = float(self._ends(last)[2])
                    found = LeastError(speed, position, mass, float(last[0]) * self._time, 3)
            if best is None or _before(found, best, speed_tolerance, position_tolerance):
                best = found
        return best


def _before(one: LeastError, other: LeastError, speed: float, position: float) -> bool:
    if one.contact_speed_m_s < 0.999 * other.contact_speed_m_s - speed:
        return True
    if one.solved != other.solved:
        return one.solved > other.solved
    if abs(one.contact_position_m - other.contact_position_m) > 2 * position:
        return one.contact_position_m < other.contact_position_m
    return one.final_mass_kg > other.final_mass_kg

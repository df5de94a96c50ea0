"""A subproblem of powered descent written out by hand as dense matrices.

Shares no code with the packages: dynamics and Jacobians come from the hand-written physics. The
decision vector is ``[t_f?, x[0], u[0], ..., x[N], u[N], virtual control]`` in scaled units.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from oracles.powered_descent_physics import (
    DescentParameters,
    state_jacobian,
    state_rate,
    thrust_jacobian,
)

Array = NDArray[np.float64]

MASS_KG = 38000.0
THRUST_N = 38000.0 * 150.0**2 / 5000.0
STATE_SCALE = np.array([5000.0] * 3 + [150.0] * 3 + [MASS_KG])
TIME_SCALE_S = 32.81


def vehicle(values: dict[str, Any]) -> DescentParameters:
    """The oracle's parameters from the values by name."""
    return DescentParameters(
        thrust_min_n=values["thrust_min"],
        thrust_max_n=values["thrust_max"],
        pointing_max_rad=values["pointing_angle_max"],
        glideslope_max_rad=values["glideslope_angle_max"],
        specific_impulse_s=values["specific_impulse"],
        gravity_m_s2=values["gravity"],
        mass_flow_gravity_m_s2=values["standard_gravity"],
    )


@dataclass
class DenseProgram:
    Q: Array
    c: Array
    A: Array
    b: Array
    G: Array
    h: Array


class Subproblem:
    """Builds the program about a reference, block by block."""

    def __init__(
        self,
        states: Array,
        controls: Array,
        time_s: float,
        values: dict[str, Any],
        cost_scale_kg: float,
        *,
        free: bool,
    ) -> None:
        """Take the reference: states (N+1, 7), controls (N+1, 3) and terminal time, all SI."""
        self.cost_scale_kg = cost_scale_kg
        self.states, self.controls, self.time_s = states, controls, time_s
        self.values, self.vehicle, self.offset = values, vehicle(values), int(free)
        self.intervals = states.shape[0] - 1
        self.step_s = time_s / self.intervals
        nodes = np.hstack([states / STATE_SCALE, controls / THRUST_N]).ravel()
        self.reference = np.concatenate([[time_s / TIME_SCALE_S] * self.offset, nodes])

    def x(self, node: int) -> slice:
        start = self.offset + 10 * node
        return slice(start, start + 7)

    def u(self, node: int) -> slice:
        start = self.offset + 10 * node + 7
        return slice(start, start + 3)

    def build(self, *, printed: bool) -> DenseProgram:
        """The program in the standard form of the cone solvers."""
        relaxed = np.arange(7) if printed else np.arange(3, 6)
        size = self.reference.size + self.intervals * relaxed.size
        a, b = self._dynamics(size, relaxed, STATE_SCALE if printed else np.ones(7))
        rows = self._rows(size, printed)
        q, c = self._costs(size, printed)
        return DenseProgram(
            q, c, a, b, np.array([r for r, _ in rows]), np.array([v for _, v in rows])
        )

    def _dynamics(
        self, size: int, relaxed: NDArray[np.int_], virtual_scale: Array
    ) -> tuple[Array, Array]:
        count, step = self.intervals, self.step_s
        a, b = np.zeros((7 * count + 13, size)), np.zeros(7 * count + 13)
        for n in range(count):
            row = slice(7 * n, 7 * n + 7)
            state = (self.states[n] + self.states[n + 1]) / 2
            thrust = (self.controls[n] + self.controls[n + 1]) / 2
            rate = state_rate(state, thrust, self.vehicle)
            f_x = state_jacobian(state, thrust) * STATE_SCALE / STATE_SCALE[:, None]
            f_u = thrust_jacobian(state, thrust, self.vehicle) * THRUST_N / STATE_SCALE[:, None]
            a[row, self.x(n)] = -np.eye(7) - step / 2 * f_x
            a[row, self.x(n + 1)] = np.eye(7) - step / 2 * f_x
            a[row, self.u(n)] = a[row, self.u(n + 1)] = -step / 2 * f_u
            if self.offset:
                a[row, 0] = -TIME_SCALE_S / count * rate / STATE_SCALE
            defect = (self.states[n + 1] - self.states[n] - step * rate) / STATE_SCALE
            b[row] = a[row, : self.reference.size] @ self.reference - defect
            for k, state_index in enumerate(relaxed):
                column = self.reference.size + n * relaxed.size + k
                a[7 * n + state_index, column] = -(virtual_scale / STATE_SCALE)[state_index]
        start, values = 7 * count, self.values
        a[start : start + 7, self.x(0)] = np.eye(7)
        b[start : start + 6] = (
            np.concatenate([values["initial_position"], values["initial_velocity"]])
            / STATE_SCALE[:6]
        )
        b[start + 6] = values["initial_mass"] / MASS_KG
        a[start + 7 :, self.x(count)] = np.eye(6, 7)
        b[start + 7 :] = (
            np.concatenate([values["final_position"], values["final_velocity"]]) / STATE_SCALE[:6]
        )
        b[start + 7] += values["gate_height"] / STATE_SCALE[0]
        return a, b

    def _rows(self, size: int, printed: bool) -> list[tuple[Array, float]]:
        """Rows of G with their entries of h, in the declared order."""
        values, nodes = self.values, range(self.intervals + 1)
        rows: list[tuple[Array, float]] = []

        def add(entries: dict[int, float], right: float) -> None:
            row = np.zeros(size)
            for column, value in entries.items():
                row[column] += value
            rows.append((row, right))

        def add_norm(places: list[int], thrust: Array, sign: float, bound: float) -> None:
            """sign (|u| - bound) <= 0, linearised at a thrust that averages these nodes."""
            along = thrust / np.linalg.norm(thrust)
            add(
                {
                    self.u(n).start + k: sign * along[k] / len(places)
                    for n in places
                    for k in range(3)
                },
                sign * bound / THRUST_N,
            )

        if self.offset:
            add({0: -1.0}, -values["terminal_time_min"] / TIME_SCALE_S)
            add({0: 1.0}, values["terminal_time_max"] / TIME_SCALE_S)
        for n in nodes:
            add_norm([n], self.controls[n], -1.0, values["thrust_min"])
        if printed:
            for n in nodes:
                add_norm([n], self.controls[n], 1.0, values["thrust_max"])
        else:
            for n in range(self.intervals):
                mean = (self.controls[n] + self.controls[n + 1]) / 2
                least_n = values["mean_thrust_fraction"] * values["thrust_min"]
                add_norm([n, n + 1], mean, -1.0, least_n)
        add({self.x(self.intervals).stop - 1: -1.0}, -values["dry_mass"] / MASS_KG)
        if not printed:
            for n in nodes:
                add({}, values["thrust_max"] / THRUST_N)
                for k in range(3):
                    add({self.u(n).start + k: -1.0}, 0.0)

        def add_cone(slope_rad: float, column: int, apex: Array) -> None:
            """cos(slope) |lateral| <= sin(slope) axial, relative to an apex."""
            axial, lateral = -math.sin(slope_rad), -math.cos(slope_rad)
            add({column: axial}, axial * apex[0])
            for k in (1, 2):
                add({column + k: lateral}, lateral * apex[k])

        origin, tilt = np.zeros(3), values["contact_tilt_max"]
        for n in range(self.intervals - 1):
            add_cone(values["pointing_angle_max"], self.u(n).start, origin)
        target = np.asarray(values["final_position"]) / STATE_SCALE[:3]
        for n in range(1, self.intervals):
            add_cone(values["glideslope_angle_max"], self.x(n).start, target)
        for n in (self.intervals - 1, self.intervals):
            add_cone(min(tilt, values["pointing_angle_max"]), self.u(n).start, origin)
        return rows

    def _costs(self, size: int, printed: bool) -> tuple[Array, Array]:
        values = self.values
        q, c = np.zeros((size, size)), np.zeros(size)
        trust = np.concatenate([values["trust_region_state"], values["trust_region_control"]])
        for n in range(self.intervals + 1):
            node = slice(self.x(n).start, self.u(n).stop)
            q[node, node] += np.diag(2 * trust)
            if not printed:
                prox = 2 * values["thrust_prox"] * MASS_KG / self.cost_scale_kg
                q[self.u(n), self.u(n)] += prox * np.eye(3)
        if not printed:
            flow = 1.0 / (values["specific_impulse"] * values["standard_gravity"])
            for n in range(self.intervals):
                mean = (self.controls[n] + self.controls[n + 1]) / 2
                along = mean / np.linalg.norm(mean)
                across = np.eye(3) - np.outer(along, along)
                # Second derivative of T flow |across dmean|^2 / (2 |mean|), dmean half of each.
                block = self.step_s * flow * across / np.linalg.norm(mean) / 4
                for first in (n, n + 1):
                    for second in (n, n + 1):
                        q[self.u(first), self.u(second)] += block * THRUST_N**2 / self.cost_scale_kg
        if self.offset:
            relative = self.time_s / TIME_SCALE_S
            q[0, 0] += 2 * values["trust_region_step"] / relative**2
        # All quadratic terms so far are centred on the reference.
        c[: self.reference.size] = -q[: self.reference.size, : self.reference.size] @ self.reference
        c[self.x(self.intervals).stop - 1] -= values["fuel_weight"] * MASS_KG / self.cost_scale_kg
        if self.offset:
            c[0] += values["time_weight"] * TIME_SCALE_S / self.cost_scale_kg
        tail = np.arange(self.reference.size, size)
        q[tail, tail] = 2 * values["virtual_control_weight"] / self.cost_scale_kg
        return q, c

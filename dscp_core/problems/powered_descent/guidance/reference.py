"""A plan as the tracker follows it: thrust, position, velocity and mass at any time."""

from __future__ import annotations

import numpy as np

from dscp_core.problem.flight import ControlHold
from dscp_core.problem.trajectory import Plan
from dscp_core.problems.powered_descent.guidance.vehicle import Array


class Reference:
    """One plan, from the time that it starts at.

    Between the nodes the thrust is held as it was planned; the position is the cubic through the
    nodes' positions and velocities, which is exact for an acceleration linear in time.
    """

    def __init__(self, plan: Plan, start_s: float, hold: ControlHold) -> None:
        self.plan, self.start_s = plan, start_s
        self.end_s = start_s + plan.terminal_time_s
        self._times, self._states = plan.times_s, plan.states
        steps = np.diff(plan.times_s)[:, np.newaxis]
        means = 0.5 * (plan.controls[1:] + plan.controls[:-1])
        self._impulse = np.vstack([np.zeros(3), np.cumsum(means * steps, axis=0)])
        self._controls = plan.controls if hold is ControlHold.LINEAR else None

    def thrust(self, time_s: float, held_s: float) -> Array:
        """Mean planned thrust (3,) in N over a time from then on."""
        begin, end = self._burnt(time_s), self._burnt(time_s + held_s)
        inside_s = min(time_s + held_s, self.end_s) - max(time_s, self.start_s)
        if inside_s <= 1e-9:
            last = -1 if self._controls is not None else slice(-2, None)
            return np.asarray(np.atleast_2d(self.plan.controls[last]).mean(axis=0))
        return np.asarray((end - begin) / inside_s)

    def state(self, time_s: float) -> tuple[Array, Array, float]:
        """Planned position (3,), velocity (3,) and mass; beyond the ends, those of the ends."""
        index, s, step = self._place(time_s)
        before, after = self._states[index], self._states[index + 1]
        r0, v0, r1, v1 = before[0:3], before[3:6] * step, after[0:3], after[3:6] * step
        c, d = 3.0 * (r1 - r0) - 2.0 * v0 - v1, 2.0 * (r0 - r1) + v0 + v1
        position = r0 + s * (v0 + s * (c + s * d))
        velocity = (v0 + s * (2.0 * c + 3.0 * s * d)) / step
        return position, velocity, float(before[6] + s * (after[6] - before[6]))

    def _place(self, time_s: float) -> tuple[int, float, float]:
        """Interval, part of it that has passed, and its length."""
        since_s = time_s - self.start_s
        index = int(np.searchsorted(self._times, since_s, side="right")) - 1
        index = min(max(index, 0), len(self._times) - 2)
        step = float(self._times[index + 1] - self._times[index])
        return index, min(max((since_s - float(self._times[index])) / step, 0.0), 1.0), step

    def _burnt(self, time_s: float) -> Array:
        """Impulse (3,) in N s from the start to then."""
        index, s, step = self._place(time_s)
        before, after = self._impulse[index], self._impulse[index + 1]
        if self._controls is None:
            return np.asarray(before + s * (after - before))
        u0, u1 = self._controls[index], self._controls[index + 1]
        return np.asarray(before + step * s * (u0 + 0.5 * s * (u1 - u0)))

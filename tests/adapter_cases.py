"""Cases shared by the adapter tests."""

from __future__ import annotations

import numpy as np
from nav_msgs.msg import Path

from dscp_core import problems
from dscp_core.problem.trajectory import Plan
from dscp_core.problems.powered_descent.messages import LANDING_FRAME
from msg_adapters.frames import Array, rotate
from msg_adapters.layout import StateLayout, problem_layout
from msg_adapters.path import poses_from_path

STATE_NAMES = ("x", "y", "z", "vx", "vy", "vz", "mass")
CONTROL_NAMES = ("thrust_x", "thrust_y", "thrust_z")
CONTROL_STATES = (3, 4, 5)
STAMP_NS = 12_000_000_345
LAYOUT: StateLayout = problem_layout(problems.get("powered_descent"))


def example_plan(nodes: int = 6) -> Plan:
    """A plan of constant thrust whose axes all differ, so that a swapped axis shows."""
    times = np.linspace(0.0, 10.0 / 3.0, nodes)
    acceleration = np.array([2.0, -0.5, 0.25])
    position = np.array([500.0, 30.0, -20.0])
    velocity = np.array([-60.0, 4.0, -3.0])
    t = times[:, None]
    positions = position + velocity * t + 0.5 * acceleration * t**2
    velocities = velocity + acceleration * t
    mass = 2000.0 - 3.0 * t
    ones = np.ones((nodes, 1))
    return Plan(
        problem="powered_descent",
        state_names=STATE_NAMES,
        control_names=CONTROL_NAMES,
        control_states=CONTROL_STATES,
        times_s=times,
        states=np.hstack([positions, velocities, mass]),
        controls=ones * np.array([23000.0, -1000.0, 500.0]),
        state_rates=np.hstack([velocities, ones * acceleration, -3.0 * ones]),
        terminal_time_s=float(times[-1]),
    )


def points_from_path(message: Path, *, frame: str = LANDING_FRAME) -> tuple[Array, Array]:
    """Positions and thrust directions of a landing's path, both (N+1, 3) in the landing frame."""
    positions, attitudes = poses_from_path(message, frame=frame)
    up = np.array([0.0, 0.0, 1.0])
    return positions, np.array([rotate(attitude, up) for attitude in attitudes]).reshape(-1, 3)

"""trajectory_msgs/JointTrajectory: a plan as a trajectory of named scalars.

Per point, in message order: ``positions`` are the states, ``velocities`` their rates of change.
Controls stand in one of three forms (`msg_adapters.layout.ControlForm`). Those that act on a state
each, as the problem declares by ``control_states``, stand there: in ``effort``, zero elsewhere (for
a landing the thrust in newtons at vx, vy, vz), or, if they are the rates of these states, as what
``velocities`` holds for them, and ``effort`` stays empty. All others have names of their own after
those of the states, their values in ``positions`` and zero in ``velocities``; ``effort`` stays
empty. So do ``accelerations``. The header's stamp is that of the state the plan starts from, so
``time_from_start`` counts from there.
"""

from __future__ import annotations

import array
from typing import TYPE_CHECKING

import numpy as np
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from msg_adapters.checks import require_finite, require_frame, require_length, require_names
from msg_adapters.errors import InputCode, RejectedInputError
from msg_adapters.frames import Array
from msg_adapters.layout import ControlForm, StateLayout
from msg_adapters.stamps import (
    duration_from_nanoseconds,
    nanoseconds_from_duration,
    nanoseconds_from_seconds,
    nanoseconds_from_stamp,
    seconds_from_nanoseconds,
    stamp_from_nanoseconds,
)

if TYPE_CHECKING:
    from dscp_core.problem.trajectory import Plan


class TrajectoryEncoder:
    """Fills one preallocated message again and again: a tenth of the time of building it anew.

    The message that `encode` returns is overwritten by the next call; publish or serialise it
    first. Not safe for use by several threads at once.
    """

    def __init__(self, layout: StateLayout, nodes: int, *, frame: str | None = None) -> None:
        """Preallocate.

        Args:
            layout: Names and order of the state.
            nodes: Number of trajectory points.
            frame: ``header.frame_id``; that of the layout if None.
        """
        self._layout = layout
        self._fields = _fields(layout)
        size = len(layout.joint_names)
        self._message = JointTrajectory()
        self._message.header.frame_id = frame or layout.frame
        self._message.joint_names = list(layout.joint_names)
        self._message.points = [
            JointTrajectoryPoint(
                **{field: array.array("d", bytes(8 * size)) for field in self._fields}
            )
            for _ in range(nodes)
        ]
        # Views of the message's own buffers, one row of fields per point.
        self._views = [
            tuple(np.frombuffer(getattr(p, f), dtype=np.float64) for f in self._fields)
            for p in self._message.points
        ]

    @property
    def nodes(self) -> int:
        """Number of points of the message."""
        return len(self._views)

    def encode(self, plan: Plan, stamp_ns: int) -> JointTrajectory:
        """Write a plan into the message.

        Args:
            plan: With as many nodes as the message has points.
            stamp_ns: Time of the state that the plan starts from.

        Raises:
            RejectedInputError: WRONG_ARRAY_LENGTH, or NOT_FINITE for any number of the plan.
        """
        require_length("plan.times_s", len(plan.times_s), self.nodes)
        for field, block in (
            ("times_s", plan.times_s),
            ("states", plan.states),
            ("state_rates", plan.state_rates),
            ("controls", plan.controls),
        ):
            if not np.all(np.isfinite(block)):
                raise RejectedInputError(
                    InputCode.NOT_FINITE, f"plan.{field}", "NaN or infinity", "finite"
                )
        self._message.header.stamp = stamp_from_nanoseconds(stamp_ns)
        blocks = self._blocks(plan)
        for k, (point, views) in enumerate(zip(self._message.points, self._views, strict=True)):
            for view, block in zip(views, blocks, strict=True):
                view[:] = block[k]
            nanoseconds = nanoseconds_from_seconds(plan.times_s[k])
            point.time_from_start = duration_from_nanoseconds(nanoseconds)
        return self._message

    def _blocks(self, plan: Plan) -> list[Array]:
        """What each field holds, (N+1, names)."""
        layout = self._layout
        contents = {
            "positions": plan.states,
            "velocities": plan.state_rates.copy(),
            "effort": np.zeros_like(plan.states),
        }
        if layout.control_form is not ControlForm.NAMED:
            contents[layout.control_form.value][:, list(layout.control_states)] = plan.controls
        blocks = [layout.to_message_order(contents[field]) for field in self._fields]
        if layout.control_form is ControlForm.NAMED:
            own = (plan.controls, np.zeros_like(plan.controls))
            blocks = [np.hstack(pair) for pair in zip(blocks, own, strict=True)]
        return blocks


def trajectory_from_plan(
    plan: Plan, stamp_ns: int, layout: StateLayout, *, frame: str | None = None
) -> JointTrajectory:
    """A new message of one plan; `TrajectoryEncoder` is faster for many.

    Raises:
        RejectedInputError: NOT_FINITE.
    """
    return TrajectoryEncoder(layout, len(plan.times_s), frame=frame).encode(plan, stamp_ns)


def plan_from_trajectory(
    message: JointTrajectory, layout: StateLayout, *, frame: str | None = None
) -> tuple[Plan, int]:
    """Plan and start time of a message, whatever the order of its names.

    Times are exact to the nanosecond that the message holds.

    Args:
        message: The message.
        layout: Names and order of the problem's state.
        frame: Expected ``header.frame_id``; that of the layout if None.

    Returns:
        The plan, and the stamp of its start in nanoseconds.

    Raises:
        RejectedInputError: NOT_FINITE, EMPTY_FRAME, WRONG_FRAME, DUPLICATE_NAME, UNKNOWN_NAME,
            MISSING_NAME, WRONG_ARRAY_LENGTH, TIME_NOT_INCREASING or INVALID_STAMP, in this order.
    """
    from dscp_core.problem.trajectory import Plan

    for k, point in enumerate(message.points):
        for field in ("positions", "velocities", "effort"):
            values = getattr(point, field)
            require_finite((f"points[{k}].{field}[{i}]", v) for i, v in enumerate(values))
    require_frame("header.frame_id", message.header.frame_id, frame or layout.frame)
    require_names("joint_names", message.joint_names, layout.joint_names)
    size = len(layout.joint_names)
    filled = _fields(layout)
    for k, point in enumerate(message.points):
        for field in ("positions", "velocities", "effort"):
            expected = size if field in filled else 0
            require_length(f"points[{k}].{field}", len(getattr(point, field)), expected)
    times_s = _times_s(message)
    stamp_ns = nanoseconds_from_stamp(message.header.stamp)

    columns = [list(message.joint_names).index(name) for name in layout.joint_names]
    states = len(layout.message_names)

    def table(field: str) -> Array:
        rows = np.array([getattr(p, field) for p in message.points], dtype=np.float64)
        return rows[:, columns]

    def of_states(field: str) -> Array:
        return layout.to_core_order(table(field)[:, :states])

    if layout.control_form is ControlForm.NAMED:
        controls = table("positions")[:, states:]
    else:
        controls = of_states(layout.control_form.value)[:, list(layout.control_states)]
    plan = Plan(
        problem=layout.problem,
        state_names=layout.state_names,
        control_names=layout.control_names,
        control_states=layout.control_states,
        times_s=times_s,
        states=of_states("positions"),
        controls=controls,
        state_rates=of_states("velocities"),
        terminal_time_s=float(times_s[-1]),
    )
    return plan, stamp_ns


def _fields(layout: StateLayout) -> tuple[str, ...]:
    """Fields of a point that hold numbers."""
    with_forces = layout.control_form is ControlForm.EFFORT
    return ("positions", "velocities", "effort") if with_forces else ("positions", "velocities")


def _times_s(message: JointTrajectory) -> Array:
    """Times of the points, which start at zero and increase."""
    if len(message.points) < 2:
        raise RejectedInputError(
            InputCode.WRONG_ARRAY_LENGTH, "points length", len(message.points), ">= 2"
        )
    nanoseconds = [nanoseconds_from_duration(p.time_from_start) for p in message.points]
    field = "points[{}].time_from_start"
    if nanoseconds[0] != 0:
        raise RejectedInputError(
            InputCode.TIME_NOT_INCREASING, field.format(0), nanoseconds[0], "0 ns"
        )
    for k in range(1, len(nanoseconds)):
        if nanoseconds[k] <= nanoseconds[k - 1]:
            bound = f"> {nanoseconds[k - 1]} ns"
            raise RejectedInputError(
                InputCode.TIME_NOT_INCREASING, field.format(k), nanoseconds[k], bound
            )
    return np.array([seconds_from_nanoseconds(ns) for ns in nanoseconds])

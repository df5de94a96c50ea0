from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from adapter_cases import LAYOUT, STAMP_NS, example_plan
from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message
from trajectory_msgs.msg import JointTrajectory

from msg_adapters.errors import InputCode, RejectedInputError
from msg_adapters.trajectory import (
    TrajectoryEncoder,
    plan_from_trajectory,
    trajectory_from_plan,
)


def message() -> JointTrajectory:
    return trajectory_from_plan(example_plan(), STAMP_NS, LAYOUT)


def decode(trajectory: JointTrajectory):
    return plan_from_trajectory(trajectory, LAYOUT)


def refusal(trajectory: JointTrajectory) -> RejectedInputError:
    with pytest.raises(RejectedInputError) as caught:
        decode(trajectory)
    return caught.value


def test_round_trip_through_the_wire():
    plan = example_plan()
    decoded, stamp_ns = decode(deserialize_message(serialize_message(message()), JointTrajectory))
    assert stamp_ns == STAMP_NS
    for field in ("states", "controls", "state_rates"):
        assert np.array_equal(getattr(decoded, field), getattr(plan, field)), field
    # Times are rounded to the nanosecond.
    assert np.allclose(decoded.times_s, plan.times_s, rtol=0.0, atol=0.5e-9)
    for field in ("problem", "state_names", "control_names", "control_states"):
        assert getattr(decoded, field) == getattr(plan, field), field


def test_layout_of_a_point():
    trajectory = message()
    assert list(trajectory.joint_names) == ["x", "y", "z", "vx", "vy", "vz", "mass"]
    assert trajectory.header.frame_id == "landing_site"
    assert (trajectory.header.stamp.sec, trajectory.header.stamp.nanosec) == (12, 345)
    first = trajectory.points[0]
    assert list(first.positions) == [30.0, -20.0, 500.0, 4.0, -3.0, -60.0, 2000.0]
    assert list(first.velocities) == [4.0, -3.0, -60.0, -0.5, 0.25, 2.0, -3.0]
    assert list(first.effort) == [0.0, 0.0, 0.0, -1000.0, 500.0, 23000.0, 0.0]
    assert len(first.accelerations) == 0


def test_time_from_start_is_exact_to_the_nanosecond():
    last = message().points[-1].time_from_start
    assert (last.sec, last.nanosec) == (3, 333_333_333)


def test_names_may_come_in_any_order():
    trajectory = message()
    order = [6, 2, 4, 0, 5, 1, 3]
    trajectory.joint_names = [trajectory.joint_names[i] for i in order]
    for point in trajectory.points:
        for field in ("positions", "velocities", "effort"):
            values = getattr(point, field)
            setattr(point, field, [values[i] for i in order])
    decoded, _ = decode(trajectory)
    assert np.array_equal(decoded.states, example_plan().states)
    assert np.array_equal(decoded.controls, example_plan().controls)


def test_refilled_message_equals_a_new_one():
    plan = example_plan()
    encoder = TrajectoryEncoder(LAYOUT, len(plan.times_s))
    encoder.encode(replace(plan, states=plan.states + 1.0, controls=plan.controls * 2.0), 5)
    assert encoder.encode(plan, STAMP_NS) == message()


@pytest.mark.parametrize("field", ["times_s", "states", "state_rates", "controls"])
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_nan_is_never_written(field, bad):
    plan = example_plan()
    block = getattr(plan, field).copy()
    block[-1] = bad
    with pytest.raises(RejectedInputError, match=field) as caught:
        trajectory_from_plan(replace(plan, **{field: block}), STAMP_NS, LAYOUT)
    assert caught.value.code is InputCode.NOT_FINITE


def test_encoder_refuses_another_number_of_nodes():
    encoder = TrajectoryEncoder(LAYOUT, 4)
    with pytest.raises(RejectedInputError) as caught:
        encoder.encode(example_plan(6), STAMP_NS)
    assert caught.value.code is InputCode.WRONG_ARRAY_LENGTH


def _edit_names(trajectory):
    trajectory.joint_names[0] = "q"


def _edit_missing_name(trajectory):
    trajectory.joint_names = trajectory.joint_names[1:]


def _edit_nan(trajectory):
    trajectory.points[2].velocities[3] = math.nan


def _edit_short(trajectory):
    trajectory.points[1].effort = [0.0]


def _edit_frame(trajectory):
    trajectory.header.frame_id = "map"


def _edit_empty_frame(trajectory):
    trajectory.header.frame_id = ""


def _edit_time(trajectory):
    trajectory.points[3].time_from_start.sec = 0


def _edit_start(trajectory):
    trajectory.points[0].time_from_start.nanosec = 1


def _edit_empty(trajectory):
    trajectory.points = []


def _edit_stamp(trajectory):
    trajectory.header.stamp.sec = -1


@pytest.mark.parametrize(
    ("edit", "code"),
    [
        (_edit_names, InputCode.UNKNOWN_NAME),
        (_edit_missing_name, InputCode.MISSING_NAME),
        (_edit_nan, InputCode.NOT_FINITE),
        (_edit_short, InputCode.WRONG_ARRAY_LENGTH),
        (_edit_frame, InputCode.WRONG_FRAME),
        (_edit_empty_frame, InputCode.EMPTY_FRAME),
        (_edit_time, InputCode.TIME_NOT_INCREASING),
        (_edit_start, InputCode.TIME_NOT_INCREASING),
        (_edit_empty, InputCode.WRONG_ARRAY_LENGTH),
        (_edit_stamp, InputCode.INVALID_STAMP),
    ],
)
def test_bad_trajectory_is_refused_by_its_number(edit, code):
    trajectory = message()
    edit(trajectory)
    assert refusal(trajectory).code is code


@given(
    st.lists(st.floats(width=64), max_size=8),
    st.integers(-(2**31), 2**31 - 1),
    st.integers(0, 2**32 - 1),
)
def test_any_point_gives_a_plan_or_a_numbered_error(values, sec, nanosec):
    trajectory = message()
    point = trajectory.points[3]
    point.positions = values
    point.time_from_start.sec, point.time_from_start.nanosec = sec, nanosec
    try:
        plan, _ = decode(trajectory)
    except RejectedInputError:
        return
    assert np.all(np.isfinite(plan.states))
    assert np.all(np.diff(plan.times_s) > 0.0)

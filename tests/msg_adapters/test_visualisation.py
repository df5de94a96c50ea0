from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from adapter_cases import STAMP_NS, example_plan, points_from_path
from nav_msgs.msg import Path
from rclpy.serialization import deserialize_message, serialize_message
from visualization_msgs.msg import Marker, MarkerArray

from dscp_core.errors import InvalidInputError
from dscp_core.problems.powered_descent.messages import LANDING_FRAME
from dscp_core.problems.powered_descent.scene import DescentStyle, descent_scene
from msg_adapters.drawing import Drawing, no_markers
from msg_adapters.errors import InputCode, RejectedInputError

STYLE = DescentStyle(thrust_arrow_m=50.0, line_width_m=2.0, glideslope_angle_rad=math.radians(60.0))


def path_from_plan(plan, stamp_ns):
    return draw(plan, stamp_ns, STYLE)[0]


def markers_from_plan(plan, stamp_ns, style):
    return draw(plan, stamp_ns, style)[1]


def draw(plan, stamp_ns, style):
    drawing = Drawing(lambda plan, *_: descent_scene(plan, style), {}, {})
    return drawing.draw(plan, stamp_ns, frame=LANDING_FRAME)


def vector(point):
    return np.array([point.x, point.y, point.z])


def test_path_holds_positions_and_thrust_directions():
    plan = example_plan()
    path = deserialize_message(serialize_message(path_from_plan(plan, STAMP_NS)), Path)
    positions, directions = points_from_path(path)
    assert np.array_equal(positions, plan.states[:, [1, 2, 0]])
    thrust = np.array([-1000.0, 500.0, 23000.0])
    # Two rotations of a unit vector: a few roundings.
    assert np.allclose(directions, thrust / np.linalg.norm(thrust), rtol=0.0, atol=1e-14)


def test_poses_are_stamped_with_the_time_of_their_node():
    path = path_from_plan(example_plan(), STAMP_NS)
    assert (path.header.stamp.sec, path.header.stamp.nanosec) == (12, 345)
    last = path.poses[-1].header
    assert (last.stamp.sec, last.stamp.nanosec) == (15, 333_333_678)
    assert last.frame_id == path.header.frame_id == "landing_site"


def _edit_nan(path):
    path.poses[1].pose.position.x = math.nan


def _edit_frame(path):
    path.header.frame_id = "map"


def _edit_orientation(path):
    path.poses[1].pose.orientation.w = 5.0


@pytest.mark.parametrize(
    ("edit", "code"),
    [
        (_edit_nan, InputCode.NOT_FINITE),
        (_edit_frame, InputCode.WRONG_FRAME),
        (_edit_orientation, InputCode.NON_UNIT_QUATERNION),
    ],
)
def test_bad_path_is_refused_by_its_number(edit, code):
    path = path_from_plan(example_plan(), STAMP_NS)
    edit(path)
    with pytest.raises(RejectedInputError) as caught:
        points_from_path(path)
    assert caught.value.code is code


def test_markers_have_unique_fixed_ids():
    first = markers_from_plan(example_plan(), STAMP_NS, STYLE)
    second = markers_from_plan(example_plan(), STAMP_NS + 1, STYLE)
    keys = [(marker.ns, marker.id) for marker in first.markers]
    assert len(set(keys)) == len(keys)
    assert keys == [(marker.ns, marker.id) for marker in second.markers]
    assert {marker.action for marker in first.markers} == {Marker.ADD}


def test_arrows_point_along_the_thrust():
    plan = example_plan()
    controls = plan.controls.copy()
    controls[0] *= 0.5
    markers = markers_from_plan(replace(plan, controls=controls), STAMP_NS, STYLE).markers
    arrows = [marker for marker in markers if marker.ns == "thrust"]
    assert len(arrows) == len(plan.times_s)
    lengths = [np.linalg.norm(vector(a.points[1]) - vector(a.points[0])) for a in arrows]
    # The largest thrust has the style's length; coordinates of 1e3 m carry 1e-13 of rounding.
    assert lengths == pytest.approx([25.0] + [50.0] * (len(arrows) - 1), abs=1e-9)
    shaft = vector(arrows[2].points[1]) - vector(arrows[2].points[0])
    expected = np.array([-1000.0, 500.0, 23000.0])
    assert shaft / 50.0 == pytest.approx(expected / np.linalg.norm(expected), abs=1e-9)


def test_cone_has_the_glideslope_angle_and_fits_the_path():
    plan = example_plan()
    cone = next(m for m in markers_from_plan(plan, STAMP_NS, STYLE).markers if m.ns == "glideslope")
    assert cone.type == Marker.TRIANGLE_LIST
    points = np.array([vector(point) for point in cone.points])
    assert len(points) % 3 == 0
    rim = points[points[:, 2] > 0.0]
    angles = np.arctan2(np.hypot(rim[:, 0], rim[:, 1]), rim[:, 2])
    assert angles == pytest.approx(np.full(len(rim), math.radians(60.0)), abs=1e-9)
    assert rim[:, 2].max() <= plan.states[:, 0].max()


def test_no_cone_without_an_angle():
    style = replace(STYLE, glideslope_angle_rad=None)
    namespaces = {m.ns for m in markers_from_plan(example_plan(), STAMP_NS, style).markers}
    assert namespaces == {"path", "thrust"}


def test_zero_thrust_gives_finite_arrows():
    plan = example_plan()
    markers = markers_from_plan(
        replace(plan, controls=np.zeros_like(plan.controls)), STAMP_NS, STYLE
    )
    decoded = deserialize_message(serialize_message(markers), MarkerArray)
    numbers = [vector(point) for marker in decoded.markers for point in marker.points]
    assert np.all(np.isfinite(numbers))


def test_nothing_to_show_deletes_everything():
    markers = no_markers(STAMP_NS, frame="landing_site").markers
    assert [marker.action for marker in markers] == [Marker.DELETEALL]


@pytest.mark.parametrize("field", ["states", "controls"])
def test_nan_is_never_drawn(field):
    plan = example_plan()
    block = getattr(plan, field).copy()
    block[2, 0] = math.nan
    broken = replace(plan, **{field: block})
    for build in (
        lambda: path_from_plan(broken, STAMP_NS),
        lambda: markers_from_plan(broken, STAMP_NS, STYLE),
    ):
        with pytest.raises(RejectedInputError) as caught:
            build()
        assert caught.value.code is InputCode.NOT_FINITE


def test_a_plan_without_thrust_on_velocities_cannot_be_drawn():
    with pytest.raises(InvalidInputError, match="state_names"):
        path_from_plan(replace(example_plan(), control_states=(0, 1, 2)), STAMP_NS)

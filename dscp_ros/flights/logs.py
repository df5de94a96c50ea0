"""Logs of simulated flights: what navigation told a planner, as an MCAP bag."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation
from std_msgs.msg import String

from dscp_core.problem.declaration import OptimalControlProblem
from dscp_core.problem.scene import quaternion_from_z_axis
from dscp_core.problem.simulation import FlightRecord
from dscp_ros.bag import BagWriter, Qos
from msg_adapters.frames import Array
from msg_adapters.joint_state import joint_state_from_state
from msg_adapters.layout import ControlForm, StateLayout, problem_layout
from msg_adapters.mass import inertia_from_mass
from msg_adapters.odometry import odometry_from_kinematics
from msg_adapters.stamps import nanoseconds_from_seconds
from msg_adapters.state import Kinematics, StampedMass, StampedState

STATE_TOPIC, MASS_TOPIC = "/planner/state", "/planner/mass"
VEHICLE_STATE_TOPIC = "/planner/vehicle_state"
STORY_TOPIC = "/story"
RELIABLE = Qos(depth=10, reliability="reliable", durability="volatile")

START_NS = nanoseconds_from_seconds(datetime(2026, 3, 2, 9, 0, tzinfo=UTC).timestamp())
LEAD_S = 1.0
"""Story before the first state: time for subscribers to find /clock."""
EARLY_MASS_S = 0.5
"""From a first mass to the first state; the engine is off until then."""
MASS_LATENCY_S, STATE_LATENCY_S = 0.010, 0.015
"""From stamp to log time: what sensors and transport take."""
HEADING_RAD = math.radians(40.0)
"""Roll about the vertical, so that body and frame axes differ by more than the small tilt."""


class _Entry(NamedTuple):
    time_ns: int
    topic: str
    message: Any


def write_flight(
    bag: Path, problem: OptimalControlProblem, record: FlightRecord, start_ns: int = START_NS
) -> Path:
    """Write one flight; a bag that is there is replaced.

    A problem whose states are a position, a velocity and a mass is told by odometry, with the
    body's +z axis along the commanded thrust, and by the mass; any other by named scalars. Messages
    are stamped when what they tell was true, and logged when navigation tells it.

    Args:
        bag: Path of the bag.
        problem: What flew.
        record: The flight.
        start_ns: Its start on the clock.

    Returns:
        The bag.

    Raises:
        BagError: It cannot be written.
    """
    layout = problem_layout(problem)
    entries = [*_story(record, start_ns), *_states(layout, record, start_ns)]
    bag.parent.mkdir(parents=True, exist_ok=True)
    with BagWriter(bag, overwrite=True) as writer:
        for topic, kind in {entry.topic: type(entry.message) for entry in entries}.items():
            writer.add_topic(topic, kind, RELIABLE)
        for entry in sorted(entries, key=lambda entry: entry.time_ns):
            writer.write(entry.topic, entry.message, entry.time_ns)
    return bag


def _story(record: FlightRecord, start_ns: int) -> Iterator[_Entry]:
    summary = record.summary
    opening = f"closed-loop flight, simulation seed {summary.seed}"
    yield _Entry(start_ns - nanoseconds_from_seconds(LEAD_S), STORY_TOPIC, String(data=opening))
    for time_s, text in record.events:
        stamp_ns = start_ns + nanoseconds_from_seconds(time_s)
        yield _Entry(stamp_ns, STORY_TOPIC, String(data=f"{time_s:.1f} s: {text}"))
    end_s = float(record.times_s[-1])
    text = f"{end_s:.2f} s: {summary.failure or 'end'}; {summary.story}"
    stamp_ns = start_ns + nanoseconds_from_seconds(end_s + 2.0 * STATE_LATENCY_S)
    yield _Entry(stamp_ns, STORY_TOPIC, String(data=text))


def _states(layout: StateLayout, record: FlightRecord, start_ns: int) -> Iterator[_Entry]:
    lit = np.linalg.norm(record.commanded, axis=1) > 0.0
    # Until the engine is lit, the vehicle points where it will burn.
    commanded = np.where(lit[:, np.newaxis], record.commanded, record.commanded[np.argmax(lit)])
    for number, measured in enumerate(record.measured):
        told_ns, stamp_ns = (
            start_ns + nanoseconds_from_seconds(float(times[number]))
            for times in (record.times_s, record.measured_at_s)
        )
        log_ns = told_ns + nanoseconds_from_seconds(STATE_LATENCY_S)
        if layout.odometry is None:
            message = joint_state_from_state(StampedState(stamp_ns, measured), layout)
            yield _Entry(log_ns, VEHICLE_STATE_TOPIC, message)
            continue
        named = dict(zip(layout.message_names, layout.to_message_order(measured), strict=True))
        if (name := layout.odometry.mass) is not None:
            mass_kg = float(named[name])
            if number == 0:
                # Topics may overtake each other: without this, the first state can come first.
                before_ns = start_ns - nanoseconds_from_seconds(EARLY_MASS_S)
                early = inertia_from_mass(StampedMass(before_ns, mass_kg))
                yield _Entry(before_ns, MASS_TOPIC, early)
            mass_ns = told_ns + nanoseconds_from_seconds(MASS_LATENCY_S)
            yield _Entry(mass_ns, MASS_TOPIC, inertia_from_mass(StampedMass(stamp_ns, mass_kg)))
        position, velocity = (
            _vector(named, names) for names in (layout.odometry.position, layout.odometry.velocity)
        )
        attitude = _attitude(layout, commanded[number])
        odometry = odometry_from_kinematics(
            Kinematics(stamp_ns, position, velocity), frame=layout.frame, attitude=attitude
        )
        yield _Entry(log_ns, STATE_TOPIC, odometry)


def _vector(named: Mapping[str, float], names: tuple[str, str, str]) -> Array:
    return np.array([named[name] for name in names])


def _attitude(layout: StateLayout, control: Array) -> Array | None:
    """Quaternion (x, y, z, w) of a body whose +z axis points along the force on the velocity."""
    assert layout.odometry is not None
    if layout.control_form is not ControlForm.EFFORT:
        return None
    efforts = np.zeros(len(layout.state_names))
    efforts[list(layout.control_states)] = control
    named = dict(zip(layout.message_names, layout.to_message_order(efforts), strict=True))
    tilt = Rotation.from_quat(quaternion_from_z_axis(_vector(named, layout.odometry.velocity)))
    heading = Rotation.from_rotvec([0.0, 0.0, HEADING_RAD])
    return np.asarray((tilt * heading).as_quat())

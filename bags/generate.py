"""Makes the sample bags of this folder: `python bags/generate.py`.

The same numbers come out each time; README.md tells what they are.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np
from bag_parts import (
    RELIABLE,
    STORY_TOPIC,
    VEHICLE_STATE_TOPIC,
    Fault,
    set_value,
    shuffle_names,
    write_bags,
)
from geometry_msgs.msg import InertiaStamped
from nav_msgs.msg import Odometry
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from dscp_core import problems
from dscp_core.planning.plan import PlanStatus
from dscp_core.planning.planner import Planner, TerminalTime
from dscp_core.problem.scene import quaternion_from_z_axis
from dscp_core.problems.powered_descent.messages import LANDING_FRAME, message_from_core
from dscp_core.problems.powered_descent.simulation import (
    DescentRecord,
    DescentSimulation,
    Replan,
)
from dscp_ros.bag import BagWriter
from msg_adapters.errors import InputCode
from msg_adapters.frames import Array
from msg_adapters.joint_state import joint_state_from_state
from msg_adapters.layout import StateLayout, problem_layout
from msg_adapters.mass import inertia_from_mass
from msg_adapters.odometry import odometry_from_kinematics
from msg_adapters.stamps import (
    nanoseconds_from_seconds,
    stamp_from_nanoseconds,
)
from msg_adapters.state import Kinematics, StampedMass, StampedState

NOMINAL, DISPERSED = "powered_descent_nominal", "powered_descent_dispersed"
IGNITIONS_LOG, IGNITIONS_UNSEEN = "ignitions_log", "ignitions_unseen"

STATE_TOPIC = "/planner/state"
MASS_TOPIC = "/planner/mass"

DISPERSED_START_NS = nanoseconds_from_seconds(datetime(2026, 3, 2, 9, 0, tzinfo=UTC).timestamp())
NOMINAL_START_NS = nanoseconds_from_seconds(datetime(2026, 3, 2, 9, 10, tzinfo=UTC).timestamp())
"""Later than the other bag, so that the clock moves forward when both are replayed in turn."""

LEAD_S = 1.0
"""Story before the first state: time for subscribers to find /clock."""
EARLY_MASS_S = 0.5
"""From a first mass to the first state; the engine is off until then."""
MASS_LATENCY_S, STATE_LATENCY_S = 0.010, 0.015
"""From stamp to log time: what sensors and transport take."""

NOMINAL_SEED = 1
HEADING_RAD = math.radians(40.0)
"""Roll about the vertical, so that body and landing axes differ by more than the small tilt."""

DISPERSED_SEED = 7
DISPERSED_STATES = 40
DISPERSED_PERIOD_S = 0.3
POSITION_CENTRE_M, POSITION_SPREAD_M = (5200.0, 0.0, 0.0), (200.0, 600.0, 600.0)
VELOCITY_CENTRE_M_S, VELOCITY_SPREAD_M_S = (-135.0, 0.0, 0.0), (15.0, 30.0, 30.0)
MASS_KG = 38000.0

IGNITIONS_START_NS = nanoseconds_from_seconds(datetime(2026, 3, 3, 9, 0, tzinfo=UTC).timestamp())
IGNITIONS_APART_NS = nanoseconds_from_seconds(600.0)
IGNITIONS_SEEDS = {IGNITIONS_LOG: 21, IGNITIONS_UNSEEN: 22}
IGNITIONS_STATES = 60
IGNITIONS_PERIOD_S = 0.2


def write_nominal(folder: Path) -> Path:
    """Writes one closed-loop descent; returns the bag."""
    planner = Planner(problems.get("powered_descent"), terminal_time=TerminalTime.FREE)
    simulation = DescentSimulation(planner)
    record = simulation.record(NOMINAL_SEED)
    bag = folder / NOMINAL
    with BagWriter(bag, overwrite=True) as writer:
        writer.add_topic(STORY_TOPIC, String, RELIABLE)
        writer.add_topic(MASS_TOPIC, InertiaStamped, RELIABLE)
        writer.add_topic(STATE_TOPIC, Odometry, RELIABLE)
        for entry in sorted(_nominal_entries(record, simulation.truth.delay_s), key=_time):
            writer.write(entry.topic, entry.message, entry.time_ns)
    return bag


class _Entry(NamedTuple):
    time_ns: int
    topic: str
    message: String | InertiaStamped | Odometry


def _time(entry: _Entry) -> int:
    return entry.time_ns


def _nominal_entries(record: DescentRecord, delay_s: float) -> Iterable[_Entry]:
    """Everything in the bag, in no order; measurements are stamped when they were true."""

    def at(time_s: float) -> int:
        return NOMINAL_START_NS + nanoseconds_from_seconds(time_s)

    lit = np.linalg.norm(record.commanded, axis=1) > 0.0
    on_s = record.times_s[np.argmax(lit)]
    seed = record.summary.seed
    opening = f"closed-loop powered descent, simulation seed {seed}; engine on at {on_s:g} s"
    yield _Entry(at(-LEAD_S), STORY_TOPIC, String(data=opening))
    for replan in record.replans:
        time_s = record.times_s[replan.tick]
        yield _Entry(at(time_s), STORY_TOPIC, String(data=_replan_text(time_s, replan)))
    yield _Entry(at(record.times_s[-1]), STORY_TOPIC, String(data=_end_text(record)))
    # Topics may overtake each other: without this, the first state can come before its mass.
    before_ns = at(-EARLY_MASS_S)
    mass = inertia_from_mass(StampedMass(before_ns, float(record.measured[0, 6])))
    yield _Entry(before_ns, MASS_TOPIC, mass)
    # Until the engine is lit, the vehicle points where it will burn.
    commanded = np.where(lit[:, np.newaxis], record.commanded, record.commanded[np.argmax(lit)])
    for time_s, measured, thrust in zip(record.times_s, record.measured, commanded, strict=True):
        stamp_ns = at(time_s - delay_s)
        mass = inertia_from_mass(StampedMass(stamp_ns, float(measured[6])))
        yield _Entry(at(time_s + MASS_LATENCY_S), MASS_TOPIC, mass)
        kinematics = Kinematics(
            stamp_ns, message_from_core(measured[0:3]), message_from_core(measured[3:6])
        )
        odometry = odometry_from_kinematics(
            kinematics, frame=LANDING_FRAME, attitude=_attitude(thrust)
        )
        yield _Entry(at(time_s + STATE_LATENCY_S), STATE_TOPIC, odometry)


def _attitude(thrust: Array) -> Array:
    """Quaternion (x, y, z, w) of a body whose +z axis points along the thrust (core axes)."""
    tilt = Rotation.from_quat(quaternion_from_z_axis(message_from_core(thrust)))
    heading = Rotation.from_rotvec([0.0, 0.0, HEADING_RAD])
    return np.asarray((tilt * heading).as_quat())


def _replan_text(time_s: float, replan: Replan) -> str:
    outcome = replan.outcome
    if outcome is None:
        return f"{time_s:.1f} s: onboard guidance got no answer from its planner"
    return (
        f"{time_s:.1f} s: onboard guidance {outcome.status.name}, "
        f"{outcome.terminal_time_used_s:.2f} s to go, "
        f"thrust limit {replan.thrust_max_n / 1e3:.0f} kN"
    )


def _end_text(record: DescentRecord) -> str:
    return f"{record.summary.story}, {record.states[-1, 6]:.0f} kg left"


def _set_frame(frame: str) -> Callable[[JointState], None]:
    def spoil(message: JointState) -> None:
        message.header.frame_id = frame

    return spoil


def _set_values(**values: float) -> Callable[[JointState], None]:
    def spoil(message: JointState) -> None:
        for name, value in values.items():
            set_value(name, value)(message)

    return spoil


def _shift_stamp(seconds: float) -> Callable[[JointState], None]:
    def spoil(message: JointState) -> None:
        stamp = message.header.stamp
        stamp_ns = nanoseconds_from_seconds(stamp.sec) + stamp.nanosec
        message.header.stamp = stamp_from_nanoseconds(stamp_ns + nanoseconds_from_seconds(seconds))

    return spoil


def _drop_last_value(message: JointState) -> None:
    message.position = message.position[:-1]


FAULTS: dict[int, Fault] = {
    4: Fault("vz is NaN", InputCode.NOT_FINITE, set_value("vz", math.nan)),
    8: Fault("the frame is empty", InputCode.EMPTY_FRAME, _set_frame("")),
    12: Fault("the frame is map", InputCode.WRONG_FRAME, _set_frame("map")),
    16: Fault("six values for seven names", InputCode.WRONG_ARRAY_LENGTH, _drop_last_value),
    20: Fault("mass is negative", InputCode.MASS_NOT_POSITIVE, set_value("mass", -MASS_KG)),
    24: Fault("50 m below ground", InputCode.BELOW_GROUND, set_value("z", -50.0)),
    28: Fault("the stamp is 5 s old", InputCode.STALE_STAMP, _shift_stamp(-5.0)),
    32: Fault("the stamp is 5 s ahead", InputCode.FUTURE_STAMP, _shift_stamp(5.0)),
    36: Fault(
        "the stamp is before that of the state before",
        InputCode.STAMP_BACKWARD,
        _shift_stamp(-DISPERSED_PERIOD_S - 0.05),
    ),
    39: Fault(
        "unreachable: 1400 m up, falling at 200 m/s",
        PlanStatus.INFEASIBLE,
        _set_values(x=0.0, y=0.0, z=1400.0, vx=0.0, vy=0.0, vz=-200.0),
    ),
}
"""Bad states by their index among the states."""


def write_dispersed(folder: Path) -> Path:
    """Writes a series of unrelated initial states, some of them bad; returns the bag."""
    random = np.random.default_rng(DISPERSED_SEED)
    layout = problem_layout(problems.get("powered_descent"))
    bag = folder / DISPERSED
    with BagWriter(bag, overwrite=True) as writer:
        opening = f"{DISPERSED_STATES} unrelated initial states, seed {DISPERSED_SEED}"
        _open_states(writer, opening, DISPERSED_START_NS)
        for index in range(DISPERSED_STATES):
            stamp_ns = DISPERSED_START_NS + nanoseconds_from_seconds(index * DISPERSED_PERIOD_S)
            message = _random_state(random, layout, stamp_ns)
            text = f"state {index}"
            if (fault := FAULTS.get(index)) is not None:
                fault.spoil(message)
                text += f": {fault.announcement}"
            writer.write(STORY_TOPIC, String(data=text), stamp_ns)
            log_ns = stamp_ns + nanoseconds_from_seconds(STATE_LATENCY_S)
            writer.write(VEHICLE_STATE_TOPIC, message, log_ns)
    return bag


def write_ignitions(folder: Path) -> list[Path]:
    """Writes two series of unrelated states, in each of which the engine is lit."""
    layout = problem_layout(problems.get("powered_descent"))
    bags = []
    for number, (name, seed) in enumerate(IGNITIONS_SEEDS.items()):
        random = np.random.default_rng(seed)
        start_ns = IGNITIONS_START_NS + number * IGNITIONS_APART_NS
        bags.append(folder / name)
        with BagWriter(bags[-1], overwrite=True) as writer:
            opening = f"ignition of the engine in {IGNITIONS_STATES} descents, seed {seed}"
            _open_states(writer, opening, start_ns)
            for index in range(IGNITIONS_STATES):
                stamp_ns = start_ns + nanoseconds_from_seconds(index * IGNITIONS_PERIOD_S)
                log_ns = stamp_ns + nanoseconds_from_seconds(STATE_LATENCY_S)
                message = _random_state(random, layout, stamp_ns)
                writer.write(VEHICLE_STATE_TOPIC, message, log_ns)
    return bags


def _open_states(writer: BagWriter, opening: str, start_ns: int) -> None:
    """Declares the topics of a series of states, and begins the story."""
    writer.add_topic(STORY_TOPIC, String, RELIABLE)
    writer.add_topic(VEHICLE_STATE_TOPIC, JointState, RELIABLE)
    opening_ns = start_ns - nanoseconds_from_seconds(LEAD_S)
    writer.write(STORY_TOPIC, String(data=opening), opening_ns)


def _random_state(random: np.random.Generator, layout: StateLayout, stamp_ns: int) -> JointState:
    """State uniformly out of the box, its entries in random order."""
    position = random.uniform(-1.0, 1.0, 3) * POSITION_SPREAD_M + POSITION_CENTRE_M
    velocity = random.uniform(-1.0, 1.0, 3) * VELOCITY_SPREAD_M_S + VELOCITY_CENTRE_M_S
    state = StampedState(stamp_ns, np.array([*position, *velocity, MASS_KG]))
    message = joint_state_from_state(state, layout)
    shuffle_names(message, random)
    return message


def main() -> None:
    """Writes every bag and says how big it is."""
    write_bags(
        __doc__,
        lambda folder: (write_nominal(folder), write_dispersed(folder), *write_ignitions(folder)),
    )


if __name__ == "__main__":
    main()

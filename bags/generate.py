"""Makes the sample bags of this folder: `python bags/generate.py`.

The same numbers come out each time; README.md tells what they are.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

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
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from dscp_core import problems
from dscp_core.planning.plan import PlanStatus
from dscp_core.planning.planner import Planner, TerminalTime
from dscp_core.problems.powered_descent.simulation import DescentSimulation
from dscp_ros.bag import BagWriter
from dscp_ros.flights.logs import LEAD_S, STATE_LATENCY_S, write_flight
from msg_adapters.errors import InputCode
from msg_adapters.joint_state import joint_state_from_state
from msg_adapters.layout import StateLayout, problem_layout
from msg_adapters.stamps import (
    nanoseconds_from_seconds,
    stamp_from_nanoseconds,
)
from msg_adapters.state import StampedState

NOMINAL, DISPERSED = "powered_descent_nominal", "powered_descent_dispersed"
IGNITIONS_LOG, IGNITIONS_UNSEEN = "ignitions_log", "ignitions_unseen"

DISPERSED_START_NS = nanoseconds_from_seconds(datetime(2026, 3, 2, 9, 0, tzinfo=UTC).timestamp())
NOMINAL_START_NS = nanoseconds_from_seconds(datetime(2026, 3, 2, 9, 10, tzinfo=UTC).timestamp())
"""Later than the other bag, so that the clock moves forward when both are replayed in turn."""

NOMINAL_SEED = 1
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
    problem = problems.get("powered_descent")
    simulation = DescentSimulation(Planner(problem, terminal_time=TerminalTime.FREE))
    return write_flight(
        folder / NOMINAL, problem, simulation.record(NOMINAL_SEED), NOMINAL_START_NS
    )


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

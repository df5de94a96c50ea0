"""Ages, stamps that move forward, and the mass that completes an odometry."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ros.planner_support import LAYOUT, STATE

from dscp_ros.planner.input_checks import InputGate, InputSettings
from msg_adapters.errors import InputCode, RejectedInputError
from msg_adapters.joint_state import joint_state_from_state
from msg_adapters.mass import inertia_from_mass
from msg_adapters.odometry import odometry_from_kinematics
from msg_adapters.state import Kinematics, StampedMass, StampedState

SECOND_NS = 1_000_000_000
NOW_NS = 1000 * SECOND_NS
SETTINGS = InputSettings(state_max_age_s=0.5, mass_max_age_s=2.0, future_tolerance_s=0.1)


@pytest.fixture
def gate() -> InputGate:
    return InputGate(LAYOUT)


def state(stamp_ns: int):
    return joint_state_from_state(StampedState(stamp_ns, STATE), LAYOUT)


def odometry(stamp_ns: int):
    kinematics = Kinematics(stamp_ns, STATE[[1, 2, 0]], STATE[[4, 5, 3]])
    return odometry_from_kinematics(kinematics, frame=LAYOUT.frame)


def mass(stamp_ns: int, mass_kg: float = 38000.0):
    return inertia_from_mass(StampedMass(stamp_ns, mass_kg))


def code_of(accept, *args) -> InputCode:
    with pytest.raises(RejectedInputError) as caught:
        accept(*args)
    return caught.value.code


@pytest.mark.parametrize("offset_ns", [-SECOND_NS // 2, 0, SECOND_NS // 10])
def test_ages_up_to_the_bounds_pass(gate, offset_ns):
    accepted = gate.accept_joint_state(state(NOW_NS + offset_ns), NOW_NS, SETTINGS)
    assert np.array_equal(accepted.state.values, STATE)


@pytest.mark.parametrize(
    ("offset_ns", "code"),
    [
        (-SECOND_NS // 2 - 1, InputCode.STALE_STAMP),
        (SECOND_NS // 10 + 1, InputCode.FUTURE_STAMP),
    ],
)
def test_one_nanosecond_more_does_not(gate, offset_ns, code):
    assert code_of(gate.accept_joint_state, state(NOW_NS + offset_ns), NOW_NS, SETTINGS) is code


def test_stamps_move_forward_across_both_inputs(gate):
    gate.accept_mass(mass(NOW_NS), NOW_NS, SETTINGS)
    gate.accept_joint_state(state(NOW_NS), NOW_NS, SETTINGS)
    for stamp_ns in (NOW_NS, NOW_NS - 1):
        refused = code_of(gate.accept_odometry, odometry(stamp_ns), NOW_NS, SETTINGS)
        assert refused is InputCode.STAMP_BACKWARD
    gate.accept_odometry(odometry(NOW_NS + 1), NOW_NS, SETTINGS)


def test_a_refused_state_does_not_move_the_stamp(gate):
    broken = state(NOW_NS + 5)
    broken.header.frame_id = "map"
    assert code_of(gate.accept_joint_state, broken, NOW_NS, SETTINGS) is InputCode.WRONG_FRAME
    later = odometry(NOW_NS + 5)
    assert code_of(gate.accept_odometry, later, NOW_NS, SETTINGS) is InputCode.MASS_MISSING
    gate.accept_joint_state(state(NOW_NS), NOW_NS, SETTINGS)


def test_forgetting_lets_older_stamps_pass(gate):
    gate.accept_mass(mass(NOW_NS), NOW_NS, SETTINGS)
    gate.accept_joint_state(state(NOW_NS), NOW_NS, SETTINGS)
    gate.forget()
    gate.accept_joint_state(state(NOW_NS - 1), NOW_NS, SETTINGS)
    missing = code_of(gate.accept_odometry, odometry(NOW_NS), NOW_NS, SETTINGS)
    assert missing is InputCode.MASS_MISSING


def test_mass_has_its_own_age(gate):
    gate.accept_mass(mass(NOW_NS - SECOND_NS), NOW_NS, SETTINGS)
    accepted = gate.accept_odometry(odometry(NOW_NS), NOW_NS, SETTINGS)
    assert accepted.mass_source == "message"
    later_ns = NOW_NS + SECOND_NS + 1
    stale = code_of(gate.accept_odometry, odometry(later_ns), later_ns, SETTINGS)
    assert stale is InputCode.MASS_STALE


def test_the_newest_mass_counts(gate):
    gate.accept_mass(mass(NOW_NS - 2), NOW_NS, SETTINGS)
    gate.accept_mass(mass(NOW_NS - 1, 37000.0), NOW_NS, SETTINGS)
    refused = code_of(gate.accept_mass, mass(NOW_NS - 1, 36000.0), NOW_NS, SETTINGS)
    assert refused is InputCode.STAMP_BACKWARD
    accepted = gate.accept_odometry(odometry(NOW_NS), NOW_NS, SETTINGS)
    assert accepted.state.values[6] == 37000.0


def test_a_late_or_early_mass_is_refused(gate):
    assert code_of(gate.accept_mass, mass(0), NOW_NS, SETTINGS) is InputCode.STALE_STAMP
    early = mass(NOW_NS + SECOND_NS)
    assert code_of(gate.accept_mass, early, NOW_NS, SETTINGS) is InputCode.FUTURE_STAMP


def test_the_fallback_replaces_a_missing_or_stale_mass(gate):
    settings = replace(SETTINGS, mass_fallback_kg=30000.0)
    accepted = gate.accept_odometry(odometry(NOW_NS), NOW_NS, settings)
    assert (accepted.mass_source, accepted.state.values[6]) == ("parameter", 30000.0)
    gate.accept_mass(mass(NOW_NS), NOW_NS, settings)
    fresh = gate.accept_odometry(odometry(NOW_NS + 1), NOW_NS, settings)
    assert (fresh.mass_source, fresh.state.values[6]) == ("message", 38000.0)
    later_ns = NOW_NS + 3 * SECOND_NS
    stale = gate.accept_odometry(odometry(later_ns), later_ns, settings)
    assert stale.mass_source == "parameter"


def test_the_order_is_finite_frame_sizes_range_age_forward(gate):
    gate.accept_joint_state(state(NOW_NS), NOW_NS, SETTINGS)
    message = state(NOW_NS - 1)
    assert code_of(gate.accept_joint_state, message, NOW_NS, SETTINGS) is InputCode.STAMP_BACKWARD
    message.header.stamp.sec = 1
    assert code_of(gate.accept_joint_state, message, NOW_NS, SETTINGS) is InputCode.STALE_STAMP
    message.position[2] = -100.0
    assert code_of(gate.accept_joint_state, message, NOW_NS, SETTINGS) is InputCode.BELOW_GROUND
    message.name[0] = "q"
    assert code_of(gate.accept_joint_state, message, NOW_NS, SETTINGS) is InputCode.UNKNOWN_NAME
    message.header.frame_id = ""
    assert code_of(gate.accept_joint_state, message, NOW_NS, SETTINGS) is InputCode.EMPTY_FRAME
    message.position[0] = float("nan")
    assert code_of(gate.accept_joint_state, message, NOW_NS, SETTINGS) is InputCode.NOT_FINITE

"""Thrust commands: along a plan, and along the altitude-speed profile of the last stretch."""

from __future__ import annotations

import math

import numpy as np

from dscp_core.problems.powered_descent.guidance.reference import Reference
from dscp_core.problems.powered_descent.guidance.settings import GuidanceSettings
from dscp_core.problems.powered_descent.guidance.vehicle import Array, Engine, Motion, Vehicle

_FALL_S, _LONGEST_FALL_S = 0.01, 2.0
"""Step of a foreseen fall, and how far it is foreseen."""
_MOST_STEEPER = 4.0
"""Feed-forward is at most so many times the profile's deceleration."""


def tracking_thrust(
    settings: GuidanceSettings, vehicle: Vehicle, plan: Reference, now: Motion, bias: Array
) -> Array:
    """Thrust (3,) in N that follows a plan; it may spend the reserve that the plan keeps.

    The plan's thrust is commanded ahead, its size by the engine's lag and its direction by the
    attitude's, and as acceleration: the mass is another by now.

    Args:
        settings: Gains.
        vehicle: Its limits.
        plan: What is followed.
        now: The motion when the command comes into effect.
        bias: (3,) observed acceleration that the model leaves out, m/s^2.
    """
    position, velocity, mass = plan.state(now.time_s)
    size, pointing = (
        plan.thrust(now.time_s + ahead_s, settings.tick_s)
        for ahead_s in (settings.known_lag_s, settings.known_attitude_response_s)
    )
    if now.time_s + settings.known_attitude_response_s >= plan.end_s:
        pointing = np.array([float(np.linalg.norm(size)), 0.0, 0.0])  # upright from the gate on
    share = float(np.linalg.norm(size) / np.linalg.norm(pointing))
    force = pointing * (share * now.mass / mass)
    correction = (
        settings.tracking_position_gain * (position - now.position)
        + settings.tracking_velocity_gain * (velocity - now.velocity)
        - bias
    )
    return vehicle.limited(force + now.mass * correction, vehicle.pointing_angle_max_rad)


def profile_thrust(settings: GuidanceSettings, vehicle: Vehicle, now: Motion, bias: Array) -> Array:
    """Thrust (3,) in N along the altitude-speed profile, upright towards the ground.

    The feed-forward is the deceleration that the profile needs at the vehicle's own descent, not
    at the profile's: it vanishes where the vehicle stands still.
    """
    offset = now.position - vehicle.pad_m
    altitude, descent = float(offset[0]), -float(now.velocity[0])
    wanted = settings.profile_descent_m_s(altitude)
    steeper = min(max(descent / max(wanted, 1e-3), 0.0), _MOST_STEEPER)
    # At the end of the profile the descent is constant.
    slope = settings.profile_deceleration_m_s2 if altitude > settings.contact_margin_m else 0.0
    up = vehicle.gravity_m_s2 + slope * steeper + settings.descent_gain * (descent - wanted)
    aside = (
        -settings.lateral_position_gain * offset[1:3]
        - settings.lateral_velocity_gain * now.velocity[1:3]
    )
    tilt = settings.contact_tilt_max_rad + settings.tilt_per_altitude_rad_m * max(altitude, 0.0)
    wanted_force = now.mass * (np.array([up, *aside]) - bias)
    return vehicle.limited(wanted_force, min(tilt, 0.5 * math.pi))


def contact_speed_m_s(
    engine: Engine, pad_altitude_m: float, now: Motion, force: Array, held_s: float, bias: Array
) -> float:
    """Foreseen vertical speed at contact, if a command is held for a time, and then nothing.

    The engine goes on thrusting while it runs down. A fall longer than two seconds is cut there.
    """
    motion, off = now, np.zeros(3)
    while motion.position[0] > pad_altitude_m and motion.time_s < now.time_s + _LONGEST_FALL_S:
        lit = motion.time_s < now.time_s + held_s - 1e-9
        motion = engine.step(motion, _FALL_S, force if lit else off, bias)
    return abs(float(motion.velocity[0]))

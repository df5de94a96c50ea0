"""Entry flight in Cartesian axes of the rotating planet: an independent derivation of the rates."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def _axes(longitude: float, latitude: float) -> tuple[Array, Array, Array]:
    """Unit vectors up, east, north."""
    sin_l, cos_l = math.sin(longitude), math.cos(longitude)
    sin_p, cos_p = math.sin(latitude), math.cos(latitude)
    up = np.array([cos_p * cos_l, cos_p * sin_l, sin_p])
    east = np.array([-sin_l, cos_l, 0.0])
    return up, east, np.cross(up, east)


def to_cartesian(state: Array) -> tuple[Array, Array]:
    """Position and velocity of [r, longitude, latitude, V, gamma, heading]."""
    radius, longitude, latitude, speed, gamma, heading = state[:6]
    up, east, north = _axes(longitude, latitude)
    level = math.sin(heading) * east + math.cos(heading) * north
    return radius * up, speed * (math.sin(gamma) * up + math.cos(gamma) * level)


def to_spherical(position: Array, velocity: Array) -> Array:
    """Inverse of `to_cartesian`, (6,)."""
    radius, speed = float(np.linalg.norm(position)), float(np.linalg.norm(velocity))
    longitude = math.atan2(position[1], position[0])
    latitude = math.asin(position[2] / radius)
    up, east, north = _axes(longitude, latitude)
    gamma = math.asin(float(velocity @ up) / speed)
    heading = math.atan2(float(velocity @ east), float(velocity @ north))
    return np.array([radius, longitude, latitude, speed, gamma, heading])


def limits(state: Array, p: Mapping[str, Any]) -> dict[str, float]:
    """Dynamic pressure in Pa, heat rate in W/m^2, load factor, by hand."""
    pressure, lift, drag = _aerodynamics(state, p)
    rho = 2.0 * pressure / state[3] ** 2
    return {
        "dynamic_pressure": pressure,
        "heat_rate": p["heat_rate_constant"] * rho**0.5 * state[3] ** 3.15,
        "load_factor": math.hypot(lift, drag) / p["standard_gravity"],
    }


def _aerodynamics(state: Array, p: Mapping[str, Any]) -> tuple[float, float, float]:
    """Dynamic pressure, lift and drag over mass."""
    altitude, speed, alpha = state[0] - p["planet_radius"], state[3], state[6]
    mach = speed / p["speed_of_sound"]
    rho = p["sea_level_density"] * math.exp(-altitude / p["scale_height"])
    pressure = 0.5 * rho * speed**2
    c_l11, c_l21, c_l22 = p["lift_coefficients"]
    c_d01, c_d11, c_d21, c_d22 = p["drag_coefficients"]
    lift = c_l11 * alpha + c_l21 * alpha**2 + c_l22 * alpha * mach
    drag = c_d01 + c_d11 * mach + c_d21 * alpha**2 + c_d22 * mach**2
    force = pressure * p["surface_to_mass_ratio"] * p["reference_area"] / p["mass"]
    return pressure, force * lift, force * drag


def acceleration(state: Array, p: Mapping[str, Any]) -> Array:
    """Acceleration against the rotating planet, (3,): Newton, Coriolis, centrifugal."""
    position, velocity = to_cartesian(state)
    radius = float(np.linalg.norm(position))
    gamma, heading, bank = state[4], state[5], state[7]
    up, east, north = _axes(state[1], state[2])
    level = math.sin(heading) * east + math.cos(heading) * north
    upwards = math.cos(gamma) * up - math.sin(gamma) * level
    rightwards = math.cos(heading) * east - math.sin(heading) * north
    _, lift, drag = _aerodynamics(state, p)
    aerodynamic = lift * (math.cos(bank) * upwards + math.sin(bank) * rightwards)
    aerodynamic -= drag * velocity / np.linalg.norm(velocity)
    spin = np.array([0.0, 0.0, p["rotation_rate"]])
    return np.asarray(
        aerodynamic
        - p["gravitational_parameter"] * position / radius**3
        - 2.0 * np.cross(spin, velocity)
        - np.cross(spin, np.cross(spin, position))
    )


def rates(state: Array, p: Mapping[str, Any], step_s: float = 1e-3) -> Array:
    """(6,) rates of [r, longitude, latitude, V, gamma, heading], by differences of the motion."""
    position, velocity = to_cartesian(state)
    force = acceleration(state, p)

    def after(time_s: float) -> Array:
        moved = position + time_s * velocity + 0.5 * time_s**2 * force
        return to_spherical(moved, velocity + time_s * force)

    return (after(step_s) - after(-step_s)) / (2.0 * step_s)

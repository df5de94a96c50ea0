"""Entry flight over a rotating spherical planet (section 4.2.1), in CasADi symbols and SI units."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dscp_core.problem.declaration import Parameters

Value = TypeVar("Value", ca.SX, NDArray[np.float64])

RADIUS, LONGITUDE, LATITUDE, SPEED, GAMMA, HEADING, ALPHA, BANK = range(8)


def density(x: ca.SX, p: Parameters) -> ca.SX:
    """Air density of an exponential atmosphere, kg/m^3."""
    altitude = x[RADIUS] - p["planet_radius"]
    return p["sea_level_density"] * ca.exp(-altitude / p["scale_height"])


def coefficients(alpha: Value, mach: Value, p: Mapping[str, Any]) -> tuple[Value, Value]:
    """Lift and drag coefficient; the angle of attack is in rad."""
    lift, drag = p["lift_coefficients"], p["drag_coefficients"]
    return (
        alpha * (lift[0] + lift[1] * alpha + lift[2] * mach),
        drag[0] + drag[1] * mach + drag[2] * alpha**2 + drag[3] * mach**2,
    )


def aerodynamic_accelerations(x: ca.SX, p: Parameters) -> tuple[ca.SX, ca.SX]:
    """Lift and drag over mass, m/s^2."""
    area = p["surface_to_mass_ratio"] * p["reference_area"]
    force = dynamic_pressure(x, p) * area / p["mass"]
    lift, drag = coefficients(x[ALPHA], x[SPEED] / p["speed_of_sound"], p)
    return force * lift, force * drag


def dynamics(x: ca.SX, u: ca.SX, p: Parameters) -> ca.SX:
    """Rates of [r, longitude, latitude, V, gamma, heading, alpha, sigma], (8, 1)."""
    radius, speed = x[RADIUS], x[SPEED]
    sin_phi, cos_phi = ca.sin(x[LATITUDE]), ca.cos(x[LATITUDE])
    sin_gamma, cos_gamma = ca.sin(x[GAMMA]), ca.cos(x[GAMMA])
    sin_psi, cos_psi = ca.sin(x[HEADING]), ca.cos(x[HEADING])
    lift, drag = aerodynamic_accelerations(x, p)
    gravity = p["gravitational_parameter"] / radius**2
    spin = p["rotation_rate"]
    centrifugal = radius * spin**2 * cos_phi
    return ca.vertcat(
        speed * sin_gamma,
        speed * cos_gamma * sin_psi / (radius * cos_phi),
        speed * cos_gamma * cos_psi / radius,
        -drag
        - gravity * sin_gamma
        + centrifugal * (cos_phi * sin_gamma - sin_phi * cos_gamma * cos_psi),
        lift * ca.cos(x[BANK]) / speed
        - gravity * cos_gamma / speed
        + centrifugal / speed * (cos_phi * cos_gamma + sin_phi * sin_gamma * cos_psi)
        + speed * cos_gamma / radius
        + 2 * spin * cos_phi * sin_psi,
        lift * ca.sin(x[BANK]) / (speed * cos_gamma)
        + centrifugal * sin_phi * sin_psi / (speed * cos_gamma)
        + speed * sin_psi * sin_phi / cos_phi * cos_gamma / radius
        + 2 * spin * (sin_phi - cos_phi * sin_gamma / cos_gamma * cos_psi),
        u[0],
        u[1],
    )


def dynamic_pressure(x: ca.SX, p: Parameters) -> ca.SX:
    """Dynamic pressure, Pa."""
    return 0.5 * density(x, p) * x[SPEED] ** 2


def heat_rate(x: ca.SX, p: Parameters) -> ca.SX:
    """Heat rate k_q rho^0.5 V^3.15, W/m^2."""
    return p["heat_rate_constant"] * ca.sqrt(density(x, p)) * x[SPEED] ** 3.15


def load_factor(x: ca.SX, p: Parameters) -> ca.SX:
    """Aerodynamic load in units of standard gravity."""
    lift, drag = aerodynamic_accelerations(x, p)
    return ca.sqrt(lift**2 + drag**2) / p["standard_gravity"]

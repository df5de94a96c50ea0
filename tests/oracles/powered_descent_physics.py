"""Powered descent written out by hand: dynamics, Jacobians and a flight simulator.

The state is (x, y, z, vx, vy, vz, mass) with x up, the control is the thrust vector; SI units.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DescentParameters:
    """Vehicle and constraint constants; the defaults are the paper's Table `table:pdg`.

    Attributes:
        thrust_min_n: Least thrust magnitude.
        thrust_max_n: Greatest thrust magnitude.
        pointing_max_rad: Greatest angle between the thrust and the upward vertical.
        glideslope_max_rad: Greatest angle, seen from the target, between position and vertical.
        specific_impulse_s: Specific impulse.
        gravity_m_s2: Gravitational acceleration, along -x.
        mass_flow_gravity_m_s2: The constant that turns specific impulse into exhaust speed.
    """

    thrust_min_n: float = 169.0e3
    thrust_max_n: float = 845.2e3
    pointing_max_rad: float = math.radians(30.0)
    glideslope_max_rad: float = math.radians(80.0)
    specific_impulse_s: float = 282.0
    gravity_m_s2: float = 9.80655
    mass_flow_gravity_m_s2: float = 9.80655

    @property
    def exhaust_speed_m_s(self) -> float:
        """Effective exhaust speed."""
        return self.specific_impulse_s * self.mass_flow_gravity_m_s2


PAPER_PARAMETERS = DescentParameters()
PAPER_INITIAL_STATE = (5000.0, 500.0, 500.0, -150.0, 30.0, -30.0, 38000.0)


def state_rate(state: Array, thrust_n: Array, parameters: DescentParameters) -> Array:
    """Time derivative (7,) of the state (7,) under a thrust (3,)."""
    velocity, mass = state[3:6], state[6]
    rate = np.empty(7)
    rate[0:3] = velocity
    rate[3:6] = thrust_n / mass
    rate[3] -= parameters.gravity_m_s2
    rate[6] = -np.linalg.norm(thrust_n) / parameters.exhaust_speed_m_s
    return rate


def state_jacobian(state: Array, thrust_n: Array) -> Array:
    """Derivative (7, 7) of `state_rate` over the state.

    The mass column is -u/m^2; the paper's appendix prints -u/m.
    """
    jacobian = np.zeros((7, 7))
    jacobian[0:3, 3:6] = np.eye(3)
    jacobian[3:6, 6] = -thrust_n / state[6] ** 2
    return jacobian


def thrust_jacobian(state: Array, thrust_n: Array, parameters: DescentParameters) -> Array:
    """Derivative (7, 3) of `state_rate` over the thrust; the thrust must not vanish."""
    magnitude = np.linalg.norm(thrust_n)
    jacobian = np.zeros((7, 3))
    jacobian[3:6, :] = np.eye(3) / state[6]
    jacobian[6, :] = -thrust_n / (magnitude * parameters.exhaust_speed_m_s)
    return jacobian


class ThrustLaw(Enum):
    """How the thrust runs between two nodes of a plan."""

    LINEAR = "linear"
    INTERVAL_MEAN = "interval_mean"


@dataclass(frozen=True)
class Flight:
    """Where a flown plan ended.

    Attributes:
        final_state: State at the end (7,).
        miss_position_m: Distance from the target position.
        miss_speed_m_s: Magnitude of the velocity error.
        final_mass_kg: Mass at the end.
    """

    final_state: Array
    miss_position_m: float
    miss_speed_m_s: float
    final_mass_kg: float


def fly(
    times_s: Array,
    controls_n: Array,
    initial_state: Array,
    parameters: DescentParameters = PAPER_PARAMETERS,
    *,
    law: ThrustLaw = ThrustLaw.LINEAR,
    target_state: Array | None = None,
) -> Flight:
    """Integrate the continuous dynamics under a plan's thrust, interval by interval.

    Args:
        times_s: Node times (N + 1,), increasing.
        controls_n: Thrust at the nodes (N + 1, 3).
        initial_state: State at the first node (7,).
        parameters: Vehicle constants.
        law: Thrust between the nodes.
        target_state: Position and velocity aimed at (6,); the origin at rest if None.

    Returns:
        The end of the flight.

    Raises:
        RuntimeError: The integrator failed.
    """
    state = np.asarray(initial_state, dtype=np.float64)
    target = np.zeros(6) if target_state is None else target_state
    for n in range(len(times_s) - 1):
        rate = _interval_rate(times_s[n : n + 2], controls_n[n : n + 2], parameters, law)
        # One call per interval: a kink of the thrust inside a step would cost the accuracy.
        result = solve_ivp(
            rate,
            (times_s[n], times_s[n + 1]),
            state,
            method="DOP853",
            rtol=1e-11,
            atol=1e-9,
        )
        if not result.success:
            raise RuntimeError(f"integration failed in interval {n}: {result.message}")
        state = result.y[:, -1]
    return Flight(
        final_state=state,
        miss_position_m=float(np.linalg.norm(state[0:3] - target[0:3])),
        miss_speed_m_s=float(np.linalg.norm(state[3:6] - target[3:6])),
        final_mass_kg=float(state[6]),
    )


def _interval_rate(
    ends_s: Array, ends_n: Array, parameters: DescentParameters, law: ThrustLaw
) -> Callable[[float, Array], Array]:
    """Right-hand side over one interval, from the times (2,) and thrusts (2, 3) of its ends."""
    mean = ends_n.mean(axis=0)
    slope = (ends_n[1] - ends_n[0]) / (ends_s[1] - ends_s[0])
    if law is ThrustLaw.INTERVAL_MEAN:
        return lambda _, state: state_rate(state, mean, parameters)
    return lambda time, state: state_rate(state, ends_n[0] + slope * (time - ends_s[0]), parameters)

"""Fuel-optimal powered descent as one nonlinear program, solved by IPOPT.

The discretisation is the midpoint rule (paper's eq. ch2-disdy), or an integration under the
interval means of the thrust; the constraints are those of section 4.1, none of them linearised. The
target is the origin at rest.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

import casadi as ca
import numpy as np

from .powered_descent_physics import PAPER_PARAMETERS, Array, DescentParameters

_LENGTH_M = 5000.0
_SPEED_M_S = 150.0
_MASS_KG = 38000.0
_TIME_S = _LENGTH_M / _SPEED_M_S
_FORCE_N = _MASS_KG * _SPEED_M_S / _TIME_S
_STATE_SCALE = np.array([_LENGTH_M] * 3 + [_SPEED_M_S] * 3 + [_MASS_KG])
_TIME_BOUNDS_S = (1.0, 200.0)
_GUESS_SHAKE_N = 1.0e4
_STARTS = 3

_IPOPT_OPTIONS: dict[str, Any] = {
    "constr_viol_tol": 1e-10,
    "compl_inf_tol": 1e-10,
    "dual_inf_tol": 1e-10,
    "acceptable_iter": 0,
    "bound_relax_factor": 0.0,
    "nlp_scaling_method": "none",
    "max_iter": 300,
    "print_level": 0,
    "sb": "yes",
}


@dataclass(frozen=True)
class NlpOptions:
    """How the problem is discretised.

    Attributes:
        intervals: Number N of intervals.
        bound_mean_thrust: Ask for the least thrust of the interval means too. The dynamics see
            only the means; without this bound the thrust may alternate in direction from node to
            node, and its mean then falls below the least thrust.
        tolerance: IPOPT's tolerance for the scaled problem.
        propagated: Whether to integrate every interval, instead of the midpoint rule.
    """

    intervals: int = 50
    bound_mean_thrust: bool = True
    tolerance: float = 1e-12
    propagated: bool = False


class Status(Enum):
    """Outcome of a solve.

    FAILED says nothing about feasibility: below the least terminal time IPOPT mostly runs to its
    iteration limit instead of proving infeasibility. `solve_least_time` gives that limit.
    """

    OPTIMAL = "optimal"
    INFEASIBLE = "infeasible"
    FAILED = "failed"


@dataclass(frozen=True)
class DescentOptimum:
    """Result of a solve; the trajectory means something only if `status` is OPTIMAL.

    Attributes:
        status: Outcome.
        solver_message: IPOPT's return status.
        iterations: IPOPT's iterations from the last start.
        terminal_time_s: Terminal time, given or found.
        final_mass_kg: Mass at the end.
        mass_slope_kg_s: Derivative of the greatest final mass over the terminal time; NaN unless
            the terminal time was given.
        times_s: Node times (N + 1,).
        states: States at the nodes (N + 1, 7).
        controls: Thrust at the nodes (N + 1, 3), in newtons.
    """

    status: Status
    solver_message: str
    iterations: int
    terminal_time_s: float
    final_mass_kg: float
    mass_slope_kg_s: float
    times_s: Array
    states: Array
    controls: Array


def solve_fixed_time(
    initial_state: Sequence[float] | Array,
    terminal_time_s: float,
    parameters: DescentParameters = PAPER_PARAMETERS,
    options: NlpOptions | None = None,
) -> DescentOptimum:
    """Greatest final mass for a given terminal time, from an initial state (7,)."""
    return _solve(_Mode.FIXED_TIME, initial_state, terminal_time_s, parameters, options)


def solve_free_time(
    initial_state: Sequence[float] | Array,
    parameters: DescentParameters = PAPER_PARAMETERS,
    options: NlpOptions | None = None,
    *,
    terminal_time_guess_s: float | None = None,
) -> DescentOptimum:
    """Greatest final mass over trajectory and terminal time, from an initial state (7,)."""
    return _solve(_Mode.FREE_TIME, initial_state, terminal_time_guess_s, parameters, options)


def solve_least_time(
    initial_state: Sequence[float] | Array,
    parameters: DescentParameters = PAPER_PARAMETERS,
    options: NlpOptions | None = None,
) -> DescentOptimum:
    """Least feasible terminal time, from an initial state (7,)."""
    return _solve(_Mode.LEAST_TIME, initial_state, None, parameters, options)


class _Mode(Enum):
    FIXED_TIME = "fixed_time"
    FREE_TIME = "free_time"
    LEAST_TIME = "least_time"


# Weight of the mean squared thrust difference between neighbouring nodes, all in scaled units. Some
# thrusts are otherwise undetermined (alternation from node to node; magnitudes in the fastest
# descent) and IPOPT wanders. Effect: < 1e-4 kg/s on the slope, < 1e-5 kg, < 1e-6 s.
_ROUGHNESS_WEIGHT = {_Mode.FIXED_TIME: 1e-9, _Mode.FREE_TIME: 0.0, _Mode.LEAST_TIME: 1e-8}


@dataclass(frozen=True)
class _Program:
    """A solver with its bounds and the maps between scaled trajectories and its variables."""

    solver: Any
    trajectory: Any
    bounds: dict[str, Array]


class _Constraints:
    """Collects expressions together with their bounds."""

    def __init__(self) -> None:
        self.expressions: list[Any] = []
        self.lower: list[Array] = []
        self.upper: list[Array] = []

    def add(self, expression: Any, lower: float, upper: float) -> None:
        values = ca.vec(expression)
        self.expressions.append(values)
        self.lower.append(np.full(values.numel(), lower))
        self.upper.append(np.full(values.numel(), upper))


def _propagated(states: Any, thrust: Any, step: Any, flow_per_thrust: float, gravity: float) -> Any:
    """States (7, N) an interval later, the thrust (3, N) being constant.

    Thrust over a linearly falling mass is integrated by Gauss and Legendre's rule on five points.
    """
    flow = flow_per_thrust * ca.sqrt(ca.sum1(thrust**2))
    points, weights = np.polynomial.legendre.leggauss(5)
    speed_gain, way = 0.0, 0.0
    for point, weight in zip((points + 1) / 2, weights / 2, strict=True):
        per_mass = weight * step / (states[6, :] - point * step * flow)
        speed_gain += per_mass
        way += per_mass * (1 - point) * step
    down = ca.repmat(ca.DM([gravity, 0.0, 0.0]), 1, states.shape[1])
    return ca.vertcat(
        states[:3, :] + step * states[3:6, :] + ca.repmat(way, 3, 1) * thrust - step**2 / 2 * down,
        states[3:6, :] + ca.repmat(speed_gain, 3, 1) * thrust - step * down,
        states[6, :] - step * flow,
    )


@functools.lru_cache(maxsize=32)
def _build(mode: _Mode, parameters: DescentParameters, options: NlpOptions) -> _Program:
    count = options.intervals
    initial = ca.SX.sym("initial", 7)
    terminal_time = ca.SX.sym("terminal_time")
    inner_states = ca.SX.sym("states", 7, count - 1)
    final_mass = ca.SX.sym("final_mass")
    thrust = ca.SX.sym("thrust", 3, count + 1)
    states = ca.horzcat(initial, inner_states, ca.vertcat(ca.SX.zeros(6), final_mass))

    mean_state = (states[:, 1:] + states[:, :-1]) / 2
    mean_thrust = (thrust[:, 1:] + thrust[:, :-1]) / 2
    mean_squared = ca.sum1(mean_thrust**2)
    flow_per_thrust = _SPEED_M_S / parameters.exhaust_speed_m_s
    gravity = parameters.gravity_m_s2 * _TIME_S / _SPEED_M_S
    rate = ca.vertcat(
        mean_state[3:6, :],
        mean_thrust / ca.repmat(mean_state[6, :], 3, 1)
        - ca.repmat(ca.DM([gravity, 0.0, 0.0]), 1, count),
        -flow_per_thrust * ca.sqrt(mean_squared),
    )

    least, most = parameters.thrust_min_n / _FORCE_N, parameters.thrust_max_n / _FORCE_N
    pointing, glideslope = (
        math.tan(parameters.pointing_max_rad),
        math.tan(parameters.glideslope_max_rad),
    )
    constraints = _Constraints()
    step = terminal_time / count
    if options.propagated:
        flown = _propagated(states[:, :-1], mean_thrust, step, flow_per_thrust, gravity)
        constraints.add(states[:, 1:] - flown, 0.0, 0.0)
    else:
        constraints.add(states[:, 1:] - states[:, :-1] - step * rate, 0.0, 0.0)
    constraints.add(ca.sum1(thrust**2), least**2, most**2)
    # The cones are squared, which is smooth; the squares need the sign of the axis component.
    constraints.add(ca.sum1(thrust[1:, :] ** 2) - (pointing * thrust[0, :]) ** 2, -np.inf, 0.0)
    constraints.add(thrust[0, :], 0.0, np.inf)
    constraints.add(
        ca.sum1(inner_states[1:3, :] ** 2) - (glideslope * inner_states[0, :]) ** 2, -np.inf, 0.0
    )
    constraints.add(inner_states[0, :], 0.0, np.inf)
    if options.bound_mean_thrust:
        constraints.add(mean_squared, least**2, np.inf)

    variables = [ca.vec(inner_states), final_mass, ca.vec(thrust)]
    given = [initial]
    (given if mode is _Mode.FIXED_TIME else variables).append(terminal_time)
    decision = ca.vertcat(*variables)
    lower, upper = np.full(decision.numel(), -np.inf), np.full(decision.numel(), np.inf)
    if mode is not _Mode.FIXED_TIME:
        lower[-1], upper[-1] = np.array(_TIME_BOUNDS_S) / _TIME_S

    cost = terminal_time if mode is _Mode.LEAST_TIME else -final_mass
    cost += _ROUGHNESS_WEIGHT[mode] * ca.sumsqr(thrust[:, 1:] - thrust[:, :-1]) / count
    solver = ca.nlpsol(
        "powered_descent",
        "ipopt",
        {
            "x": decision,
            "p": ca.vertcat(*given),
            "f": cost,
            "g": ca.vertcat(*constraints.expressions),
        },
        {
            # IPOPT may stop at the acceptable level in spite of `acceptable_iter`.
            "ipopt": _IPOPT_OPTIONS
            | {"tol": options.tolerance, "acceptable_tol": options.tolerance},
            "print_time": False,
            "error_on_fail": False,
        },
    )
    return _Program(
        solver=solver,
        trajectory=ca.Function(
            "trajectory",
            [decision, ca.vertcat(*given)],
            [states, thrust, terminal_time],
        ),
        bounds={
            "lbx": lower,
            "ubx": upper,
            "lbg": np.concatenate(constraints.lower),
            "ubg": np.concatenate(constraints.upper),
        },
    )


def _solve(
    mode: _Mode,
    initial_state: Sequence[float] | Array,
    terminal_time_s: float | None,
    parameters: DescentParameters,
    options: NlpOptions | None,
) -> DescentOptimum:
    chosen = NlpOptions() if options is None else options
    initial = np.asarray(initial_state, dtype=np.float64)
    if terminal_time_s is None:
        terminal_time_s = _guess_terminal_time_s(initial, parameters)
    program = _build(mode, parameters, chosen)
    states, thrust = _guess(initial, terminal_time_s, parameters, chosen.intervals)
    scaled_states, scaled_time = states / _STATE_SCALE, np.array([terminal_time_s / _TIME_S])
    given, tail = initial / _STATE_SCALE, scaled_time
    if mode is _Mode.FIXED_TIME:
        given, tail = np.concatenate([given, scaled_time]), np.empty(0)
    for seed in range(_STARTS):
        # A guess in a vertical plane that the problem is symmetric to never leaves it, and IPOPT
        # stalls on the saddle there; other guesses rarely fail, and others again then succeed.
        shake_n = _GUESS_SHAKE_N * np.random.default_rng(seed).standard_normal(thrust.shape)
        scaled_thrust = (thrust + shake_n) / _FORCE_N
        start = [scaled_states[1:-1].ravel(), scaled_states[-1, 6:], scaled_thrust.ravel(), tail]
        result = program.solver(x0=np.concatenate(start), p=given, **program.bounds)
        statistics = program.solver.stats()
        if _status(statistics["return_status"]) is Status.OPTIMAL:
            break

    found_states, found_thrust, found_time = program.trajectory(result["x"], given)
    found_time_s = float(found_time) * _TIME_S
    slope = math.nan
    if mode is _Mode.FIXED_TIME:
        # CasADi's multiplier of a parameter is minus the derivative of the least cost, -mass.
        slope = float(result["lam_p"][-1]) * _MASS_KG / _TIME_S
    return DescentOptimum(
        status=_status(statistics["return_status"]),
        solver_message=statistics["return_status"],
        iterations=int(statistics["iter_count"]),
        terminal_time_s=found_time_s,
        final_mass_kg=float(found_states[6, -1]) * _MASS_KG,
        mass_slope_kg_s=slope,
        times_s=np.linspace(0.0, found_time_s, chosen.intervals + 1),
        states=np.array(found_states).T * _STATE_SCALE,
        controls=np.array(found_thrust).T * _FORCE_N,
    )


def _status(message: str) -> Status:
    if message == "Solve_Succeeded":
        return Status.OPTIMAL
    if message == "Infeasible_Problem_Detected":
        return Status.INFEASIBLE
    return Status.FAILED


def _guess_terminal_time_s(initial: Array, parameters: DescentParameters) -> float:
    """A multiple of the time to fall to the ground without thrust."""
    height, climb, gravity = float(initial[0]), float(initial[3]), parameters.gravity_m_s2
    fall_s = (climb + math.sqrt(climb**2 + 2.0 * gravity * height)) / gravity
    return 1.6 * fall_s


def _guess(
    initial: Array, terminal_time_s: float, parameters: DescentParameters, intervals: int
) -> tuple[Array, Array]:
    """States (N + 1, 7) and thrust (N + 1, 3) near the least-acceleration transfer.

    The transfer to rest at the origin with the least integral of the squared acceleration has an
    acceleration linear in time. Its thrust is then cut to the pointing cone and the bounds.
    """
    position, velocity = initial[0:3], initial[3:6]
    slope = (12.0 * position + 6.0 * velocity * terminal_time_s) / terminal_time_s**3
    start = -velocity / terminal_time_s - slope * terminal_time_s / 2.0
    time = np.linspace(0.0, terminal_time_s, intervals + 1)[:, None]
    states = np.empty((intervals + 1, 7))
    states[:, 0:3] = position + velocity * time + start * time**2 / 2.0 + slope * time**3 / 6.0
    states[:, 3:6] = velocity + start * time + slope * time**2 / 2.0
    specific_thrust = start + slope * time + np.array([parameters.gravity_m_s2, 0.0, 0.0])

    step_s = terminal_time_s / intervals
    thrust = np.empty((intervals + 1, 3))
    mass = float(initial[6])
    for n in range(intervals + 1):
        states[n, 6] = mass
        thrust[n] = _cut(mass * specific_thrust[n], parameters)
        mass -= step_s * float(np.linalg.norm(thrust[n])) / parameters.exhaust_speed_m_s
    return states, thrust


def _cut(thrust_n: Array, parameters: DescentParameters) -> Array:
    """Nearby thrust inside the pointing cone and the thrust bounds."""
    axial = max(float(thrust_n[0]), parameters.thrust_min_n)
    lateral = thrust_n[1:3]
    widest = math.tan(parameters.pointing_max_rad) * axial
    width = float(np.linalg.norm(lateral))
    inside = np.array([axial, *(lateral * min(1.0, widest / max(width, 1e-9)))])
    magnitude = float(np.linalg.norm(inside))
    allowed = min(max(magnitude, parameters.thrust_min_n), parameters.thrust_max_n)
    return inside * (allowed / magnitude)

"""Closed-loop simulation of an entry: a dispersed vehicle under replanned guidance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import casadi as ca
import numpy as np
import scipy.integrate
from numpy.typing import NDArray

from dscp_core import problems
from dscp_core.planning.plan import PlanOutcome, PlanStatus
from dscp_core.planning.planner import Planner
from dscp_core.problem.declaration import OptimalControlProblem, named
from dscp_core.problem.trajectory import Plan
from dscp_core.transcription.compiled import CompiledFunction
from dscp_ros.planner.declaration import VEHICLE_PREFIX
from dscp_ros.planner.parameters import node_settings, parameter_table

Array = NDArray[np.float64]

SEED = 1
TICK_S = 20.0
REPLAN_TICKS = 3
LAST_REPLAN_S = 60.0
GUIDANCE_LIMITS = {"heat_rate_max": 2.4e6, "dynamic_pressure_max": 1.05e5}
"""Four percent below those of the vehicle: on the limit, no error can be made up for."""

_DEGREE = math.radians(1.0)
_METRES_OF_ARC = 1.0 / 6371.1e3
# radius, longitude, latitude, speed, flight-path angle, heading, angle of attack, bank
INITIAL_DEVIATION = (
    *(200.0, 2e3 * _METRES_OF_ARC, 2e3 * _METRES_OF_ARC, 5.0),
    *(0.02 * _DEGREE, 0.05 * _DEGREE, 0.2 * _DEGREE, 0.2 * _DEGREE),
)
NAVIGATION_DEVIATION = (
    *(20.0, 20.0 * _METRES_OF_ARC, 20.0 * _METRES_OF_ARC, 0.1),
    *(1e-4, 1e-4, 5e-4, 5e-4),
)
VEHICLE_DEVIATION = {
    "sea_level_density": 0.02,
    "lift_coefficients": 0.01,
    "drag_coefficients": 0.01,
}
"""Relative, constant in flight; guidance does not know them."""


def entry_planner(**parameters: float) -> Planner:
    """The planner with the settings that the node has by default, but for some parameters."""
    problem = problems.get("entry")
    values = {parameter.name: parameter.default for parameter in parameter_table(problem)}
    values |= {VEHICLE_PREFIX + name: value for name, value in parameters.items()}
    return Planner(problem, node_settings(problem, values).planner)


@dataclass(frozen=True)
class Measurement:
    """One measured state.

    Attributes:
        time_s: From the start of the flight.
        state: (8,) as measured, SI.
        outcome: What guidance planned from it, if it did.
    """

    time_s: float
    state: Array
    outcome: PlanOutcome | None


@dataclass(frozen=True)
class Flight:
    """One flight under replanned guidance.

    Attributes:
        measurements: In order of time, the last one at the end.
        end: (8,) true state at the end, SI.
        miss_position_m: Distance from the target at the end.
        vehicle: What the vehicle did differently, relative, by parameter.
    """

    measurements: tuple[Measurement, ...]
    end: Array
    miss_position_m: float
    vehicle: dict[str, float]


class _Vehicle:
    """The true vehicle: the declared dynamics with other numbers."""

    def __init__(self, planner: Planner, random: np.random.Generator) -> None:
        problem = planner.problem
        self.errors = {
            name: deviation * random.standard_normal()
            for name, deviation in VEHICLE_DEVIATION.items()
        }
        values = problem.table.unpack(planner.parameters)
        changed = {name: (1.0 + e) * np.asarray(values[name]) for name, e in self.errors.items()}
        self._parameters = problem.table.pack(changed, planner.parameters)
        self._rates = _rates(problem)

    def fly(self, state: Array, plan: Plan, start_s: float, end_s: float) -> Array:
        """State after following a plan from one of its moments to another."""
        nodes = plan.times_s[1:-1]
        inner = nodes[(nodes > start_s) & (nodes < end_s)]
        moments = np.array([start_s, *inner, end_s])
        for before, after in pairwise(moments):
            # Between nodes, the mean of both is flown: that is what the midpoint rule assumes.
            k = int(np.searchsorted(plan.times_s, 0.5 * (before + after))) - 1
            held = 0.5 * (plan.controls[k] + plan.controls[k + 1])
            flown = scipy.integrate.solve_ivp(
                lambda _, x, held=held: self._rates(x, held, self._parameters)[0],
                (before, after),
                state,
                method="DOP853",
                rtol=1e-10,
                atol=1e-10,
            )
            state = flown.y[:, -1]
        return np.asarray(state)


def _rates(problem: OptimalControlProblem) -> CompiledFunction:
    nx, nu = len(problem.states), len(problem.controls)
    x, u, p = ca.SX.sym("x", nx), ca.SX.sym("u", nu), ca.SX.sym("p", problem.table.size)
    return CompiledFunction("rates", [x, u, p], [problem.dynamics(x, u, named(problem, p))])


def fly(seed: int) -> Flight:
    """Flies one entry: guidance plans from noisy measurements once a minute.

    Raises:
        RuntimeError: There is no plan to begin with.
    """
    random = np.random.default_rng(seed)
    planner = entry_planner(**GUIDANCE_LIMITS)
    vehicle = _Vehicle(planner, random)
    truth = planner.initial_state + INITIAL_DEVIATION * random.standard_normal(8)
    measurements: list[Measurement] = []
    plan: Plan | None = None
    plan_start_s, arrival_s, time_s = 0.0, math.inf, 0.0
    while time_s < arrival_s:
        measured = truth + NAVIGATION_DEVIATION * random.standard_normal(8)
        outcome = None
        if len(measurements) % REPLAN_TICKS == 0 and arrival_s - time_s > LAST_REPLAN_S:
            outcome = planner.plan(measured, warm_start=plan, elapsed_s=time_s - plan_start_s)
            if outcome.status is PlanStatus.CERTIFIED and outcome.plan is not None:
                plan, plan_start_s = outcome.plan, time_s
                arrival_s = time_s + plan.terminal_time_s
        measurements.append(Measurement(time_s, measured, outcome))
        if plan is None:
            raise RuntimeError(f"no first plan: {outcome and outcome.message}")
        # A product, not a sum, so that rounding does not build up.
        next_s = min(len(measurements) * TICK_S, arrival_s)
        truth = vehicle.fly(truth, plan, time_s - plan_start_s, next_s - plan_start_s)
        time_s = next_s
    measured = truth + NAVIGATION_DEVIATION * random.standard_normal(8)
    measurements.append(Measurement(time_s, measured, None))
    misses = planner.problem.misses
    values = {n: ca.SX(v) for n, v in planner.problem.table.unpack(planner.parameters).items()}
    (position,) = (m for m in misses if m.name == "miss_position")
    miss_m = float(ca.DM(position.expression(ca.SX(truth), values)))
    return Flight(tuple(measurements), truth, miss_m, vehicle.errors)

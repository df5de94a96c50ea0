"""Closed-loop simulation of a powered descent: a dispersed vehicle under replanned guidance.

Guidance plans from noisy measurements, the vehicle flies the plan with errors that guidance does
not know. Planning takes no simulated time, and attitude follows the commanded thrust at once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import casadi as ca
import numpy as np
import scipy.integrate
from numpy.typing import NDArray

from dscp_core.errors import DscpError, InvalidInputError
from dscp_core.planning.plan import PlanOutcome, PlanStatus
from dscp_core.planning.planner import Planner, PlannerSettings
from dscp_core.problem.declaration import named
from dscp_core.problem.trajectory import Plan
from dscp_core.problems.powered_descent.definition import powered_descent
from dscp_core.transcription.compiled import CompiledFunction

Array = NDArray[np.float64]

_POSITION, _VELOCITY, _MASS = slice(0, 3), slice(3, 6), 6
_RELATIVE_TOLERANCE = 1e-9
_ABSOLUTE_TOLERANCE = 1e-6
"""Metres, m/s and kg: far below what any dispersion does."""


class NoFirstPlanError(DscpError):
    """No certified plan from the first measured state: there is nothing to fly."""


@dataclass(frozen=True)
class Dispersions:
    """Standard deviations of the normally distributed errors; 0 switches one off.

    Attributes:
        initial_position_m: Initial position, per axis.
        initial_velocity_m_s: Initial velocity, per axis.
        initial_mass: Initial mass, relative.
        specific_impulse: Specific impulse, relative, constant in flight.
        thrust: Thrust magnitude, relative, constant in flight.
        thrust_direction_rad: Misalignment of the thrust about each lateral axis, constant.
        navigation_position_m: Measured position, per axis, drawn for every measurement.
        navigation_velocity_m_s: Measured velocity, likewise.
        navigation_mass: Measured mass, relative, likewise.
    """

    initial_position_m: float = 50.0
    initial_velocity_m_s: float = 3.0
    initial_mass: float = 0.005
    specific_impulse: float = 0.003
    thrust: float = 0.003
    thrust_direction_rad: float = 0.005
    navigation_position_m: float = 0.2
    navigation_velocity_m_s: float = 0.02
    navigation_mass: float = 0.0005

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (math.isfinite(value) and value >= 0.0):
                raise InvalidInputError(name, value, ">= 0")


@dataclass(frozen=True)
class SimulationOptions:
    """How guidance runs.

    Attributes:
        tick_s: Time between measurements; the commanded thrust is held in between.
        replan_ticks: Ticks from one plan to the next.
        last_replan_s: With less time to go, the last plan is flown to its end.
        thrust_reserve: Part of the greatest thrust that the first plan leaves unused. A plan that
            burns at full thrust cannot make up for any error, so every later plan gets a little
            more: what remains goes with the square root of the time to go.
    """

    tick_s: float = 0.1
    replan_ticks: int = 10
    last_replan_s: float = 1.5
    thrust_reserve: float = 0.15

    def __post_init__(self) -> None:
        if not (math.isfinite(self.tick_s) and self.tick_s > 0.0):
            raise InvalidInputError("tick_s", self.tick_s, "> 0")
        if self.replan_ticks < 1:
            raise InvalidInputError("replan_ticks", self.replan_ticks, ">= 1")
        if not (math.isfinite(self.last_replan_s) and self.last_replan_s >= 0.0):
            raise InvalidInputError("last_replan_s", self.last_replan_s, ">= 0")
        if not 0.0 <= self.thrust_reserve < 1.0:
            raise InvalidInputError("thrust_reserve", self.thrust_reserve, "[0, 1)")


@dataclass(frozen=True)
class VehicleErrors:
    """What was drawn for one flight.

    Attributes:
        initial_state: (7,) difference from the nominal initial state, SI.
        specific_impulse: Relative error.
        thrust: Relative error of the magnitude.
        thrust_direction_rad: (2,) rotation of the thrust about the core's y and z axes.
    """

    initial_state: Array
    specific_impulse: float
    thrust: float
    thrust_direction_rad: Array


@dataclass(frozen=True)
class Replan:
    """One planning attempt in flight.

    Attributes:
        tick: Index of the measurement it started from.
        outcome: What came of it.
        thrust_max_n: Greatest thrust that it was allowed to plan with.
    """

    tick: int
    outcome: PlanOutcome
    thrust_max_n: float


@dataclass(frozen=True)
class DescentRecord:
    """One flight. Rows are ticks; the last row is the end of the flight.

    Attributes:
        times_s: (M,) from the start.
        states: (M, 7) true states, SI, core axes (x up).
        measured: (M, 7) measured states.
        commanded: (M, 3) commanded thrust in N from each tick on; the last row repeats the one
            before it.
        thrusts: (M, 3) thrust of the engine, likewise.
        replans: Every planning attempt, in order.
        errors: What the vehicle did differently from what guidance assumed.
        seed: Seed of the random numbers.
        touched_down: Whether the flight ended on the ground, or else above it with the last plan.
        miss_position_m: Distance from the target at the end.
        miss_speed_m_s: Speed error at the end.
    """

    times_s: Array
    states: Array
    measured: Array
    commanded: Array
    thrusts: Array
    replans: tuple[Replan, ...]
    errors: VehicleErrors
    seed: int
    touched_down: bool
    miss_position_m: float
    miss_speed_m_s: float


def simulate_descent(
    settings: PlannerSettings,
    *,
    seed: int,
    dispersions: Dispersions | None = None,
    options: SimulationOptions | None = None,
) -> DescentRecord:
    """Fly one powered descent under replanned guidance.

    Args:
        settings: Vehicle, mission and how to plan; guidance assumes this vehicle.
        seed: Seed of all random numbers. The same arguments give the same record.
        dispersions: Size of the errors; those of `Dispersions` if None.
        options: How guidance runs; those of `SimulationOptions` if None.

    Raises:
        InvalidInputError: A refused setting.
        NoFirstPlanError: There is no certified plan from the first measured state.
    """
    options = options or SimulationOptions()
    random = np.random.default_rng(seed)
    planner = Planner(powered_descent(), settings)
    guidance = _Guidance(planner, options)
    vehicle = _Vehicle(planner, dispersions or Dispersions(), random)
    times, states, measured = [0.0], [vehicle.initial_state], []
    commanded: list[Array] = []
    thrusts: list[Array] = []
    while True:
        time_s, tick = times[-1], len(times) - 1
        measured.append(vehicle.measure(states[-1], random))
        if vehicle.touched_down or guidance.finished(time_s):
            break
        guidance.update(tick, time_s, measured[-1])
        held_s = min(options.tick_s, guidance.time_to_go_s(time_s))
        commanded.append(guidance.command(time_s, held_s))
        thrusts.append(vehicle.thrust(commanded[-1]))
        elapsed_s, state = vehicle.fly(states[-1], thrusts[-1], held_s)
        # A tick's time is a product, not a sum, so that rounding does not build up.
        whole = elapsed_s == options.tick_s
        times.append((tick + 1) * options.tick_s if whole else time_s + elapsed_s)
        states.append(state)
    target = planner.problem.table.unpack(planner.parameters)
    end = states[-1]
    return DescentRecord(
        times_s=np.array(times),
        states=np.array(states),
        measured=np.array(measured),
        commanded=np.array([*commanded, commanded[-1]]),
        thrusts=np.array([*thrusts, thrusts[-1]]),
        replans=tuple(guidance.replans),
        errors=vehicle.errors,
        seed=seed,
        touched_down=vehicle.touched_down,
        miss_position_m=float(np.linalg.norm(end[_POSITION] - target["final_position"])),
        miss_speed_m_s=float(np.linalg.norm(end[_VELOCITY] - target["final_velocity"])),
    )


class _Guidance:
    """Replans at its period and commands the thrust of the last certified plan."""

    def __init__(self, planner: Planner, options: SimulationOptions) -> None:
        self.replans: list[Replan] = []
        self._planner = planner
        self._options = options
        self._parameters = planner.parameters
        self._plan: Plan | None = None
        self._plan_start_s = 0.0
        self._impulse = np.zeros((0, 3))

    def time_to_go_s(self, time_s: float) -> float:
        assert self._plan is not None
        return self._plan_start_s + self._plan.terminal_time_s - time_s

    def finished(self, time_s: float) -> bool:
        return self._plan is not None and self.time_to_go_s(time_s) <= 1e-9

    def update(self, tick: int, time_s: float, measured: Array) -> None:
        """Plan, if it is time to.

        Raises:
            NoFirstPlanError: There is no plan to fly.
        """
        if tick % self._options.replan_ticks:
            return
        if self._plan is not None and self.time_to_go_s(time_s) < self._options.last_replan_s:
            return
        thrust_max_n = self._thrust_limit_n(time_s)
        table = self._planner.problem.table
        self._planner.parameters = table.pack({"thrust_max": thrust_max_n}, self._parameters)
        outcome = self._planner.plan(
            measured, warm_start=self._plan, elapsed_s=time_s - self._plan_start_s
        )
        self.replans.append(Replan(tick, outcome, thrust_max_n))
        if outcome.status is PlanStatus.CERTIFIED and outcome.plan is not None:
            self._adopt(outcome.plan, time_s)
        elif self._plan is None:
            raise NoFirstPlanError(f"{outcome.status.name}: {outcome.message}")

    def command(self, time_s: float, held_s: float) -> Array:
        """Mean of the planned thrust over the time that it will be held."""
        assert self._plan is not None
        moments = np.array([0.0, held_s]) + (time_s - self._plan_start_s)
        reached = [np.interp(moments, self._plan.times_s, axis) for axis in self._impulse.T]
        return np.diff(np.array(reached), axis=1)[:, 0] / held_s

    def _thrust_limit_n(self, time_s: float) -> float:
        """Greatest thrust of the next plan: the reserve is given back as time runs out."""
        thrust_max_n = float(self._parameters[self._planner.problem.table.slice("thrust_max")][0])
        kept = 1.0
        if self._plan is not None:
            to_go_s = self.time_to_go_s(time_s)
            kept = math.sqrt(to_go_s / (time_s + to_go_s))
        return (1.0 - kept * self._options.thrust_reserve) * thrust_max_n

    def _adopt(self, plan: Plan, time_s: float) -> None:
        self._plan, self._plan_start_s = plan, time_s
        # Between nodes, the mean of both is flown: that is what the midpoint rule assumes.
        means = 0.5 * (plan.controls[1:] + plan.controls[:-1])
        steps = np.diff(plan.times_s)[:, np.newaxis]
        self._impulse = np.vstack([np.zeros(3), np.cumsum(means * steps, axis=0)])


class _Vehicle:
    """The true vehicle and its navigation."""

    def __init__(
        self, planner: Planner, dispersions: Dispersions, random: np.random.Generator
    ) -> None:
        problem = planner.problem
        nominal = planner.initial_state
        spread = np.repeat(
            [
                dispersions.initial_position_m,
                dispersions.initial_velocity_m_s,
                dispersions.initial_mass * nominal[_MASS],
            ],
            [3, 3, 1],
        )
        self.errors = VehicleErrors(
            initial_state=spread * random.standard_normal(7),
            specific_impulse=dispersions.specific_impulse * random.standard_normal(),
            thrust=dispersions.thrust * random.standard_normal(),
            thrust_direction_rad=dispersions.thrust_direction_rad * random.standard_normal(2),
        )
        self.initial_state = nominal + self.errors.initial_state
        self.touched_down = False
        self._dispersions = dispersions
        values = problem.table.unpack(planner.parameters)
        impulse = float(values["specific_impulse"]) * (1.0 + self.errors.specific_impulse)
        self._parameters = problem.table.pack({"specific_impulse": impulse}, planner.parameters)
        self._thrust_bounds_n = float(values["thrust_min"]), float(values["thrust_max"])
        self._ground_m = float(np.atleast_1d(values["final_position"])[0])
        symbols = ca.SX.sym("x", 7), ca.SX.sym("u", 3), ca.SX.sym("p", problem.table.size)
        x, u, p = symbols
        rates = problem.dynamics(x, u, named(problem, p))
        self._rates = CompiledFunction("rates", list(symbols), [rates])

    def measure(self, state: Array, random: np.random.Generator) -> Array:
        """State as navigation sees it."""
        noise = random.standard_normal(7)
        noise[_POSITION] *= self._dispersions.navigation_position_m
        noise[_VELOCITY] *= self._dispersions.navigation_velocity_m_s
        noise[_MASS] *= self._dispersions.navigation_mass * state[_MASS]
        return np.asarray(state + noise)

    def thrust(self, commanded: Array) -> Array:
        """What the engine makes of a command: scaled, within its bounds, misaligned."""
        low, high = self._thrust_bounds_n
        size = float(np.linalg.norm(commanded))
        made = min(max((1.0 + self.errors.thrust) * size, low), high)
        about_y, about_z = self.errors.thrust_direction_rad
        # Rotation vector (0, about_y, about_z) crossed with the thrust: first order is enough for
        # a misalignment, and the size is restored below.
        turned = commanded + np.cross([0.0, about_y, about_z], commanded)
        return np.asarray(turned * (made / np.linalg.norm(turned)))

    def fly(self, state: Array, thrust: Array, duration_s: float) -> tuple[float, Array]:
        """Time flown and state then, at the end of the duration or at touchdown."""

        def altitude(_: float, x: Array) -> float:
            return float(x[0]) - self._ground_m

        altitude.terminal, altitude.direction = True, -1.0  # type: ignore[attr-defined]
        flown = scipy.integrate.solve_ivp(
            lambda _, x: self._rates(x, thrust, self._parameters)[0],
            (0.0, duration_s),
            state,
            method="DOP853",
            rtol=_RELATIVE_TOLERANCE,
            atol=_ABSOLUTE_TOLERANCE,
            events=altitude,
        )
        self.touched_down = flown.status == 1
        return float(flown.t[-1]), np.asarray(flown.y[:, -1])

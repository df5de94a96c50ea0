"""Guidance of an entry: plans now and then, and their angles followed in between."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dscp_core.planning.plan import PlanOutcome, PlanStatus
from dscp_core.planning.planner import Planner
from dscp_core.problem.options import option, validate
from dscp_core.problem.trajectory import Plan
from dscp_core.problems.entry.motion import Motion
from dscp_core.problems.entry.physics import ALPHA, BANK, GAMMA, HEADING, SPEED

Array = NDArray[np.float64]

_ANGLES = (ALPHA, BANK)
_DIRECTION_NOISE_RAD, _SPEED_NOISE_M_S = 1.5e-4, 0.15
"""Of the difference of two measurements that follow each other."""


@dataclass(frozen=True)
class GuidanceSettings:
    """How an entry is guided."""

    tick_s: float = option(2.0, "s", "Between measurements and commands.", lower=0.01, upper=60.0)
    replan_s: float = option(60.0, "s", "Between plans.", lower=0.01)
    replan_part: float = option(
        0.1, "1", "Between plans near the end: this part of the time to go.", lower=0.001, upper=1.0
    )
    last_replan_s: float = option(20.0, "s", "With less to go, the last plan is kept.")
    limit_margin: float = option(
        0.04,
        "1",
        "Part of the limits of heat rate, dynamic pressure and load that plans leave unused.",
        upper=0.9,
    )
    angle_gain_per_s: float = option(0.2, "1/s", "Rate per error of an angle.", upper=10.0)
    memory_s: float = option(
        150.0, "s", "How long the estimate of lift and drag remembers.", lower=1.0
    )
    air_known_to: float = option(
        0.1, "1", "Deviation of lift and drag that it begins with, relative; 0 for none.", upper=1.0
    )

    def __post_init__(self) -> None:
        validate(self)


@dataclass(frozen=True)
class Replan:
    """One planning attempt in flight.

    Attributes:
        time_s: Of the measurement that it started from.
        outcome: What came of it.
    """

    time_s: float
    outcome: PlanOutcome


class AirEstimate:
    """Lift and drag over those of the model, by least squares that forget.

    One measurement is predicted from the one before; what the speed lacks is drag, and what the
    direction has turned too far is lift.
    """

    def __init__(self, planner: Planner, settings: GuidanceSettings) -> None:
        """Nothing is known yet.

        Args:
            planner: Of the nominal vehicle.
            settings: How to guide.
        """
        self.factors = np.ones(2)
        self._motion = Motion(planner.problem)
        self._parameters = planner.parameters.copy()
        self._kept = math.exp(-settings.tick_s / settings.memory_s)
        self._known = settings.air_known_to
        self._sums = np.zeros((2, 2))  # of lift and drag: regressor times residual, its square
        self._before: Array | None = None

    def update(self, measured: Array, rates: Array, elapsed_s: float) -> None:
        """Learn from a measurement.

        Args:
            measured: (8,).
            rates: (2,) that were commanded since the one before.
            elapsed_s: Time since then.
        """
        before, self._before = self._before, measured
        if before is None or self._known == 0.0:
            return
        predicted = self._motion.step(before, rates, self._parameters, elapsed_s)
        speed, bank = float(predicted[SPEED]), float(predicted[BANK])
        off = measured - predicted
        turned = off[GAMMA] * math.cos(bank)
        turned += off[HEADING] * math.cos(predicted[GAMMA]) * math.sin(bank)
        residual = np.array([speed * turned, -off[SPEED]])
        regressor = self._motion.aerodynamic(before, self._parameters) * elapsed_s
        noise = np.array([speed * _DIRECTION_NOISE_RAD, _SPEED_NOISE_M_S])
        self._sums *= self._kept
        self._sums += np.array([regressor * residual, regressor**2]) / noise**2
        self.factors = 1.0 + self._sums[0] / (self._sums[1] + self._known**-2)

    def apply(self, planner: Planner, nominal: Array) -> None:
        """Let a planner plan with it: the air as dense as the drag says, the lift for the rest.

        Args:
            planner: Its parameters are replaced.
            nominal: Packed parameters without the estimate.
        """
        table = planner.problem.table
        lift, drag = self.factors
        values = table.unpack(nominal)
        planner.parameters = table.pack(
            {
                "sea_level_density": drag * float(values["sea_level_density"]),
                "lift_coefficients": lift / drag * np.asarray(values["lift_coefficients"]),
            },
            nominal,
        )


class EntryGuidance:
    """Plans at its period, and turns angle of attack and bank to the newest plan's."""

    def __init__(self, planner: Planner, settings: GuidanceSettings, latency_s: float) -> None:
        """Guidance of one flight.

        Args:
            planner: Plans with the limits that guidance keeps.
            settings: How to guide.
            latency_s: From a measurement to the plan that is made of it.
        """
        self.replans: list[Replan] = []
        self._planner = planner
        self._settings = settings
        self._latency_s = latency_s
        self._air = AirEstimate(planner, settings)
        self._nominal = planner.parameters.copy()
        self._rates_before = np.zeros(2)
        self._last_s = 0.0
        self._next_s = 0.0
        self._plan: Plan | None = None
        self._start_s = 0.0
        self._coming: tuple[float, Plan] | None = None
        values = planner.problem.table.unpack(planner.parameters)
        self._angles = _bounds(values, "")
        self._rates = _bounds(values, "_rate")

    @property
    def flying(self) -> bool:
        """Whether there is a plan."""
        return self._plan is not None or self._coming is not None

    def time_to_go_s(self, time_s: float) -> float:
        """Until the end of the plan that is flown."""
        assert self._plan is not None
        return self._start_s + self._plan.terminal_time_s - time_s

    def command(self, time_s: float, measured: Array) -> Array:
        """Rates (2,) of angle of attack and bank until the next measurement.

        Args:
            time_s: From the start.
            measured: (8,).
        """
        self._air.update(measured, self._rates_before, time_s - self._last_s)
        self._last_s = time_s
        if time_s >= self._next_s - 1e-9:
            self._replan(time_s, measured)
        if self._coming is not None and time_s >= self._coming[0] + self._latency_s - 1e-9:
            self._start_s, self._plan = self._coming
            self._coming = None
        if self._plan is None:
            return np.zeros(2)
        tick_s = self._settings.tick_s
        now_s = time_s - self._start_s
        here, there = (self._planned(now_s + ahead_s) for ahead_s in (0.0, tick_s))
        angles = measured[list(_ANGLES)]
        gain = min(self._settings.angle_gain_per_s, 1.0 / tick_s)
        rates = (there - here) / tick_s + gain * (here - angles)
        rates = np.clip(rates, *self._rates)
        # The angles themselves are limited too: no rate leads beyond them within the tick.
        low, high = ((bound - angles) / tick_s for bound in self._angles)
        self._rates_before = np.clip(rates, np.minimum(low, 0.0), np.maximum(high, 0.0))
        return self._rates_before

    def _planned(self, time_s: float) -> Array:
        """Angles of the plan; those of its end after it."""
        assert self._plan is not None
        columns = (self._plan.states[:, index] for index in _ANGLES)
        return np.array([np.interp(time_s, self._plan.times_s, column) for column in columns])

    def _replan(self, time_s: float, measured: Array) -> None:
        newest = self._plan if self._coming is None else self._coming[1]
        start_s = self._start_s if self._coming is None else self._coming[0]
        to_go_s = math.inf if newest is None else start_s + newest.terminal_time_s - time_s
        settings = self._settings
        self._next_s = time_s + max(
            settings.tick_s, min(settings.replan_s, settings.replan_part * to_go_s)
        )
        if to_go_s <= settings.last_replan_s:
            return
        self._air.apply(self._planner, self._nominal)
        outcome = self._planner.plan(measured, warm_start=newest, elapsed_s=time_s - start_s)
        self.replans.append(Replan(time_s, outcome))
        if outcome.status is PlanStatus.CERTIFIED and outcome.plan is not None:
            self._coming = (time_s, outcome.plan)


def _bounds(values: Mapping[str, object], suffix: str) -> tuple[Array, Array]:
    """Least and greatest (2,) of both angles, or of their rates."""
    names = ("angle_of_attack" + suffix, "bank" + (suffix or "_angle"))
    low, high = (
        np.array([values[f"{name}_{end}"] for name in names], dtype=np.float64)
        for end in ("min", "max")
    )
    return low, high

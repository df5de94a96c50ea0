"""Closed-loop landings: a vehicle that is not quite as assumed, under guidance with replanning.

Guidance sees noisy, late measurements, its plans and commands come late, engine and attitude lag.
A flight ends where the vehicle meets the ground.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dscp_core.errors import DscpError
from dscp_core.planning.planner import Planner
from dscp_core.problem.options import declared, option, validate, values
from dscp_core.problem.parameters import Parameter, ParameterTable
from dscp_core.problem.simulation import FlightFigure, FlightRecord, FlightSummary, worst_of
from dscp_core.problems.powered_descent.flight import Flight, Replan
from dscp_core.problems.powered_descent.guidance.landing import Phase
from dscp_core.problems.powered_descent.guidance.settings import GuidanceSettings
from dscp_core.problems.powered_descent.guidance.vehicle import Vehicle
from dscp_core.problems.powered_descent.motion import Array, Event, TrueMotion
from dscp_core.problems.powered_descent.truth import TruthSettings, VehicleErrors

__all__ = ["DescentRecord", "DescentSimulation", "LandingBounds", "NothingToFlyError", "Replan"]

_POSITION, _VELOCITY, _MASS = slice(0, 3), slice(3, 6), 6


class NothingToFlyError(DscpError):
    """No plan leads from the nominal start to the pad."""


@dataclass(frozen=True)
class LandingBounds:
    """What makes a landing a success."""

    contact_speed_most_m_s: float = option(0.5, "m/s", "Speed at contact.")
    contact_position_most_m: float = option(1.0, "m", "Distance from the pad at contact.")
    contact_tilt_most_rad: float = option(
        math.radians(5.0), "rad", "Thrust off the vertical at contact."
    )

    def __post_init__(self) -> None:
        validate(self)


@dataclass(frozen=True)
class DescentRecord(FlightRecord):
    """One landing in full.

    Attributes:
        replans: Every planning attempt, in order.
        errors: What the vehicle did differently from what guidance assumed.
    """

    replans: tuple[Replan, ...]
    errors: VehicleErrors


class DescentSimulation:
    """Landings of one vehicle under one guidance; a flight is a function of its seed alone.

    Can be pickled; a copy compiles its own functions. Not safe for several threads.
    """

    footprint = ("contact_y_m", "contact_z_m")

    def __init__(self, planner: Planner, options: Mapping[str, Any] | None = None) -> None:
        """Plan the nominal landing, for what suits the vehicle.

        Args:
            planner: Vehicle and mission as guidance assumes them, and how to plan.
            options: What differs from that, by name, SI: options of `GuidanceSettings`,
                `TruthSettings` and `LandingBounds`.

        Raises:
            InvalidInputError: An unknown option, a bad value, or an engine that does not carry the
                vehicle, be it as assumed or as it truly is.
            NothingToFlyError: There is no other reason why there is no plan from the nominal start.
        """
        chosen = _sorted(options or {})
        self._options = dict(options or {})
        # One of its own, which has planned nothing yet: what a solver was set up with stays in the
        # last digits of its answers.
        self.planner = copy.copy(planner)
        self.values: Mapping[str, Any] = planner.problem.table.unpack(planner.parameters)
        self.truth = TruthSettings.suited(self.values, **chosen[TruthSettings])
        self.bounds = LandingBounds(**chosen[LandingBounds])
        self.figures = _figures(self.bounds)
        vehicle, nominal = Vehicle.of(self.values), self.planner.plan()
        if nominal.plan is None or not (nominal.certified or nominal.converged):
            vehicle.require_carries(float(self.values["initial_mass"]), "at the start")
            raise NothingToFlyError(nominal.headline)
        self._landing_kg = float(nominal.plan.states[-1, _MASS])
        self.truth.require_carries(
            self._landing_kg * vehicle.gravity_m_s2, nominal.plan.terminal_time_s
        )
        self._longest_s = 3.0 * nominal.plan.terminal_time_s + 60.0
        self.guidance = GuidanceSettings.suited(
            self.values, self._landing_kg, **chosen[GuidanceSettings]
        )
        self._motion = TrueMotion()

    def __reduce__(self) -> tuple[Any, ...]:
        """By what it was made of; the copy compiles and plans the nominal landing again."""
        return DescentSimulation, (self.planner, self._options)

    @property
    def settings(self) -> Mapping[str, Any]:
        """Everything that decides a flight but its seed."""
        how = self.planner.settings
        return {
            "vehicle": {n: np.asarray(v).tolist() for n, v in self.values.items()},
            "planner": {
                "intervals": how.intervals,
                "terminal_time": how.terminal_time.value,
                "hold": how.hold.value,
                "solver": how.options.solver,
            },
            "guidance": values(self.guidance),
            "truth": values(self.truth),
            "bounds": values(self.bounds),
        }

    def fly(self, seed: int) -> FlightSummary:
        """Fly once."""
        return self.record(seed).summary

    def record(self, seed: int) -> DescentRecord:
        """Fly once, and keep everything."""
        flight = Flight(self.planner, self._motion, self.values, self.guidance, self.truth, seed)
        flight.fly(self._longest_s)
        return DescentRecord(
            summary=self._summary(flight, seed),
            times_s=np.array(flight.times),
            states=np.array(flight.states),
            measured=np.array(flight.measured),
            measured_at_s=np.array(flight.times) - self.truth.delay_s,
            commanded=np.array(flight.commanded),
            controls=np.array(flight.thrusts),
            phases=tuple(flight.phases),
            events=tuple(flight.events),
            histories=self._histories(np.array(flight.states), np.array(flight.thrusts)),
            replans=tuple(flight.replans),
            errors=flight.world.errors,
        )

    def _histories(self, states: Array, thrusts: Array) -> dict[str, Array]:
        """What a figure of a flight shows."""
        lateral = np.linalg.norm(thrusts[:, 1:], axis=1)
        return {
            "altitude_m": states[:, 0] - self.values["final_position"][0],
            "speed_m_s": np.linalg.norm(states[:, _VELOCITY], axis=1),
            "thrust_kn": np.linalg.norm(thrusts, axis=1) / 1e3,
            "tilt_deg": np.degrees(np.arctan2(lateral, thrusts[:, 0])),
            "off_pad_m": np.linalg.norm(states[:, 1:3] - self.values["final_position"][1:], axis=1),
            "mass_kg": states[:, _MASS],
        }

    def optimum_kg(self, start: Array) -> float | None:
        """Least propellant from a state (7,) to the pad with the nominal vehicle.

        None where the planner finds no plan that converges.
        """
        outcome = self.planner.plan(start)
        if outcome.plan is None or not outcome.converged:
            return None
        return float(start[_MASS] - outcome.plan.states[-1, _MASS])

    def _summary(self, flight: Flight, seed: int) -> FlightSummary:
        end, start = flight.states[-1], flight.states[0]
        offset = end[_POSITION] - self.values["final_position"]
        refused = sum(not r.flown for r in flight.replans)
        figures = {
            "contact_speed_m_s": float(np.linalg.norm(end[_VELOCITY])),
            "contact_vertical_m_s": float(-end[3]),
            "contact_lateral_m_s": float(np.linalg.norm(end[4:6])),
            "contact_position_m": float(np.linalg.norm(offset)),
            "contact_y_m": float(offset[1]),
            "contact_z_m": float(offset[2]),
            "contact_tilt_rad": _tilt_rad(flight.world.state[8:11]),
            "fuel_kg": float(start[_MASS] - end[_MASS]),
            "flight_s": flight.times[-1],
            "replans": float(len(flight.replans)),
            "refused_replans": float(refused),
        }
        optimum_kg = self.optimum_kg(start)
        if optimum_kg is not None:
            figures["fuel_over_optimum"] = figures["fuel_kg"] / optimum_kg - 1.0
            vehicle = Vehicle.of(self.values)
            hover_kg_s = self._landing_kg * vehicle.gravity_m_s2 / vehicle.exhaust_speed_m_s
            if hover_kg_s > 0.0:
                figures["excess_hover_s"] = (figures["fuel_kg"] - optimum_kg) / hover_kg_s
        failure = ""
        if flight.world.dry_s < math.inf:
            failure = Event.DRY.value
        elif flight.guidance.phase is Phase.WAITING:
            failure = "no first plan"
        elif not flight.world.landed:
            failure = "no contact"
        if not flight.world.landed:
            figures = {n: v for n, v in figures.items() if not n.startswith("contact")}
        worst = "" if failure else worst_of(self.figures, figures)
        return FlightSummary(seed, figures, failure, worst, _story(figures, failure))


def _tilt_rad(direction: Array) -> float:
    return math.atan2(float(np.hypot(direction[1], direction[2])), float(direction[0]))


def _story(figures: Mapping[str, float], failure: str) -> str:
    if failure:
        return f"{failure} after {figures['flight_s']:.1f} s"
    return (
        f"contact after {figures['flight_s']:.2f} s at {figures['contact_speed_m_s']:.2f} m/s, "
        f"{figures['contact_position_m']:.2f} m from the pad, tilted by "
        f"{math.degrees(figures['contact_tilt_rad']):.1f} deg; {figures['fuel_kg']:.5g} kg burnt"
    )


def _figures(bounds: LandingBounds) -> tuple[FlightFigure, ...]:
    speed, position = bounds.contact_speed_most_m_s, bounds.contact_position_most_m
    tilt = bounds.contact_tilt_most_rad
    return (
        FlightFigure("contact_speed_m_s", "m/s", "speed at contact", speed, "hard"),
        FlightFigure("contact_vertical_m_s", "m/s", "descent at contact"),
        FlightFigure("contact_lateral_m_s", "m/s", "lateral speed at contact"),
        FlightFigure(
            "contact_position_m", "m", "distance from the pad at contact", position, "off target"
        ),
        FlightFigure("contact_y_m", "m", "from the pad along y at contact"),
        FlightFigure("contact_z_m", "m", "from the pad along z at contact"),
        FlightFigure(
            "contact_tilt_rad", "rad", "thrust off the vertical at contact", tilt, "tilted"
        ),
        FlightFigure("fuel_kg", "kg", "propellant burnt"),
        FlightFigure("fuel_over_optimum", "1", "propellant above the optimum's, relative to it"),
        FlightFigure("excess_hover_s", "s", "the same as time of hover before landing"),
        FlightFigure("flight_s", "s", "time to contact"),
        FlightFigure("replans", "1", "plans asked for"),
        FlightFigure("refused_replans", "1", "of them not flown"),
    )


def _sorted(options: Mapping[str, Any]) -> dict[Any, dict[str, Any]]:
    """Options by the settings that they belong to.

    Raises:
        InvalidInputError: One that belongs to none.
    """
    owners = {p.name: kind for kind in _KINDS for p in declared(kind)}
    chosen: dict[Any, dict[str, Any]] = {kind: {} for kind in _KINDS}
    table = ParameterTable(p for kind in _KINDS for p in declared(kind))
    for name, value in options.items():
        chosen[owners[table[name].name]][name] = value
    return chosen


def _options(kind: Any) -> tuple[Parameter, ...]:
    """Options of one kind of settings; NaN stands for what suits the vehicle."""
    return tuple(replace(p, default=math.nan) if p.name in SUITED else p for p in declared(kind))


class DescentSimulations:
    """Makes simulations from options by name."""

    @property
    def truth(self) -> tuple[Parameter, ...]:
        """See `Simulated`."""
        return _options(TruthSettings)

    @property
    def guidance(self) -> tuple[Parameter, ...]:
        """See `Simulated`."""
        return _options(GuidanceSettings)

    @property
    def bounds(self) -> tuple[Parameter, ...]:
        """See `Simulated`."""
        return _options(LandingBounds)

    def __call__(self, planner: Planner, options: Mapping[str, Any]) -> DescentSimulation:
        """See `DescentSimulation`."""
        return DescentSimulation(planner, options)


_KINDS: tuple[Any, ...] = (GuidanceSettings, TruthSettings, LandingBounds)
SUITED = frozenset((*GuidanceSettings.SUITED, *TruthSettings.SUITED))
"""Options whose default follows from vehicle and mission."""

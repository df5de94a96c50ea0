"""Closed-loop flights of an entry, until they pass their target."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dscp_core.errors import DscpError, InvalidInputError
from dscp_core.planning.plan import TerminalTime
from dscp_core.planning.planner import Planner
from dscp_core.problem.options import declared, option, validate, values
from dscp_core.problem.parameters import Parameter, ParameterTable
from dscp_core.problem.simulation import FlightFigure, FlightRecord, FlightSummary
from dscp_core.problems.entry.guidance import EntryGuidance, GuidanceSettings
from dscp_core.problems.entry.motion import LIMITED
from dscp_core.problems.entry.physics import ALPHA, BANK, GAMMA, HEADING, RADIUS, SPEED
from dscp_core.problems.entry.truth import (
    ARRIVED,
    Target,
    TrueMotion,
    TruthSettings,
    draw,
    measure,
    true_values,
)

Array = NDArray[np.float64]

_LATEST = 2.0
"""A flight that takes so many times the first plan's time never arrives."""


class NothingToFlyError(DscpError):
    """No plan leads from the nominal start to the target."""


@dataclass(frozen=True)
class ArrivalBounds:
    """What makes an arrival a success."""

    altitude_most_m: float = option(500.0, "m", "Error of the altitude abeam of the target.")
    cross_track_most_m: float = option(2000.0, "m", "Distance abeam of the target.")
    flight_path_angle_most_rad: float = option(
        math.radians(1.0), "rad", "Error of the flight-path angle there."
    )
    heading_most_rad: float = option(math.radians(2.0), "rad", "Error of the heading there.")

    def __post_init__(self) -> None:
        validate(self)


class EntrySimulated:
    """Makes simulations of entries."""

    truth = declared(TruthSettings)
    guidance = declared(GuidanceSettings)
    bounds = declared(ArrivalBounds)

    def __call__(self, planner: Planner, options: Mapping[str, Any]) -> EntrySimulation:
        """See `Simulated`."""
        ParameterTable((*self.truth, *self.guidance, *self.bounds)).pack(options)
        return EntrySimulation(
            planner,
            TruthSettings(**_chosen(self.truth, options)),
            GuidanceSettings(**_chosen(self.guidance, options)),
            ArrivalBounds(**_chosen(self.bounds, options)),
        )


def _chosen(parameters: Sequence[Parameter], options: Mapping[str, Any]) -> dict[str, Any]:
    return {p.name: options[p.name] for p in parameters if p.name in options}


class EntrySimulation:
    """Entries of one vehicle, mission, guidance and truth.

    Can be pickled; not safe for several threads.
    """

    footprint = ("cross_track_m", "altitude_offset_m")

    def __init__(
        self,
        planner: Planner,
        truth: TruthSettings | None = None,
        guidance: GuidanceSettings | None = None,
        bounds: ArrivalBounds | None = None,
    ) -> None:
        """Compile what flights need.

        Args:
            planner: Vehicle, mission and how to plan; with a free terminal time.
            truth: The world; that of `TruthSettings` if None.
            guidance: How to guide, likewise.
            bounds: What makes a success, likewise.

        Raises:
            InvalidInputError: The planner's terminal time is not free.
            NothingToFlyError: No plan leads from the nominal start to the target.
        """
        if planner.settings.terminal_time is not TerminalTime.FREE:
            raise InvalidInputError(
                "terminal_time", planner.settings.terminal_time.value, "free, to plan in flight"
            )
        self.truth = truth or TruthSettings()
        self.guidance = guidance or GuidanceSettings()
        self.bounds = bounds or ArrivalBounds()
        self._given = planner
        self._values = planner.problem.table.unpack(planner.parameters)
        kept = 1.0 - self.guidance.limit_margin
        limits = {f"{name}_max": kept * float(self._values[f"{name}_max"]) for name in LIMITED}
        # A mission's least time is that of the whole flight; every replan has less to go.
        limits["terminal_time_min"] = planner.problem.table["terminal_time_min"].lower
        self.planner = copy.copy(planner)
        self.planner.parameters = planner.problem.table.pack(limits, planner.parameters)
        self._motion = TrueMotion(planner.problem)
        self._target = Target.of(self._values)
        # Every copy begins with the same plan: what a solver was set up with stays in the last
        # digits of its answers.
        nominal = self.planner.plan()
        if nominal.plan is None or not nominal.certified:
            raise NothingToFlyError(f"no first plan from the nominal start: {nominal.headline}")
        self._nominal = self.planner.parameters.copy()
        self._longest_s = _LATEST * nominal.plan.terminal_time_s

    def __reduce__(self) -> tuple[Any, ...]:
        """By what it was made of; the copy compiles its own functions."""
        return EntrySimulation, (self._given, self.truth, self.guidance, self.bounds)

    @property
    def figures(self) -> tuple[FlightFigure, ...]:
        """See `Simulation`."""
        bounds = self.bounds
        return (
            FlightFigure(
                "altitude_error_m",
                "m",
                "Off the target's altitude, abeam of it.",
                bounds.altitude_most_m,
                "high or low",
            ),
            FlightFigure(
                "cross_track_error_m",
                "m",
                "Distance to the target, abeam of it.",
                bounds.cross_track_most_m,
                "off target",
            ),
            FlightFigure(
                "flight_path_angle_error_rad",
                "rad",
                "Off the wanted flight-path angle.",
                bounds.flight_path_angle_most_rad,
                "steep",
            ),
            FlightFigure(
                "heading_error_rad",
                "rad",
                "Off the wanted heading.",
                bounds.heading_most_rad,
                "astray",
            ),
            *(
                FlightFigure(
                    f"{name}_ratio",
                    "1",
                    f"Greatest {name.replace('_', ' ')} over its limit.",
                    1.0,
                    f"{name.replace('_', ' ')} exceeded",
                )
                for name in LIMITED
            ),
            FlightFigure("speed_m_s", "m/s", "Speed abeam of the target."),
            FlightFigure("flight_s", "s", "Duration."),
            FlightFigure("replans", "1", "Plans that were asked for."),
            FlightFigure("refused_replans", "1", "Of them, those without a certified plan."),
            FlightFigure("cross_track_m", "m", "To the right of the target."),
            FlightFigure("altitude_offset_m", "m", "Above the target."),
        )

    @property
    def settings(self) -> Mapping[str, Any]:
        """See `Simulation`."""
        planner = self._given
        return {
            "vehicle": {n: np.asarray(v).tolist() for n, v in self._values.items()},
            "planner": {
                "intervals": planner.settings.intervals,
                "hold": planner.settings.hold.value,
                "solver": planner.settings.options.solver,
            },
            "guidance": dict(values(self.guidance)),
            "truth": dict(values(self.truth)),
            "bounds": dict(values(self.bounds)),
        }

    def fly(self, seed: int) -> FlightSummary:
        """See `Simulation`."""
        return self.record(seed).summary

    def record(self, seed: int) -> FlightRecord:
        """See `Simulation`."""
        flight = self._fly(np.random.default_rng(seed))
        states = np.array(flight.states)
        commanded = np.array([*flight.commands, flight.commands[-1]])
        return FlightRecord(
            summary=self._summary(flight, seed),
            times_s=np.array(flight.times),
            states=states,
            measured=np.array(flight.measured),
            measured_at_s=np.array(flight.times),
            commanded=commanded,
            controls=commanded,
            phases=tuple("entry" for _ in flight.times),
            events=tuple(flight.events),
            histories={
                "altitude_km": (states[:, RADIUS] - float(self._values["planet_radius"])) / 1e3,
                "speed_km_s": states[:, SPEED] / 1e3,
                "flight_path_angle_deg": np.degrees(states[:, GAMMA]),
                "heat_rate_ratio": np.array([0.0, *(load[1] for load in flight.loads)]),
                "angle_of_attack_deg": np.degrees(states[:, ALPHA]),
                "bank_angle_deg": np.degrees(states[:, BANK]),
            },
        )

    def _fly(self, random: np.random.Generator) -> _Flight:
        problem, assumed, tick_s = self.planner.problem, self._values, self.guidance.tick_s
        errors = draw(self.truth, assumed, random)
        truth = true_values(assumed, errors)
        parameters = problem.table.pack(truth)
        limits = np.array([float(assumed[f"{name}_max"]) for name in LIMITED])
        self.planner.parameters = self._nominal.copy()  # guidance adapts them in flight
        guidance = EntryGuidance(self.planner, self.guidance, self.truth.planning_latency_s)
        flight = _Flight(guidance, [self.planner.initial_state + errors.initial_state])
        while not flight.ending:
            time_s, state = flight.times[-1], flight.states[-1]
            flight.measured.append(measure(state, self.truth, assumed, random))
            known = len(guidance.replans)
            flight.commands.append(guidance.command(time_s, flight.measured[-1]))
            flight.events += [(r.time_s, r.outcome.headline) for r in guidance.replans[known:]]
            if not guidance.flying:
                flight.ending = "no first plan"
                break
            flown_s, end, loads, flight.ending = self._motion.fly(
                state, flight.commands[-1], parameters, tick_s, self._target
            )
            # A tick's time is a product, not a sum, so that rounding does not build up.
            whole = flown_s == tick_s
            flight.times.append(len(flight.times) * tick_s if whole else time_s + flown_s)
            flight.states.append(end)
            flight.loads.append(loads / limits)
            if not flight.ending and flight.times[-1] > self._longest_s:
                flight.ending = "never arrived"
        flight.measured += [measure(flight.states[-1], self.truth, assumed, random)]
        flight.events.append((flight.times[-1], flight.ending))
        return flight

    def _summary(self, flight: _Flight, seed: int) -> FlightSummary:
        end, assumed = flight.states[-1], self._values
        figures = {
            "flight_s": flight.times[-1],
            "replans": float(len(flight.guidance.replans)),
            "refused_replans": float(sum(not r.outcome.certified for r in flight.guidance.replans)),
        }
        if flight.loads:
            worst = np.max(flight.loads, axis=0)
            figures |= {f"{n}_ratio": float(v) for n, v in zip(LIMITED, worst, strict=True)}
        if flight.ending != ARRIVED:
            return FlightSummary(
                seed, figures, flight.ending, story=f"after {flight.times[-1]:.0f} s"
            )
        _, across_m = self._target.offset_m(end)
        altitude_m = float(end[RADIUS]) - self._target.radius_m
        turned = float(end[HEADING]) - float(assumed["final_heading"])
        figures |= {
            "altitude_error_m": abs(altitude_m),
            "cross_track_error_m": abs(across_m),
            "flight_path_angle_error_rad": abs(
                float(end[GAMMA]) - float(assumed["final_flight_path_angle"])
            ),
            "heading_error_rad": abs(math.remainder(turned, 2.0 * math.pi)),
            "speed_m_s": float(end[SPEED]),
            "cross_track_m": across_m,
            "altitude_offset_m": altitude_m,
        }
        story = (
            f"passed {abs(across_m):.0f} m beside and {abs(altitude_m):.0f} m "
            f"{'above' if altitude_m > 0.0 else 'below'} the target after "
            f"{flight.times[-1]:.0f} s, at {end[SPEED]:.0f} m/s"
        )
        return FlightSummary(seed, figures, story=story)


@dataclass
class _Flight:
    """One flight as far as it has got; see `FlightRecord`."""

    guidance: EntryGuidance
    states: list[Array]
    times: list[float] = field(default_factory=lambda: [0.0])
    measured: list[Array] = field(default_factory=list)
    commands: list[Array] = field(default_factory=list)
    loads: list[Array] = field(default_factory=list)
    events: list[tuple[float, str]] = field(default_factory=list)
    ending: str = ""

"""A simulation whose flights are over at once: a cart that is to stop at its mark."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from core.toy_problems import cart

from dscp_core.errors import InvalidInputError
from dscp_core.planning.planner import Planner
from dscp_core.problem.declaration import OptimalControlProblem
from dscp_core.problem.extras import Extras
from dscp_core.problem.parameters import Parameter, ParameterTable
from dscp_core.problem.simulation import FlightFigure, FlightRecord, FlightSummary, Simulation

FIGURES = (
    FlightFigure("stop_speed_m_s", "m/s", "Speed at the mark.", 1.0, "hard"),
    FlightFigure("miss_m", "m", "Distance from the mark.", 3.0, "off target"),
    FlightFigure("energy_j", "J", "What it took."),
    FlightFigure("east_m", "m", "Where it stops."),
    FlightFigure("north_m", "m", "Where it stops."),
)
VALUES = {"gain": 0.5, "dispersion": 1.0, "sleep_s": 0.0, "raising": 0.0, "grip": 1.0}
TICKS = 21


class CartSimulated:
    """Makes simulations of the cart."""

    truth = (
        Parameter("dispersion", 1.0, "1", "Factor on all random errors.", lower=0.0, upper=100.0),
        Parameter("raising", 0.0, "1", "Every so many flights one raises; 0 for none.", lower=0.0),
        Parameter("sleep_s", 0.0, "s", "How long a flight takes.", lower=0.0),
        Parameter("grip", 1.0, "1", "Of the wheels; none, and nothing moves.", lower=0.0),
    )
    guidance = (Parameter("gain", 0.5, "1/s", "Of the speed.", lower=0.0, upper=2.0),)
    bounds = ()

    def __call__(self, planner: Planner, options: Mapping[str, Any]) -> Simulation:
        """A simulation, see `Simulated`."""
        table = ParameterTable((*self.truth, *self.guidance))
        values = {name: float(v) for name, v in table.unpack(table.pack(options)).items()}
        if values["grip"] == 0.0:
            raise InvalidInputError("grip", 0.0, "> 0: a cart without any cannot start")
        mass_kg = float(planner.parameters[planner.problem.table.slice("mass")][0])
        return CartSimulation(mass_kg, values)


@dataclass(frozen=True)
class CartSimulation:
    """Numbers drawn from a seed, in the form of flights."""

    mass_kg: float
    values: Mapping[str, float]

    figures = FIGURES
    footprint = ("east_m", "north_m")

    @property
    def settings(self) -> Mapping[str, Any]:
        """All but what no figure depends on."""
        names = ("dispersion", "raising", "grip")
        return {
            "vehicle": {"mass": self.mass_kg, "range_max": [math.inf, 1.0]},
            "truth": {name: self.values[name] for name in names},
            "guidance": {"gain": self.values["gain"]},
        }

    def fly(self, seed: int) -> FlightSummary:
        """One flight."""
        return self.record(seed).summary

    def record(self, seed: int) -> FlightRecord:
        """One flight in full."""
        time.sleep(self.values["sleep_s"])
        if log := os.environ.get("CART_LOG"):
            descriptor = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
            os.write(descriptor, f"{seed}\n".encode())
            os.close(descriptor)
        if self.values["raising"] and seed % self.values["raising"] == 0:
            raise ZeroDivisionError(f"seed {seed}\nhas no wheels")
        random = np.random.default_rng(seed)
        east, north = self.values["dispersion"] * random.standard_normal(2) * (1.0, 0.5)
        speed = self.values["gain"] * random.gamma(2.0, 0.4)
        figures = {
            "stop_speed_m_s": speed,
            "miss_m": float(np.hypot(east, north)),
            "energy_j": self.mass_kg * random.uniform(1.0, 2.0),
            "east_m": float(east),
            "north_m": float(north),
        }
        lost = seed % 50 == 49
        if lost:
            del figures["stop_speed_m_s"]
        times = np.linspace(0.0, 2.0, TICKS)
        states = np.column_stack([east * times / 2.0, speed * np.ones(TICKS)])
        pushes = np.sin(times)[:, np.newaxis]
        return FlightRecord(
            FlightSummary(
                seed, figures, "never stopped" if lost else "", story=f"rolled {east:.1f} m"
            ),
            times,
            states,
            states + 0.01,
            times - 0.05,
            pushes,
            self.values["grip"] * pushes,
            tuple("roll" for _ in times),
            ((0.0, "pushed off"), (2.0, "stopped")),
            {"position_m": states[:, 0], "speed_m_s": states[:, 1], "force_n": pushes[:, 0]},
        )


def rolling_cart() -> OptimalControlProblem:
    """The cart of the toy problems, which can be flown."""
    return replace(cart(), extras=Extras(simulation=CartSimulated()))

"""A campaign: flights by seed, over all cores, kept in a file as they come."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from dscp_core.campaigns.documents import settings_document
from dscp_core.campaigns.statistics import ERROR
from dscp_core.errors import HelperLostError, InvalidInputError
from dscp_core.planning.planner import Planner, PlannerSettings
from dscp_core.problem.declaration import OptimalControlProblem
from dscp_core.problem.parameters import Value
from dscp_core.problem.simulation import FlightSummary, Simulation
from dscp_core.workers.choice import make_engine
from dscp_core.workers.engine import Engine
from dscp_core.workers.grid import Item, Row, code_version, run_grid
from dscp_core.workers.processes import SerialEngine

MOST_FLIGHTS = 10_000_000


@dataclass(frozen=True)
class Campaign:
    """What is flown. Calling it makes a worker's function from a seed to a flight.

    Attributes:
        problem: Brings a simulation along.
        settings: Of guidance's planner.
        options: Of truth, guidance and bounds by name, SI.
        planner: One that plans elsewhere, for flights one after the other in this process; None
            for one of the settings in every worker.

    Example:
        >>> from dscp_core.campaigns.campaign import seeds_of
        >>> seeds_of(1000, 3)
        (1000, 1001, 1002)
    """

    problem: OptimalControlProblem
    settings: PlannerSettings
    options: Mapping[str, Value] = field(default_factory=dict)
    planner: Planner | None = None

    def simulation(self) -> Simulation:
        """Its flights.

        Raises:
            InvalidInputError: The problem brings no simulation, an option is refused, or nothing
                can fly in this world.
        """
        simulated = self.problem.extras.simulation
        if simulated is None:
            raise InvalidInputError(
                "problem", self.problem.name, "one whose extras bring a simulation"
            )
        planner = self.planner or Planner(self.problem, self.settings)
        return simulated(planner, self.options)

    def __call__(self) -> Callable[[Item], Row]:
        """Compile what flights need."""
        simulation = self.simulation()
        return lambda item: asdict(fly(simulation, int(item[0])))


@dataclass(frozen=True)
class CampaignResult:
    """Every flight that was asked for, in the order of the seeds.

    Attributes:
        simulation: What flew.
        flights: What came of it; the same whatever flew where, and when.
        kept: How many of them an earlier run had left.
        damaged: Lines of the file that had been left half-written or changed; flown again.
        digest: Names the setup: all that decides a flight beside its seed, code included.
    """

    simulation: Simulation
    flights: tuple[FlightSummary, ...]
    kept: int
    damaged: int
    digest: str


def seeds_of(first: int, flights: int) -> tuple[int, ...]:
    """The campaign's seeds: one after the other.

    Raises:
        InvalidInputError: No flights, too many, or a seed below zero.
    """
    if not 1 <= flights <= MOST_FLIGHTS:
        raise InvalidInputError("flights", flights, f"[1, {MOST_FLIGHTS}]")
    if first < 0:
        raise InvalidInputError("seed", first, ">= 0")
    return tuple(range(first, first + flights))


def run_campaign(
    path: Path,
    campaign: Campaign,
    seeds: Sequence[int],
    *,
    workers: int | None = None,
    ray_address: str | None = None,
    report: Callable[[int], object] = lambda _: None,
    restart: bool = False,
) -> CampaignResult:
    """Fly what the file does not hold yet.

    Args:
        path: JSON Lines: first the setup, then one flight a line; made if there is none.
        campaign: What to fly.
        seeds: One per flight.
        workers: How many flights at once; None for one per processor.
        ray_address: Of the Ray cluster that computes; None for this machine.
        report: Told how many more flights are done.
        restart: Forget what the file holds.

    Raises:
        InvalidInputError: A setup that cannot be used.
        GridFileError: The file is of another setup, which the message names, cannot be written, or
            another process is writing to it.
        RayMissingError, RayClusterError: No usable cluster at the address.
        WorkerLostError: Workers keep dying.
        HelperLostError: Whoever plans is gone; the flights before are kept.
    """
    simulation = campaign.simulation()
    setup = identity(campaign, simulation)

    def engine() -> Engine[Item, Row]:
        if campaign.planner is not None:
            return SerialEngine(campaign)
        return make_engine(campaign, workers, ray_address)

    result = run_grid(path, setup, [(seed,) for seed in seeds], engine, report, restart=restart)
    flights = tuple(FlightSummary(**row) for row in result.rows)
    return CampaignResult(simulation, flights, result.kept, result.damaged, digest(setup))


def identity(campaign: Campaign, simulation: Simulation) -> dict[str, Any]:
    """All that decides a flight beside its seed, flat: nested names are joined by dots."""
    problem = campaign.problem
    flat: dict[str, Any] = {"problem": problem.name, "formulation": problem.formulation}
    if campaign.planner is not None:
        flat["planned_by"] = type(campaign.planner).__name__
    how = {f.name: getattr(campaign.settings, f.name) for f in fields(campaign.settings)}
    del how["parameters"]  # the simulation has every parameter's value
    _flatten(flat, "", settings_document({**simulation.settings, "planner": how}))
    return {**flat, "code": code_version()}


def digest(identity: Mapping[str, Any]) -> str:
    """Twelve letters that name a setup."""
    text = json.dumps(identity, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def _flatten(flat: dict[str, Any], prefix: str, settings: Mapping[str, Any]) -> None:
    for name, value in settings.items():
        if isinstance(value, Mapping):
            _flatten(flat, f"{prefix}{name}.", value)
        else:
            flat[prefix + name] = value


def fly(simulation: Simulation, seed: int) -> FlightSummary:
    """One flight, whatever happens in it: an exception is its failure, not the campaign's end.

    Raises:
        HelperLostError: Whoever plans for it is gone; a campaign goes on when they are back.
        MemoryError: There is none left.
    """
    try:
        return finite(simulation.fly(seed))
    except (HelperLostError, MemoryError):
        raise
    except Exception as error:  # noqa: BLE001 - one flight of thousands; named with its seed
        text = " ".join(f"{type(error).__name__}: {error}".split())
        return FlightSummary(seed, {}, ERROR, story=text)


def finite(summary: FlightSummary) -> FlightSummary:
    """The same, where every figure is a number; else a failed flight without those that are not."""
    numbers = {n: float(v) for n, v in summary.figures.items() if math.isfinite(v)}
    wrong = [f"{n} is {v}" for n, v in summary.figures.items() if n not in numbers]
    if not wrong:
        return replace(summary, figures=numbers)
    return FlightSummary(summary.seed, numbers, ERROR, story="; ".join([*wrong, summary.story]))

"""A campaign as plain data: one JSON document, and one table row per flight."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields, is_dataclass
from enum import Enum
from typing import Any

from dscp_core.campaigns.statistics import (
    CONFIDENCE,
    CampaignStatistics,
    FigureStatistics,
    judge,
)
from dscp_core.problem.declaration import OptimalControlProblem
from dscp_core.problem.simulation import FlightRecord, FlightSummary, Simulation


def settings_document(settings: Any) -> Any:
    """Nested settings as JSON; what is infinite or no number, as text."""
    if is_dataclass(settings) and not isinstance(settings, type):
        return settings_document({f.name: getattr(settings, f.name) for f in fields(settings)})
    if isinstance(settings, Enum):
        return settings.value
    if isinstance(settings, Mapping):
        return {str(name): settings_document(value) for name, value in settings.items()}
    if isinstance(settings, list | tuple):
        return [settings_document(value) for value in settings]
    if isinstance(settings, float) and not math.isfinite(settings):
        return str(settings)
    return settings


def document(simulation: Simulation, statistics: CampaignStatistics) -> dict[str, Any]:
    """The statistics with the setup that they are of, as JSON."""
    footprint = statistics.footprint
    return {
        "settings": settings_document(simulation.settings),
        "confidence": CONFIDENCE,
        "flights": statistics.flights,
        "successes": statistics.successes,
        "success": asdict(statistics.success),
        "figures": {f.figure.name: _figure(f) for f in statistics.figures},
        "classes": statistics.classes,
        "failed": [asdict(flight) for flight in statistics.failed],
        "footprint": None
        if footprint is None
        else {
            "figures": footprint.names,
            "count": footprint.count,
            "centre_m": footprint.centre_m.tolist(),
            "covariance_m2": footprint.covariance_m2.tolist(),
            "inside_1_2_3_sigma": footprint.inside,
        },
    }


def _figure(statistics: FigureStatistics) -> dict[str, Any]:
    numbers = asdict(statistics)
    figure = numbers.pop("figure")
    return {
        "unit": figure["unit"],
        "description": figure["description"],
        "bound": figure["most"] if statistics.figure.judged else None,
        **numbers,
    }


def flight_columns(simulation: Simulation) -> tuple[str, ...]:
    """Header of a table of flights."""
    figures = tuple(figure.name for figure in simulation.figures)
    return ("seed", "success", "classes", *figures, "story")


def flight_row(simulation: Simulation, flight: FlightSummary) -> Sequence[object]:
    """One flight of that table; None where it does not have a figure."""
    failed = judge(simulation.figures, flight)
    classes = "; ".join(failed.classes) if failed else ""
    figures = (flight.figures.get(figure.name) for figure in simulation.figures)
    return (flight.seed, failed is None, classes, *figures, flight.story)


_ARRAYS = ("times_s", "states", "measured", "measured_at_s", "commanded", "controls")


def flight_document(
    problem: OptimalControlProblem, simulation: Simulation, record: FlightRecord
) -> dict[str, Any]:
    """One flight in full, as JSON."""
    summary = record.summary
    failed = judge(simulation.figures, summary)
    return {
        "problem": problem.name,
        "settings": settings_document(simulation.settings),
        "seed": summary.seed,
        "success": failed is None,
        "classes": failed.classes if failed else (),
        "figures": dict(summary.figures),
        "bounds": {figure.name: figure.most for figure in simulation.figures if figure.judged},
        "story": summary.story,
        "events": record.events,
        "columns": {
            "states": [state.name for state in problem.states],
            "controls": [control.name for control in problem.controls],
        },
        **{name: getattr(record, name).tolist() for name in _ARRAYS},
        "phases": record.phases,
        "histories": {name: values.tolist() for name, values in record.histories.items()},
    }

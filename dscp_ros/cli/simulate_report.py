"""What `dscp simulate` prints and writes of a campaign."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dscp_ros.cli.arguments import json_ready, print_table
from dscp_ros.cli.output_files import complete_file

if TYPE_CHECKING:
    from dscp_core.campaigns.statistics import (
        CampaignStatistics,
        Estimate,
        FailedFlight,
        FigureStatistics,
    )

_MOST_FAILURES = 10


def headline(problem: str, statistics: CampaignStatistics) -> str:
    """How many flights succeeded."""
    success = statistics.success
    low, high = (100.0 * (end or 0.0) for end in (success.low, success.high))
    return (
        f"{problem}: {statistics.successes} of {statistics.flights} flights succeeded, "
        f"{100.0 * success.value:.1f} % (95 % confidence: {low:.1f} .. {high:.1f} %)"
    )


def print_campaign(
    problem: str,
    statistics: CampaignStatistics,
    commands: Mapping[int, str],
    about: Mapping[str, Any],
) -> None:
    """Prints headline, table and failures.

    Args:
        problem: Its name.
        statistics: Of the campaign.
        commands: What flies a failed flight again, by its seed.
        about: How it was made, and the files.
    """
    print(headline(problem, statistics))
    rows = [_row(figure, statistics.flights) for figure in statistics.figures]
    header = ("figure", "bound", "mean", "median", "90 %", "99 %", "greatest", "seed", "flights")
    print_table(header, rows, indent="  ")
    if statistics.figures:
        print("  in brackets: 95 % confidence; - where so few flights bound nothing")
    if statistics.failed:
        counted = ", ".join(f"{count} {name}" for name, count in statistics.classes.items())
        print(f"failed: {counted}")
    for flight in statistics.failed[:_MOST_FAILURES]:
        print(f"  seed {flight.seed}: {_reason(flight)}")
        print(f"    {commands[flight.seed]}")
    left = len(statistics.failed) - _MOST_FAILURES
    if left > 0:
        print(f"  and {left} more, in statistics.json")
    rate = about["flights_per_minute"]
    print(f"{about['wall_s']:.1f} s, {rate:.0f} flights per minute; setup {about['digest']}")
    for path in about["files"]:
        print(f"wrote {path}")


def print_replayed(title: str, flight: Mapping[str, Any], files: Sequence[Path]) -> None:
    """Prints one flight that was flown again: its figures and what happened in it."""
    print(title)
    rows = [
        (name, f"{value:.6g}", "" if bound is None else f"<= {bound:g}")
        for name, value in flight["figures"].items()
        for bound in [flight["bounds"].get(name)]
    ]
    print_table(("figure", "value", "bound"), rows, indent="  ")
    for time_s, text in flight["events"]:
        print(f"  {time_s:8.2f} s  {text}")
    for path in files:
        print(f"wrote {path}")


def write_document(path: Path, document: Mapping[str, Any]) -> None:
    """Writes strict JSON, whole or not at all.

    Raises:
        OSError: The file cannot be written.
    """
    text = json.dumps(json_ready(document), allow_nan=False, indent=1)
    with complete_file(path) as partial:
        partial.write_text(text + "\n", encoding="utf-8")


def _row(statistics: FigureStatistics, flights: int) -> tuple[str, ...]:
    figure = statistics.figure
    counted = f"{statistics.count}" + ("" if statistics.count == flights else f" of {flights}")
    return (
        figure.name,
        f"{figure.most:g}" if figure.judged else "",
        *(
            _estimate(estimate)
            for estimate in (statistics.mean, statistics.median, statistics.p90, statistics.p99)
        ),
        f"{statistics.greatest:.4g}",
        str(statistics.greatest_seed),
        counted,
    )


def _estimate(estimate: Estimate) -> str:
    ends = ("-" if end is None else f"{end:.3g}" for end in (estimate.low, estimate.high))
    return f"{estimate.value:.3g} [{', '.join(ends)}]"


def _reason(flight: FailedFlight) -> str:
    exceeded = ", ".join(f"{name} {value:.4g}" for name, value in flight.figures.items())
    parts = [", ".join(flight.classes), exceeded, flight.story]
    return "; ".join(part for part in parts if part)

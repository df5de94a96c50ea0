"""What `dscp tune` says: tables for people, plain values for JSON and the provenance."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any

from dscp_ros.cli.arguments import json_ready, print_table

if TYPE_CHECKING:
    from dscp_core.tuning.assessment import Evaluation
    from dscp_core.tuning.quantities import TunedParameter
    from dscp_core.tuning.tuner import TuningResult
    from dscp_ros.tuning.gathering import Gathered


def tuned_document(parameter: TunedParameter) -> dict[str, Any]:
    """A tuned quantity."""
    return {
        "name": parameter.label,
        "lower": parameter.lower,
        "upper": parameter.upper,
        "start": parameter.start,
    }


def result_document(result: TuningResult) -> dict[str, Any]:
    """What came out of a tuning."""
    return {
        "tuned_values": result.values,
        "loss_history": list(result.history),
        "best_epoch": result.best_epoch,
        "held_out": {
            "improved": result.improved,
            "before": _figures(result.before),
            "after": _figures(result.after),
        },
        "notes": list(result.notes),
        "elapsed_s": result.elapsed_s,
    }


def _figures(evaluation: Evaluation) -> dict[str, Any]:
    return {
        "states": evaluation.states,
        "loss": evaluation.mean_loss,
        "iterations": evaluation.mean_iterations,
        "failures": evaluation.failures,
        "untrusted": evaluation.untrusted,
        "seconds_per_state": evaluation.seconds_per_state,
    }


def print_logs(gathered: Gathered) -> None:
    """Prints what the logs hold and what becomes of it."""
    rows = []
    for part in gathered.split.logs:
        log, figures = part.log, part.log.reports.document()
        reported = "-"
        if figures["attempts"]:
            reported = (
                f"{figures['certified']} of {figures['attempts']} plans certified, "
                f"{figures['mean_iterations']:.1f} iterations, "
                f"{figures['mean_solve_time_ms']:.0f} ms"
            )
        counts = (len(part.training), len(part.held_out), log.refused.total())
        rows.append((str(log.path), *map(str, counts), reported))
    print_table(("log", "tuned on", "held out", "refused", "what the planner reported"), rows)
    refused = sum((part.log.refused for part in gathered.split.logs), Counter[str]())
    if refused:
        print("refused: " + ", ".join(f"{name} {count}" for name, count in refused.most_common()))
    print(gathered.split.rule)


def print_result(loss: str, result: TuningResult) -> None:
    """Prints the held-out states before and after, and what was tuned."""
    before, after = result.before, result.after
    rows = [
        (f"loss ({loss})", f"{before.mean_loss:.9g}", f"{after.mean_loss:.9g}"),
        ("iterations", f"{before.mean_iterations:.2f}", f"{after.mean_iterations:.2f}"),
        (
            "failures",
            f"{before.failures} of {before.states}",
            f"{after.failures} of {after.states}",
        ),
        ("untrusted gradients", str(before.untrusted), str(after.untrusted)),
        (
            "time per state",
            f"{1e3 * before.seconds_per_state:.1f} ms",
            f"{1e3 * after.seconds_per_state:.1f} ms",
        ),
    ]
    print_table(("held-out states", "before", "after"), rows)
    for name, value in result.values.items():
        print(f"{name}: {json_ready(value)}")

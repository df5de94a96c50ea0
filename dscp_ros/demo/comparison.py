"""Two parameter sets, side by side, on the same states."""

from __future__ import annotations

import numpy as np

from dscp_ros.demo.summary import Figures, attempt_rows, lines_of, parameter_set_lines

_PREDICTED = "predicted"
_MASS_USED = "mass_used_kg"


def comparison(before: Figures, after: Figures) -> str:
    """The table: the same states with the one set and with the other."""
    parts = (before, after)
    rows = [
        (before.name, ["before", "after"]),
        *attempt_rows(parts),
        ("terminal time predicted", [str(_predicted(part)) for part in parts]),
        ("mean fuel, both certified [kg]", _fuel(before, after)),
    ]
    return "\n".join(
        [*lines_of(rows), "", *parameter_set_lines([*before.attempts, *after.attempts])]
    )


def _predicted(figures: Figures) -> int:
    attempts = (report.attempt for report in figures.attempts)
    return sum(a is not None and a.terminal_time_source == _PREDICTED for a in attempts)


def _fuel(before: Figures, after: Figures) -> list[str]:
    """Mean fuel over the states that have a certified plan in both."""
    burnt = [
        {
            r.input_stamp_ns: r.certificate.values[_MASS_USED]
            for r in part.attempts
            if r.published and r.certificate is not None and _MASS_USED in r.certificate.values
        }
        for part in (before, after)
    ]
    common = burnt[0].keys() & burnt[1].keys()
    if not common:
        return ["-", "-"]
    return [f"{np.mean([part[stamp] for stamp in common]):.1f}" for part in burnt]

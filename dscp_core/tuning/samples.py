"""Logged states as arrays, and which of them can be used."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dscp_core.errors import InvalidInputError
from dscp_core.planning.planner import TerminalTime
from dscp_core.planning.terminal_time_network import TerminalTimeNetwork
from dscp_core.problem.declaration import TERMINAL_TIME, OptimalControlProblem
from dscp_core.tuning.settings import Sample, TuningSettings

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class StateSet:
    """States, and where they come from.

    Attributes:
        states: (n, nx), SI.
        times_s: (n,) given terminal times; NaN for that of the parameters.
        logs: (n,) names of the logs.
        rows: (n,) numbers that stay with the states.
    """

    states: Array
    times_s: Array
    logs: tuple[str, ...]
    rows: NDArray[np.intp]

    def __len__(self) -> int:
        return len(self.states)

    @staticmethod
    def of(samples: Sequence[Sample], *, given_times: bool) -> StateSet:
        """Arrays of samples.

        Args:
            samples: One or more.
            given_times: Whether the samples' own terminal times count.
        """
        times = [
            s.terminal_time_s if given_times and s.terminal_time_s is not None else math.nan
            for s in samples
        ]
        return StateSet(
            np.array([s.state for s in samples], dtype=np.float64),
            np.array(times, dtype=np.float64),
            tuple(s.log for s in samples),
            np.arange(len(samples)),
        )

    def part(self, rows: NDArray[np.intp]) -> StateSet:
        """Some of the states."""
        logs = tuple(self.logs[row] for row in rows)
        return StateSet(self.states[rows], self.times_s[rows], logs, self.rows[rows])


@dataclass(frozen=True, eq=False)
class Refusal:
    """A sample that cannot be used, and why."""

    sample: Sample
    reason: str


def screen(
    settings: TuningSettings,
    samples: Sequence[Sample],
    network: TerminalTimeNetwork | None = None,
) -> tuple[list[Sample], list[Refusal]]:
    """Tell samples that can be planned from others, which are outside of something.

    Args:
        settings: The tuning.
        samples: Any.
        network: That predicts the terminal times, or None.

    Raises:
        InvalidInputError: Unknown problem, or an invalid parameter.
    """
    problem, planner = settings.problem, settings.planner
    base = problem.pack(planner.parameters)
    good: list[Sample] = []
    refused: list[Refusal] = []
    for sample in samples:
        try:
            _check(problem, base, sample)
            if planner.terminal_time is TerminalTime.PREDICTED and network is not None:
                network.predict(sample.state)
        except InvalidInputError as error:
            refused.append(Refusal(sample, str(error)))
        else:
            good.append(sample)
    return good, refused


def _check(problem: OptimalControlProblem, base: Array, sample: Sample) -> None:
    """Refuse what the planner would refuse.

    Raises:
        InvalidInputError: Wrong length, not finite, out of bounds, or no place to plan from.
    """
    table, size = problem.table, len(problem.states)
    state = np.asarray(sample.state, dtype=np.float64)
    if state.shape != (size,):
        raise InvalidInputError("state", f"shape {state.shape}", f"shape ({size},)")
    changed = problem.initial_state_values(state)
    if sample.terminal_time_s is not None:
        changed[TERMINAL_TIME] = np.array([sample.terminal_time_s])
    packed = table.pack(changed, base=base)
    problem.require_start(state, packed)

"""All logs of a tuning: read, checked, screened for the vehicle, and divided."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dscp_core.errors import InvalidInputError
from dscp_core.planning.planner import TerminalTime
from dscp_core.tuning.samples import screen
from dscp_core.tuning.settings import Sample, TuningSettings
from dscp_ros.tuning.logs import LogContent, LoggedState, read_log
from dscp_ros.tuning.sources import check_new, file_digests
from dscp_ros.tuning.split import Split, split_by_share, split_given, thin

if TYPE_CHECKING:
    from dscp_core.planning.terminal_time_network import TerminalTimeNetwork
    from dscp_ros.tuning.start import Start

OUTSIDE_ENVELOPE = "OUTSIDE_ENVELOPE"


@dataclass(frozen=True)
class GatheringOptions:
    """Which logs, and how they are used.

    Attributes:
        logs: Logs to tune on, or to divide.
        held_out: Logs to judge by; empty to divide the others.
        share: Share of the others that is held out, where no log was named for it.
        topics: Topics by what they hold.
        most_states: Most states of each log.
        seed: Of the draw of held-out logs.
    """

    logs: Sequence[Path]
    held_out: Sequence[Path]
    share: float
    topics: Mapping[str, str]
    most_states: int
    seed: int


@dataclass(frozen=True)
class Gathered:
    """The states of all logs.

    Attributes:
        split: What becomes of the states.
        digests: SHA-256 of each log's files, by log and name.
    """

    split: Split
    digests: Mapping[Path, Mapping[str, str]]

    @property
    def training(self) -> list[Sample]:
        """States to tune on."""
        return [_sample(p.log, s) for p in self.split.logs for s in p.training]

    @property
    def held_out(self) -> list[Sample]:
        """States to judge by."""
        return [_sample(p.log, s) for p in self.split.logs for s in p.held_out]

    def document(self) -> list[dict[str, Any]]:
        """Provenance of each log, for JSON."""
        return [
            {
                "path": str(part.log.path),
                "sha256": dict(self.digests[part.log.path]),
                "start_ns": part.log.start_ns,
                "end_ns": part.log.end_ns,
                "start": _utc(part.log.start_ns),
                "end": _utc(part.log.end_ns),
                "training_states": len(part.training),
                "held_out_states": len(part.held_out),
                "refused": dict(part.log.refused),
                "reports": part.log.reports.document(),
                "damage": list(part.log.damage),
            }
            for part in self.split.logs
        ]


def gather(
    options: GatheringOptions,
    start: Start,
    settings: TuningSettings,
    warn: Callable[[str], None],
) -> Gathered:
    """Read the logs one after the other and divide their states.

    Args:
        options: Which logs, and how they are used.
        start: What is tuned from: the vehicle, its inputs' checks, the network.
        settings: Of the tuning; a state that it cannot use is refused.
        warn: Is told what is damaged, and why states are refused.

    Raises:
        BagError: A log cannot be read at all.
        InvalidInputError: A log has no usable state, or was given twice.
    """
    if options.most_states < 2:
        raise InvalidInputError("--states", options.most_states, ">= 2")
    logs: list[LogContent] = []
    digests: dict[Path, dict[str, str]] = {}
    for path in (*options.logs, *options.held_out):
        log = read_log(path, start.layout, start.values.settings.inputs, options.topics)
        for damage in log.damage:
            warn(f"{path}: damaged, going on with the rest: {damage}")
        log.require_states()
        if start.values.planner.terminal_time is not TerminalTime.FIXED:
            for state in log.states:
                state.terminal_time_s = None  # a result of the planner, not what it was given
        logs.append(log)
        found = file_digests(path)
        check_new(path, found, digests)
        digests[path] = found
    _screen(logs, settings, start.network, warn)
    for log in logs:
        log.require_states()
        thin(log, options.most_states)
    training, held_out = logs[: len(options.logs)], logs[len(options.logs) :]
    if held_out:
        split = split_given(training, held_out)
    else:
        split = split_by_share(training, options.share, options.seed)
    return Gathered(split, digests)


def _screen(
    logs: Sequence[LogContent],
    settings: TuningSettings,
    network: TerminalTimeNetwork | None,
    warn: Callable[[str], None],
) -> None:
    """Refuse the states that lie outside the envelope of the vehicle or the network."""
    samples = [[_sample(log, state) for state in log.states] for log in logs]
    kept, refusals = screen(settings, [s for of_log in samples for s in of_log], network)
    usable = {id(sample) for sample in kept}
    for log, of_log in zip(logs, samples, strict=True):
        pairs = zip(log.states, of_log, strict=True)
        log.states = [state for state, sample in pairs if id(sample) in usable]
        refused = [r for r in refusals if r.sample.log == str(log.path)]
        if refused:
            log.refused[OUTSIDE_ENVELOPE] += len(refused)
            hint = "" if network is None else "; terminal_time_source free needs no network"
            warn(
                f"{log.path}: {len(refused)} states cannot be used, the first: "
                f"{refused[0].reason}{hint}"
            )


def _sample(log: LogContent, state: LoggedState) -> Sample:
    return Sample(state.values, str(log.path), state.terminal_time_s)


def _utc(nanoseconds: int) -> str:
    return datetime.fromtimestamp(nanoseconds / 1e9, UTC).isoformat()

"""What a replay is asked to do, checked before anything is opened."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from dscp_core.errors import InvalidInputError

DEFAULT_CLOCK_HZ = 40.0
DEFAULT_WAIT_S = 10.0
_RATE_MAX = 1000.0
_CLOCK_HZ_MAX = 10_000.0
_SECONDS_MAX = 1e8
"""Three years: longer times are typing errors."""
_SUBSCRIBERS_MAX = 1000


@dataclass(frozen=True)
class SubscriberWait:
    """How long to wait for whom before replaying.

    Attributes:
        count: Subscriptions that every replayed topic must have.
        timeout_s: After this long without them the replay fails.
    """

    count: int
    timeout_s: float = DEFAULT_WAIT_S

    def __post_init__(self) -> None:
        if not 1 <= self.count <= _SUBSCRIBERS_MAX:
            raise InvalidInputError(
                "--wait-for-subscribers N", self.count, f"[1, {_SUBSCRIBERS_MAX}]"
            )
        _check("--wait-for-subscribers TIMEOUT", self.timeout_s, _SECONDS_MAX)

    @staticmethod
    def parse(text: str) -> SubscriberWait:
        """Reads `N` or `N/TIMEOUT`.

        Raises:
            InvalidInputError: If the text has another form, or a value is out of range.
        """
        count, separator, timeout = text.partition("/")
        try:
            number = int(count)
            timeout_s = float(timeout) if separator else DEFAULT_WAIT_S
        except ValueError as error:
            raise InvalidInputError(
                "--wait-for-subscribers", text, "N or N/TIMEOUT, such as 1/10"
            ) from error
        return SubscriberWait(number, timeout_s)


@dataclass(frozen=True)
class ReplayOptions:
    """Options of one replay. Times in seconds of the bag, except where stated.

    Attributes:
        bag: The bag.
        rate: How many seconds of the bag pass in one second.
        loop: Whether to start again at the end.
        start_offset_s: Where in the bag to start.
        duration_s: How much of the bag to play, or None for the rest.
        topics: Only these topics; all if empty.
        exclude: Not these topics.
        remaps: New names by recorded topic name.
        clock_hz: Rate of /clock per real second, or None for no /clock.
        delay_s: Real time to wait before each pass through the bag.
        paused: Whether to start paused.
        restamp: Whether to set `header.stamp` to the time of publishing.
        as_fast_as_possible: Whether to ignore the bag's timing.
        qos_overrides: Quality of service policies by recorded topic name.
        wait: For which subscribers to wait, or None.
        skip_unknown_types: Whether to leave out topics whose type is not installed.
    """

    bag: Path
    rate: float = 1.0
    loop: bool = False
    start_offset_s: float = 0.0
    duration_s: float | None = None
    topics: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()
    remaps: Mapping[str, str] = field(default_factory=dict)
    clock_hz: float | None = None
    delay_s: float = 0.0
    paused: bool = False
    restamp: bool = False
    as_fast_as_possible: bool = False
    qos_overrides: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    wait: SubscriberWait | None = None
    skip_unknown_types: bool = False

    def __post_init__(self) -> None:
        _check("--rate", self.rate, _RATE_MAX)
        _check("--start-offset", self.start_offset_s, _SECONDS_MAX, zero_allowed=True)
        _check("--delay", self.delay_s, _SECONDS_MAX, zero_allowed=True)
        if self.duration_s is not None:
            _check("--duration", self.duration_s, _SECONDS_MAX)
        if self.clock_hz is not None:
            _check("--clock", self.clock_hz, _CLOCK_HZ_MAX)
        if self.as_fast_as_possible and self.rate != 1.0:
            raise InvalidInputError(
                "--rate", self.rate, "no --rate together with --as-fast-as-possible"
            )


def parse_remaps(rules: Sequence[str]) -> dict[str, str]:
    """Reads `old:=new` rules.

    Raises:
        InvalidInputError: If a rule has another form, or a topic has two rules.
    """
    remaps: dict[str, str] = {}
    for rule in rules:
        old, separator, new = rule.partition(":=")
        if not (separator and old and new):
            raise InvalidInputError("--remap", rule, "old:=new")
        if old in remaps:
            raise InvalidInputError("--remap", rule, f"one rule for {old}")
        remaps[old] = new
    return remaps


def read_qos_overrides(path: Path) -> dict[str, dict[str, Any]]:
    """Reads a file of quality of service overrides in rosbag2's format.

    The file maps topic names to mappings of policies; policies that are not given stay as
    recorded.

    Raises:
        InvalidInputError: If the file is unreadable or has another form.
    """
    option = "--qos-overrides"
    try:
        loaded = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InvalidInputError(option, str(path), f"a readable file ({error.strerror})") from error
    except (UnicodeDecodeError, yaml.YAMLError) as error:
        raise InvalidInputError(option, str(path), f"a YAML file ({error})") from error
    if not isinstance(loaded, dict) or not all(isinstance(v, dict) for v in loaded.values()):
        raise InvalidInputError(option, str(path), "a mapping of topics to policies")
    return {str(topic): policies for topic, policies in loaded.items()}


def _check(option: str, value: float, maximum: float, *, zero_allowed: bool = False) -> None:
    above_zero = value >= 0.0 if zero_allowed else value > 0.0
    if not (math.isfinite(value) and above_zero and value <= maximum):
        opening = "[" if zero_allowed else "("
        raise InvalidInputError(option, value, f"{opening}0, {maximum:g}]")

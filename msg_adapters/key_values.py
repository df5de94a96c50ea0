"""Typed values as the text pairs of diagnostic_msgs/DiagnosticStatus, and messages of one status.

Floats are written by ``repr``, so reading them back gives the same bits. A value that is None, or
a float that is NaN or infinite, is left out: a missing key means "not known".
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from msg_adapters.checks import require_length
from msg_adapters.errors import InputCode, RejectedInputError
from msg_adapters.stamps import nanoseconds_from_stamp_text, stamp_from_nanoseconds

Value = bool | int | float | str | None


def key_values(pairs: Iterable[tuple[str, Value]]) -> list[KeyValue]:
    """Pairs as text; unknown values are left out."""
    return [
        KeyValue(key=key, value=text)
        for key, text in ((key, _text(value)) for key, value in pairs)
        if text is not None
    ]


def message_of_status(
    pairs: Iterable[tuple[str, Value]],
    *,
    stamp_ns: int,
    level: bytes,
    name: str,
    message: str,
    problem: str,
    frame: str = "",
) -> DiagnosticArray:
    """Message of one status.

    Args:
        pairs: Its values.
        stamp_ns: ROS time of the header.
        level: One byte of diagnostic_msgs/DiagnosticStatus.
        name: What it is called.
        message: One line for people.
        problem: What it is about.
        frame: Of the header.
    """
    array = DiagnosticArray()
    array.header.stamp = stamp_from_nanoseconds(stamp_ns)
    array.header.frame_id = frame
    array.status = [
        DiagnosticStatus(
            level=level, name=name, message=message, hardware_id=problem, values=key_values(pairs)
        )
    ]
    return array


def only_status(message: DiagnosticArray) -> DiagnosticStatus:
    """The status of a message that has one.

    Raises:
        RejectedInputError: WRONG_ARRAY_LENGTH.
    """
    require_length("status", len(message.status), 1)
    return message.status[0]


def _text(value: Value) -> str | None:
    if value is None:
        return None
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return str(int(value))
    if isinstance(value, str):
        return value
    return repr(float(value)) if math.isfinite(value) else None


class KeyValueReader:
    """Reads typed values out of a status; every failure names the key."""

    def __init__(self, status: DiagnosticStatus) -> None:
        """Index the status's keys; of a key given twice the last one counts."""
        self.texts: Mapping[str, str] = {pair.key: pair.value for pair in status.values}

    def text(self, key: str) -> str:
        """Text of a key.

        Raises:
            RejectedInputError: REPORT_MISSING_KEY.
        """
        if key not in self.texts:
            raise RejectedInputError(
                InputCode.REPORT_MISSING_KEY, "values", sorted(self.texts), f"a key '{key}'"
            )
        return self.texts[key]

    def integer(self, key: str) -> int:
        """Whole number.

        Raises:
            RejectedInputError: REPORT_MISSING_KEY or REPORT_BAD_VALUE.
        """
        text = self.text(key)
        try:
            return int(text)
        except ValueError:
            raise self._bad(key, text, "a whole number") from None

    def boolean(self, key: str) -> bool:
        """Truth value.

        Raises:
            RejectedInputError: REPORT_MISSING_KEY or REPORT_BAD_VALUE.
        """
        text = self.text(key)
        if text not in ("true", "false"):
            raise self._bad(key, text, "true or false")
        return text == "true"

    def optional_text(self, key: str) -> str | None:
        """Text, or None where the key is missing."""
        return self.texts.get(key)

    def optional_number(self, key: str) -> float | None:
        """Finite number, or None where the key is missing.

        Raises:
            RejectedInputError: REPORT_BAD_VALUE.
        """
        text = self.texts.get(key)
        if text is None:
            return None
        try:
            value = float(text)
        except ValueError:
            raise self._bad(key, text, "a number") from None
        if not math.isfinite(value):
            raise self._bad(key, text, "finite")
        return value

    def optional_stamp_ns(self, key: str) -> int | None:
        """Time in nanoseconds, written as ``SECONDS.NANOSECONDS``; None where the key is missing.

        Raises:
            RejectedInputError: REPORT_BAD_VALUE.
        """
        text = self.texts.get(key)
        if text is None:
            return None
        try:
            return nanoseconds_from_stamp_text(text)
        except ValueError:
            raise self._bad(key, text, "SECONDS.NANOSECONDS") from None

    @staticmethod
    def _bad(key: str, text: str, bound: str) -> RejectedInputError:
        return RejectedInputError(InputCode.REPORT_BAD_VALUE, key, text, bound)

"""Time stamps as integer nanoseconds."""

from __future__ import annotations

from builtin_interfaces.msg import Duration, Time

from msg_adapters.errors import InputCode, RejectedInputError

NANOSECONDS_PER_SECOND = 1_000_000_000


def nanoseconds_from_stamp(stamp: Time, field: str = "header.stamp") -> int:
    """Time of a stamp.

    Raises:
        RejectedInputError: INVALID_STAMP.
    """
    if stamp.sec < 0:
        raise RejectedInputError(InputCode.INVALID_STAMP, f"{field}.sec", stamp.sec, ">= 0")
    if stamp.nanosec >= NANOSECONDS_PER_SECOND:
        bound = f"< {NANOSECONDS_PER_SECOND}"
        raise RejectedInputError(InputCode.INVALID_STAMP, f"{field}.nanosec", stamp.nanosec, bound)
    return int(stamp.sec) * NANOSECONDS_PER_SECOND + int(stamp.nanosec)


def stamp_from_nanoseconds(nanoseconds: int) -> Time:
    """Stamp of a time."""
    sec, nanosec = divmod(int(nanoseconds), NANOSECONDS_PER_SECOND)
    return Time(sec=sec, nanosec=nanosec)


def nanoseconds_from_duration(duration: Duration) -> int:
    """Length of a duration."""
    return int(duration.sec) * NANOSECONDS_PER_SECOND + int(duration.nanosec)


def duration_from_nanoseconds(nanoseconds: int) -> Duration:
    """Duration of a length."""
    sec, nanosec = divmod(int(nanoseconds), NANOSECONDS_PER_SECOND)
    return Duration(sec=sec, nanosec=nanosec)


def nanoseconds_from_seconds(seconds: float) -> int:
    """Nearest whole number of nanoseconds."""
    return round(float(seconds) * NANOSECONDS_PER_SECOND)


def seconds_from_nanoseconds(nanoseconds: int) -> float:
    """Seconds, correctly rounded."""
    return nanoseconds / NANOSECONDS_PER_SECOND


def stamp_text(nanoseconds: int) -> str:
    """Exact decimal text of a time in seconds, for example ``12.000000500``."""
    sec, nanosec = divmod(int(nanoseconds), NANOSECONDS_PER_SECOND)
    return f"{sec}.{nanosec:09d}"


def nanoseconds_from_stamp_text(text: str) -> int:
    """Inverse of `stamp_text`.

    Raises:
        ValueError: The text is not of that form.
    """
    sec, dot, nanosec = text.partition(".")
    if not (dot and sec.isdecimal() and len(nanosec) == 9 and nanosec.isdecimal()):
        raise ValueError(f"{text!r} is no stamp of the form SECONDS.NANOSECONDS")
    return int(sec) * NANOSECONDS_PER_SECOND + int(nanosec)

"""Setting `header.stamp` in a serialised message, without decoding it."""

from __future__ import annotations

import struct
from typing import Any

from dscp_ros.bag import BagMessage, MessageDecodeError

_NANOSECONDS = 10**9
_CDR_HEADER_LENGTH = 4
_STAMP_END = _CDR_HEADER_LENGTH + 8
_LITTLE_ENDIAN_BIT = 1


def has_leading_header(message_type: type[Any]) -> bool:
    """Whether the first field of a message type is a `std_msgs/Header`.

    Only then does the stamp stand at a fixed place of the serialised message. It holds for every
    type of the common interfaces that has a header.
    """
    fields = message_type.get_fields_and_field_types()
    return next(iter(fields.values()), None) == "std_msgs/Header"


def with_stamp(message: BagMessage, time_ns: int) -> bytes:
    """Returns the serialised message with another stamp.

    The stamp is the first thing after the four bytes of the CDR encapsulation, the second of which
    tells the byte order (OMG DDSI-RTPS, 10.2): seconds as int32, nanoseconds as uint32.

    Args:
        message: A message whose type has a leading header.
        time_ns: The new stamp.

    Raises:
        MessageDecodeError: If the message is too short to have a stamp.
    """
    data = message.data
    if len(data) < _STAMP_END:
        raise MessageDecodeError(
            message.topic.name,
            message.topic.type_name,
            message.log_time_ns,
            f"{len(data)} bytes are too few for a header",
        )
    order = "<" if data[1] & _LITTLE_ENDIAN_BIT else ">"
    stamp = struct.pack(f"{order}iI", *divmod(time_ns, _NANOSECONDS))
    return data[:_CDR_HEADER_LENGTH] + stamp + data[_STAMP_END:]

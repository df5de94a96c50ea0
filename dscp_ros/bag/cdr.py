"""Serialising messages to bytes that depend on nothing but the message.

rclpy's `serialize_message` estimates the length from above wherever a sequence of eight-byte
numbers is empty, and leaves the surplus and all padding uninitialised. Strict readers refuse the
surplus, and the same message gives other bytes each time. Here the surplus is cut off and the
padding set to zero, by a walk along the type's description (REP-2016).

Encoding: plain CDR as ROS 2 uses it (OMG CORBA 3.3, 9.3; alignment counted from the end of the
four bytes of the DDSI-RTPS encapsulation header).
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

from dscp_ros.bag.schemas import type_description, type_name_of

_HEADER_LENGTH = 4
_LITTLE_ENDIAN_BIT = 1

# Numbers of type_description_interfaces/msg/FieldType.
_NESTED = 1
_STRINGS = frozenset((17, 21))
_SIZES: Mapping[int, int] = {
    **dict.fromkeys((2, 3, 13, 15, 16), 1),  # int8, uint8, char, boolean, byte
    **dict.fromkeys((4, 5), 2),  # int16, uint16
    **dict.fromkeys((6, 7, 10), 4),  # int32, uint32, float
    **dict.fromkeys((8, 9, 11), 8),  # int64, uint64, double
}
_ARRAY_TYPES = 48
_SEQUENCE_TYPES = 96
_TYPES_PER_KIND = 48
_LENGTH_SIZE = 4


@dataclass(frozen=True)
class _Field:
    """One field: `size` bytes, or a string (0), or the fields of another type.

    `count` is the length of an array, 1 for a single value, and None for a sequence.
    """

    size: int
    nested: tuple[_Field, ...] | None
    count: int | None


def serialise(message: Any) -> bytes:
    """Serialises a ROS message; equal messages give equal bytes.

    Args:
        message: An instance of a ROS message class.

    Raises:
        UnknownMessageTypeError: If its class is not an installed message type.
    """
    from rclpy.serialization import serialize_message

    data = bytearray(serialize_message(message))
    fields = _layout(type_name_of(type(message)))
    if fields is None:
        return bytes(data)
    order = "<" if data[1] & _LITTLE_ENDIAN_BIT else ">"
    end = _Walk(data, struct.Struct(f"{order}I")).fields(fields, 0)
    return bytes(data[: _HEADER_LENGTH + end])


class _Walk:
    """Walks along a message, setting the padding to zero; positions count from the header's end."""

    def __init__(self, data: bytearray, length_format: struct.Struct) -> None:
        self._data = data
        self._length_format = length_format

    def fields(self, fields: tuple[_Field, ...], position: int) -> int:
        for field in fields:
            count = field.count
            if count is None:
                count, position = self._length(position)
            if field.nested is not None:
                for _ in range(count):
                    position = self.fields(field.nested, position)
            elif field.size == 0:
                for _ in range(count):
                    length, position = self._length(position)
                    position += length
            elif count:
                position = self._align(position, field.size) + count * field.size
        return position

    def _length(self, position: int) -> tuple[int, int]:
        position = self._align(position, _LENGTH_SIZE)
        (length,) = self._length_format.unpack_from(self._data, _HEADER_LENGTH + position)
        return length, position + _LENGTH_SIZE

    def _align(self, position: int, size: int) -> int:
        aligned = (position + size - 1) & -size
        for padding in range(_HEADER_LENGTH + position, _HEADER_LENGTH + aligned):
            self._data[padding] = 0
        return aligned


@cache
def _layout(type_name: str) -> tuple[_Field, ...] | None:
    """Returns the fields of a type, or None if it holds wide characters or long doubles.

    No message of the common interfaces holds them, and their encoding differs between middlewares.
    """
    described = type_description(type_name)["type_description_msg"]
    structures = {
        entry["type_name"]: entry["fields"]
        for entry in (described["type_description"], *described["referenced_type_descriptions"])
    }
    try:
        return _fields(type_name, structures)
    except KeyError:
        return None


def _fields(type_name: str, structures: Mapping[str, Any]) -> tuple[_Field, ...]:
    fields = []
    for entry in structures[type_name]:
        kind = entry["type"]
        base = 1 + (kind["type_id"] - 1) % _TYPES_PER_KIND
        count: int | None = 1
        if kind["type_id"] > _SEQUENCE_TYPES:
            count = None
        elif kind["type_id"] > _ARRAY_TYPES:
            count = int(kind["capacity"])
        if base == _NESTED:
            fields.append(_Field(0, _fields(kind["nested_type_name"], structures), count))
        else:
            fields.append(_Field(0 if base in _STRINGS else _SIZES[base], None, count))
    return tuple(fields)

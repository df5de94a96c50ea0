"""Problems as bytes: lambdas, closures, and the CasADi expressions that they hold."""

from __future__ import annotations

import io
import pickle
from typing import Any

import casadi as ca
import cloudpickle


class _Pickler(cloudpickle.Pickler):  # type: ignore[misc]
    """Keeps expressions apart, in one serializer: they go on sharing their symbols."""

    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file)
        self.serializer = ca.StringSerializer()
        self.count = 0

    def persistent_id(self, obj: Any) -> int | None:
        """Number of an expression; None for everything else."""
        if not isinstance(obj, ca.SX | ca.MX):
            return None
        self.serializer.pack(obj)
        self.count += 1
        return self.count - 1


class _Unpickler(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, expressions: list[Any]) -> None:
        super().__init__(file)
        self._expressions = expressions

    def persistent_load(self, pid: int) -> Any:
        """An expression by its number."""
        return self._expressions[pid]


def to_bytes(value: Any) -> tuple[bytes, int, str]:
    """The pickled value, the number of expressions in it, and those.

    Functions of modules that were registered with ``cloudpickle.register_pickle_by_value``, of
    ``__main__``, and lambdas go by value, others by name.
    """
    file = io.BytesIO()
    pickler = _Pickler(file)
    pickler.dump(value)
    expressions = pickler.serializer.encode() if pickler.count else ""
    return file.getvalue(), pickler.count, expressions


def from_bytes(pickled: bytes, count: int, expressions: str) -> Any:
    """Inverse of `to_bytes`."""
    unpacked: list[Any] = []
    if count:
        deserializer = ca.StringDeserializer(expressions)
        unpacked = [deserializer.unpack() for _ in range(count)]
    return _Unpickler(io.BytesIO(pickled), unpacked).load()

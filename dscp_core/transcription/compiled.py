"""Calling CasADi functions on NumPy arrays without per-call conversions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Symbol = TypeVar("Symbol", ca.SX, ca.MX)


class CompiledFunction:
    """A CasADi function of dense vectors with preallocated buffers, a few microseconds a call.

    Not safe for calls from several threads at once: give each thread its own.
    """

    def __init__(self, name: str, inputs: Sequence[Symbol], outputs: Sequence[Symbol]) -> None:
        self._function = ca.Function(name, list(inputs), [ca.densify(o) for o in outputs])
        buffers: tuple[Any, Any] = self._function.buffer()  # set_arg's stub is for C callers
        self._buffer, self._trigger = buffers
        self._arguments = [np.zeros(self._function.nnz_in(i)) for i in range(len(inputs))]
        self._results = [np.zeros(self._function.nnz_out(i)) for i in range(len(outputs))]
        for index, argument in enumerate(self._arguments):
            self._buffer.set_arg(index, memoryview(argument.data))
        for index, result in enumerate(self._results):
            self._buffer.set_res(index, memoryview(result.data))

    def of_first(self, *others: Array) -> Callable[[Array], Array]:
        """The first output as a function of the first argument, the others held.

        For integrators, where most of a call's time would go into copying what does not change.
        The result holds until the next call of either.
        """
        for target, argument in zip(self._arguments[1:], others, strict=True):
            target[:] = argument
        first, result, trigger = self._arguments[0], self._results[0], self._trigger

        def evaluate(argument: Array) -> Array:
            first[:] = argument
            trigger()
            return result.copy()

        return evaluate

    def __call__(self, *arguments: Array) -> tuple[Array, ...]:
        """Evaluate; returns fresh flat arrays, column-major for matrices."""
        for target, argument in zip(self._arguments, arguments, strict=True):
            target[:] = argument
        self._trigger()
        return tuple(result.copy() for result in self._results)

"""Calls the functions of a declaration with symbols, and checks what comes back."""

from __future__ import annotations

import os
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dscp_core.errors import InvalidInputError
from dscp_core.problem.parameters import ParameterTable

_LONGEST_MESSAGE = 300
_OF_VALUES = "a function of the parameters' values"


class UnknownParameterError(KeyError):
    """A function of a declaration asks for a parameter that there is not."""


class KnownParameters(dict[str, Any]):
    """Parameters by name; tells an unknown one from a `KeyError` of a user's own."""

    def __missing__(self, name: str) -> Any:
        """Refuse it.

        Raises:
            UnknownParameterError: Always.
        """
        raise UnknownParameterError(name)


class Tracer:
    """Calls functions with expressions of known symbols; names the function that is wrong."""

    def __init__(self, table: ParameterTable, *known: ca.SX) -> None:
        """Remember what the functions may know.

        Args:
            table: Parameters of the problem.
            *known: Symbols that their arguments are made of.
        """
        self._table = table
        self._known = ca.vertcat(*known)

    def __call__(
        self, what: str, function: Callable[..., Any], *arguments: Any, rows: int | None = 1
    ) -> ca.SX:
        """What a function returns, as a column.

        Args:
            what: The function, as messages call it.
            function: Of a declaration.
            *arguments: Of it.
            rows: Expected rows; None for any number.

        Raises:
            InvalidInputError: It raises, returns another type or shape, or depends on symbols that
                are not its arguments.
        """
        shape = "(n, 1)" if rows is None else f"({rows}, 1)"
        result = called(what, self._table, function, *arguments)
        expression = _as_sx(result)
        if expression is None:
            raise InvalidInputError(what, _described(result), f"a casadi.SX of shape {shape}")
        if expression.shape[1] != 1 or rows not in (None, expression.shape[0]):
            raise InvalidInputError(what, f"shape {expression.shape}", f"shape {shape}")
        self._require_known(what, expression)
        return expression

    def pair(self, what: str, function: Callable[..., Any], *arguments: Any) -> tuple[ca.SX, ca.SX]:
        """What a function returns that returns two scalars.

        Raises:
            InvalidInputError: As for one.
        """
        both = called(what, self._table, function, *arguments)
        if not isinstance(both, tuple | list) or len(both) != 2:
            raise InvalidInputError(what, _described(both), "two scalars, least and greatest")
        low, high = (
            self(f"{side} of {what}", lambda value=value: value)
            for side, value in zip(("first", "second"), both, strict=True)
        )
        return low, high

    def _require_known(self, what: str, expression: ca.SX) -> None:
        traced = ca.Function("traced", [self._known], [expression], {"allow_free": True})
        foreign = sorted({str(symbol) for symbol in traced.free_sx()})
        if foreign:
            raise InvalidInputError(what, ", ".join(foreign), "symbols of its arguments only")
        for index in range(traced.n_instructions()):
            if traced.instruction_id(index) == ca.OP_CONST and np.isnan(
                traced.instruction_constant(index)
            ):
                bound = "functions of casadi: those of math make NaN of a symbol"
                raise InvalidInputError(what, "a NaN constant", bound)


def called(
    what: str,
    table: ParameterTable,
    function: Callable[..., Any],
    *arguments: Any,
    expected: str = "a function of CasADi symbols",
) -> Any:
    """Result of a function of a declaration.

    Raises:
        InvalidInputError: It raises; the message names it, and the place in its file.
    """
    try:
        return function(*arguments)
    except (InvalidInputError, KeyboardInterrupt):
        raise
    except BaseException as error:
        raise _refusal(what, table, error, expected) from error


def numeric(
    what: str,
    table: ParameterTable,
    function: Callable[..., Any],
    packed: NDArray[np.float64],
    state: NDArray[np.float64] | None = None,
) -> Any:
    """Result of a function of a declaration that takes numbers.

    Args:
        what: The function, as messages call it.
        table: Parameters of the problem.
        function: Of the state, where there is one, and the parameters' values by name.
        packed: Packed parameters, SI.
        state: (nx,), SI, or None.

    Raises:
        InvalidInputError: It raises; the message names it, and the place in its file.
    """
    values = known_values(table, packed)
    if state is None:
        return of_values(what, table, function, values)
    return called(what, table, function, state, values, expected=_OF_VALUES)


def known_values(table: ParameterTable, packed: NDArray[np.float64]) -> KnownParameters:
    """Values of packed parameters by name, for functions of a declaration that take numbers."""
    return KnownParameters(table.unpack(packed))


def of_values(
    what: str, table: ParameterTable, function: Callable[..., Any], values: KnownParameters
) -> Any:
    """Result of a function of a declaration that takes the parameters' values alone.

    Raises:
        InvalidInputError: As `numeric`.
    """
    return called(what, table, function, values, expected=_OF_VALUES)


def _refusal(
    what: str, table: ParameterTable, error: BaseException, expected: str
) -> InvalidInputError:
    place = _place(error)
    if isinstance(error, UnknownParameterError):
        bound = f"one of {', '.join(table.names)}"
        return InvalidInputError(what, f"parameter {error.args[0]!r}{place}", bound)
    message = " ".join(f"{type(error).__name__}: {error}".split())[:_LONGEST_MESSAGE]
    return InvalidInputError(what, message + place, expected)


def _place(error: BaseException) -> str:
    """File and line of the innermost frame that is neither CasADi's nor this package's."""
    own = (f"{os.sep}casadi{os.sep}", f"{Path(__file__).parent}{os.sep}")
    frames = [
        frame
        for frame in traceback.extract_tb(error.__traceback__)
        if not any(part in frame.filename for part in own)
    ]
    return f" at {Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else ""


def _as_sx(value: Any) -> ca.SX | None:
    """The value as an expression, or None where it is none."""
    if isinstance(value, ca.SX):
        return value
    if isinstance(value, ca.DM):
        return ca.SX(value)
    if isinstance(value, bool) or not isinstance(value, int | float | np.number | np.ndarray):
        return None
    array = np.asarray(value)
    if array.dtype.kind not in "iuf" or array.ndim > 2:
        return None
    return ca.SX(ca.DM(array))


def _described(value: Any) -> str:
    return "None" if value is None else f"a {type(value).__name__}"

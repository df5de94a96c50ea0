"""Named, typed parameters with units: declaration, validation, packing into one vector."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dscp_core.errors import InvalidInputError
from dscp_core.problem import checks

Value = float | Sequence[float] | NDArray[np.float64]


@dataclass(frozen=True)
class Parameter:
    """Declaration of one named parameter, scalar or vector, in SI units.

    Attributes:
        name: Unique name, as used on the command line and in files.
        default: Default value; its length fixes the parameter's size.
        unit: SI unit, for example ``"m/s"``; ``"1"`` for a pure number.
        description: What it is, for a reader who knows the field but not this code.
        lower: Smallest admissible value of every component.
        upper: Largest admissible value of every component.
        source: Where the default comes from.
        fixes_optimum: Whether the optimum from a state depends on it; not so for a bound on a
            guess, or a setting of the method.
        infinite: Whether values may be infinite: for a bound, which is then none.

    Example:
        >>> from dscp_core import Parameter
        >>> Parameter("mass", 2.0, "kg", "Of the vehicle.", lower=0.1).validate(3)
        array([3.])
    """

    name: str
    default: float | tuple[float, ...]
    unit: str
    description: str
    lower: float = -math.inf
    upper: float = math.inf
    source: str = ""
    fixes_optimum: bool = True
    infinite: bool = False

    def __post_init__(self) -> None:
        checks.named("name of a parameter", self.name)
        checks.plain(f"parameter {self.name}", self)
        if not self.lower <= self.upper:
            bound = f"at most upper, {self.upper}"
            raise InvalidInputError(f"lower of parameter {self.name}", self.lower, bound)

    @property
    def size(self) -> int:
        """Number of components; 1 for a scalar."""
        return len(self.default) if isinstance(self.default, tuple) else 1

    @property
    def is_vector(self) -> bool:
        """Whether values are sequences."""
        return isinstance(self.default, tuple)

    def validate(self, value: Any) -> NDArray[np.float64]:
        """Check a value and return it as an array of shape (size,).

        Raises:
            InvalidInputError: Not numeric, of the wrong length, NaN, infinite where that is not
                declared, or out of bounds.
        """
        try:
            given = np.atleast_1d(np.asarray(value))
        except ValueError:  # a ragged list
            raise InvalidInputError(self.name, value, "a number or a list of numbers") from None
        if given.dtype.kind not in "iuf":
            raise InvalidInputError(self.name, value, "a number or a list of numbers")
        array = given.astype(np.float64)
        if array.shape != (self.size,):
            raise InvalidInputError(self.name, value, f"length {self.size}")
        if self.infinite:
            if np.any(np.isnan(array)):
                raise InvalidInputError(self.name, value, "no NaN")
        elif not np.all(np.isfinite(array)):
            raise InvalidInputError(self.name, value, "finite")
        if np.any(array < self.lower) or np.any(array > self.upper):
            raise InvalidInputError(
                self.name, value, f"[{self.lower:g}, {self.upper:g}] {self.unit}".rstrip()
            )
        return array


class ParameterTable:
    """An ordered set of parameter declarations, packed into one flat SI vector."""

    def __init__(self, parameters: Iterable[Parameter]) -> None:
        self.parameters: tuple[Parameter, ...] = tuple(parameters)
        self._by_name = {parameter.name: parameter for parameter in self.parameters}
        if len(self._by_name) != len(self.parameters):
            names = [parameter.name for parameter in self.parameters]
            twice = sorted({name for name in names if names.count(name) > 1})
            raise InvalidInputError("parameters", twice, "each name declared once")
        self._slices: dict[str, slice] = {}
        start = 0
        for parameter in self.parameters:
            self._slices[parameter.name] = slice(start, start + parameter.size)
            start += parameter.size
        self.size = start

    @property
    def names(self) -> tuple[str, ...]:
        """Names in packing order."""
        return tuple(self._by_name)

    def __getitem__(self, name: str) -> Parameter:
        """Declaration by name.

        Raises:
            InvalidInputError: Unknown name; the message lists the near ones.
        """
        if name not in self._by_name:
            near = difflib.get_close_matches(str(name), self.names, n=3, cutoff=0.5)
            hint = f"; did you mean {', '.join(near)}?" if near else f": {', '.join(self.names)}"
            raise InvalidInputError("parameter", name, f"a known name{hint}")
        return self._by_name[name]

    def slice(self, name: str) -> slice:
        """Positions of a parameter in the packed vector."""
        return self._slices[self[name].name]

    def pack(
        self, values: Mapping[str, Value] | None = None, base: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Packed vector of shape (size,), SI: defaults (or ``base``) overridden by ``values``.

        Raises:
            InvalidInputError: Unknown name or invalid value.
        """
        if base is None:
            packed = np.concatenate([np.atleast_1d(p.default) for p in self.parameters]).astype(
                np.float64
            )
        else:
            packed = np.array(base, dtype=np.float64)
        for name, value in (values or {}).items():
            packed[self.slice(name)] = self[name].validate(value)
        return packed

    def unpack(self, packed: NDArray[np.float64]) -> dict[str, float | NDArray[np.float64]]:
        """Values by name; scalars as floats, vectors as arrays."""
        return {
            p.name: packed[self._slices[p.name]].copy()
            if p.is_vector
            else float(packed[self._slices[p.name]][0])
            for p in self.parameters
        }

    def with_defaults(self, values: Mapping[str, Value]) -> ParameterTable:
        """The same declarations with other defaults, for example from a vehicle file.

        Raises:
            InvalidInputError: Unknown name or invalid value.
        """
        checked = {name: self[name].validate(value) for name, value in values.items()}
        return ParameterTable(
            replace(
                p,
                default=tuple(float(v) for v in checked[p.name])
                if p.is_vector
                else float(checked[p.name][0]),
                source="file",
            )
            if p.name in checked
            else p
            for p in self.parameters
        )


def without_infinities(value: Any) -> Any:
    """A number, or a list of them, with None for those that are infinite."""
    if isinstance(value, list):
        return [without_infinities(part) for part in value]
    return None if math.isinf(value) else value


def load_parameter_file(path: str | Path) -> dict[str, Value]:
    """Read a vehicle or mission file: a YAML mapping of parameter names to SI values.

    The names are checked where the values are used, by `ParameterTable.pack`.

    Raises:
        InvalidInputError: The file is missing, is no YAML, gives a name twice, or is no mapping of
            numbers.
    """
    from dscp_core.problem.yaml_files import read_yaml

    content = read_yaml("parameter file", path)
    if not isinstance(content, dict) or not all(isinstance(name, str) for name in content):
        raise InvalidInputError("parameter file", str(path), "a mapping of names to SI values")
    return content

"""The declaration of one node parameter: its type, range, unit and description."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor

from dscp_core.errors import InvalidInputError

VEHICLE_PREFIX = "parameters."
"""What the names of a problem's own parameters begin with."""

Value = bool | int | float | str | Sequence[float]


@dataclass(frozen=True)
class NodeParameter:
    """Declaration of one parameter.

    Attributes:
        name: Name.
        default: Default value, which also fixes the type and, of a list, the length.
        description: What it is.
        unit: SI unit, or empty.
        lower: Least value of a number, or of every component of a list.
        upper: Greatest value.
        choices: Permitted texts; empty for any.
        read_only: Whether it can be set at the start only.
        may_be_empty: Whether an empty text is a value.
        infinite: Whether numbers may be infinite: bounds, which are then none.
        suited: Whether NaN is a value: it stands for what suits the vehicle.
    """

    name: str
    default: Value
    description: str
    unit: str = ""
    lower: float = -math.inf
    upper: float = math.inf
    choices: tuple[str, ...] = ()
    read_only: bool = False
    may_be_empty: bool = False
    infinite: bool = False
    suited: bool = False

    def descriptor(self) -> ParameterDescriptor:
        """Descriptor with range and constraints."""
        unit = f" [{self.unit}]" if self.unit else ""
        descriptor = ParameterDescriptor(
            description=self.description + unit, read_only=self.read_only
        )
        if self.choices:
            descriptor.additional_constraints = f"one of {', '.join(self.choices)}"
        elif isinstance(self.default, bool):
            descriptor.additional_constraints = self.type_text
        elif isinstance(self.default, int):
            descriptor.integer_range = [
                IntegerRange(from_value=int(self.lower), to_value=int(self.upper), step=0)
            ]
        elif isinstance(self.default, float) and not (self.infinite or self.suited):
            largest = sys.float_info.max
            descriptor.floating_point_range = [
                FloatingPointRange(
                    from_value=float(max(self.lower, -largest)),
                    to_value=float(min(self.upper, largest)),
                )
            ]
        elif not isinstance(self.default, str):
            # The range of a descriptor has no room for infinity and NaN.
            count = 1 if isinstance(self.default, float) else len(self.default)
            descriptor.additional_constraints = (
                f"{count} number{'s' * (count != 1)} in [{self.lower:g}, {self.upper:g}]"
            )
        return descriptor

    def check(self, value: Any) -> None:
        """Check a value beyond what a descriptor can say: NaN, list length, choices.

        Raises:
            InvalidInputError: The value is out of bounds.
        """
        if self.choices:
            if value not in self.choices:
                raise InvalidInputError(self.name, value, f"one of {', '.join(self.choices)}")
            return
        if isinstance(self.default, str):
            if not value and not self.may_be_empty:
                raise InvalidInputError(self.name, value, "a text that is not empty")
            return
        if isinstance(self.default, int | float):
            components = [value]
        else:
            components = [] if value is None else list(value)
            if len(components) != len(self.default):
                raise InvalidInputError(
                    self.name, components, f"{len(self.default)} numbers, each with a point"
                )
        for component in components:
            if math.isnan(component) and self.suited:
                continue
            if math.isnan(component) or (math.isinf(component) and not self.infinite):
                raise InvalidInputError(self.name, value, "no NaN" if self.infinite else "finite")
            if not self.lower <= component <= self.upper:
                bound = f"[{self.lower:g}, {self.upper:g}] {self.unit}".rstrip()
                raise InvalidInputError(self.name, value, bound)

    def check_type(self, value: Any) -> None:
        """Check the type of a value out of a YAML file as rcl does at the start.

        Raises:
            InvalidInputError: The type is not that of the default.
        """
        if isinstance(self.default, bool | int | float | str):
            same = type(value) is type(self.default)
        else:
            same = isinstance(value, list) and all(type(item) is float for item in value)
        if not same:
            raise InvalidInputError(self.name, value, self.type_text)

    @property
    def type_text(self) -> str:
        """What its values look like, for people."""
        if isinstance(self.default, bool):
            return "true or false"
        if isinstance(self.default, int):
            return "a whole number"
        if isinstance(self.default, float):
            return "a number with a point, such as 1.0"
        if isinstance(self.default, str):
            return "a text"
        return f"{len(self.default)} numbers, each with a point, such as 1.0"

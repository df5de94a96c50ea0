"""Checks of what stands in a declaration: types, names, sizes, numbers."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from enum import Enum
from numbers import Integral
from typing import Any, TypeVar

from dscp_core.errors import InvalidInputError

Choice = TypeVar("Choice", bound=Enum)


def members(field: str, values: Any, kind: type) -> tuple[Any, ...]:
    """The values as a tuple.

    Raises:
        InvalidInputError: No sequence, or a member of another type.
    """
    if not isinstance(values, tuple | list):
        raise InvalidInputError(field, values, f"a tuple of {kind.__name__}")
    for index, value in enumerate(values):
        if not isinstance(value, kind):
            raise InvalidInputError(f"{field}[{index}]", value, f"a {kind.__name__}")
    return tuple(values)


def optional(field: str, value: Any, kind: type) -> None:
    """Refuse what is neither None nor of a type.

    Raises:
        InvalidInputError: With the value.
    """
    if value is not None and not isinstance(value, kind):
        raise InvalidInputError(field, value, f"a {kind.__name__}, or None")


def plain(what: str, declared: Any, **kinds: type) -> None:
    """Refuse texts, yes-or-no values and choices that are of another type.

    Args:
        what: What is declared, as messages call it; empty for the problem.
        declared: A dataclass.
        **kinds: Type by its name, for the fields annotated with it; ``str`` and ``bool`` are known.

    Raises:
        InvalidInputError: With the first such field.
    """
    known: dict[Any, type] = {"str": str, "bool": bool, **kinds}
    for declaration in fields(declared):
        name, kind = declaration.name, known.get(declaration.type)
        if kind is not None and not isinstance(getattr(declared, name), kind):
            label = f"{name} of {what}" if what else name
            raise InvalidInputError(label, getattr(declared, name), f"of type {kind.__name__}")


def choice(field: str, value: Any, kind: type[Choice]) -> Choice:
    """A member of an enumeration, from itself or its value.

    Raises:
        InvalidInputError: Neither.
    """
    try:
        return kind(value)
    except ValueError:
        known = ", ".join(str(member.value) for member in kind)
        raise InvalidInputError(field, value, f"one of {known}") from None


def whole(field: str, value: Any, least: int) -> None:
    """Refuse what is no whole number from the least one.

    Raises:
        InvalidInputError: With the value.
    """
    if isinstance(value, bool) or not isinstance(value, Integral) or int(value) < least:
        raise InvalidInputError(field, value, f"a whole number >= {least}")


def distinct(field: str, names: Iterable[str], reserved: Sequence[str] = ()) -> None:
    """Refuse names that are empty, given twice, or reserved.

    Raises:
        InvalidInputError: With the first such name.
    """
    seen: set[str] = set()
    for name in names:
        named(f"name in {field}", name)
        if name in seen:
            raise InvalidInputError(field, name, "each name once")
        if name in reserved:
            raise InvalidInputError(field, name, "a name that is not reserved")
        seen.add(name)


def among(field: str, names: Iterable[Any], known: Sequence[str], bound: str) -> None:
    """Refuse names that are not known.

    Raises:
        InvalidInputError: With all such names, and what is right.
    """
    unknown = sorted(set(names) - set(known), key=str)
    if unknown:
        raise InvalidInputError(field, unknown, bound)


def mapping(field: str, value: Any) -> None:
    """Refuse what is no mapping.

    Raises:
        InvalidInputError: With the value.
    """
    if not isinstance(value, Mapping):
        raise InvalidInputError(field, value, "a mapping of names")


def named(field: str, name: Any) -> None:
    """Refuse what is no name: text in one line, not blank.

    Raises:
        InvalidInputError: With the value.
    """
    if not (isinstance(name, str) and name.strip() and name.isprintable()):
        raise InvalidInputError(field, name, "text in one line")


def positive(field: str, value: Any) -> None:
    """Refuse what is no finite number above zero.

    Raises:
        InvalidInputError: With the value.
    """
    if not (_is_number(value) and value > 0.0):
        raise InvalidInputError(field, value, "> 0 and finite")


def not_negative(field: str, value: Any) -> None:
    """Refuse what is no finite number from zero.

    Raises:
        InvalidInputError: With the value.
    """
    if not (_is_number(value) and value >= 0.0):
        raise InvalidInputError(field, value, ">= 0 and finite")


def numbers(field: str, values: Any, size: int) -> tuple[float, ...]:
    """The values as a tuple of this size, or an empty one, of finite numbers from zero.

    Raises:
        InvalidInputError: Another size, or a value that is none of these.
    """
    if not isinstance(values, tuple | list) or len(values) not in (0, size):
        raise InvalidInputError(field, values, f"length {size}")
    for index, value in enumerate(values):
        not_negative(f"{field}[{index}]", value)
    return tuple(values)


def function(field: str, value: Any) -> None:
    """Refuse what cannot be called.

    Raises:
        InvalidInputError: With the value.
    """
    if not callable(value):
        raise InvalidInputError(field, value, "a function")


def _is_number(value: Any) -> bool:
    try:
        return not isinstance(value, str | bool) and math.isfinite(value)
    except (TypeError, RuntimeError):  # the latter is CasADi's
        return False

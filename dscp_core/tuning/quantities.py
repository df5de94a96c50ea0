"""What is tuned: names, components, bounds and starts, and how they are written."""

from __future__ import annotations

import difflib
import itertools
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from dscp_core.errors import InvalidInputError
from dscp_core.problem.declaration import (
    TRUST_REGION_CONTROL,
    TRUST_REGION_STATE,
    TRUST_REGION_STEP,
    VIRTUAL_CONTROL_WEIGHT,
    OptimalControlProblem,
)
from dscp_core.problem.parameters import Parameter, Value

NETWORK = "network"
WEIGHTS = (
    TRUST_REGION_STATE,
    TRUST_REGION_CONTROL,
    TRUST_REGION_STEP,
    VIRTUAL_CONTROL_WEIGHT,
)
DEFAULT_WEIGHT_START = 1e-4
"""Where a weight starts that is zero now, which has no logarithm."""

_GRAMMAR = "NAME[.COMPONENT][=LOWER:UPPER][@START], separated by commas"
_ITEM = re.compile(
    r"(?P<name>[^.=@:]+)(\.(?P<component>[^.=@:]+))?"
    r"(=(?P<lower>[^=@:]+):(?P<upper>[^=@:]+))?(@(?P<start>[^=@:]+))?"
)


@dataclass(frozen=True)
class TunedParameter:
    """One tuned quantity.

    Attributes:
        name: Parameter of the problem's table, or ``"network"``.
        component: Which component of a vector, or None for every one.
        lower: Least value, SI; 0 for a weight without bounds.
        upper: Greatest value, SI; infinite for a weight without bounds.
        start: First value; None for the present one.
        label: As it was written, without bounds and start.
    """

    name: str
    component: int | None
    lower: float
    upper: float
    start: float | None
    label: str

    @property
    def is_network(self) -> bool:
        """Whether it stands for the weights of the terminal-time network."""
        return self.name == NETWORK


def parse_tuned(problem: OptimalControlProblem, text: str) -> tuple[TunedParameter, ...]:
    """Read a list of quantities, such as ``trust_region_state.mass,thrust_max=6e5:9e5,network``.

    Args:
        problem: Whose parameters they are.
        text: The list.

    Raises:
        InvalidInputError: Bad syntax, an unknown name or component (near ones are listed), crossed
            or missing bounds, a start outside them, or a quantity that is named twice.
    """
    items = [item.strip() for item in text.split(",") if item.strip()]
    if not items:
        raise InvalidInputError("parameters", text, f"one or more of {_GRAMMAR}")
    tuned = tuple(_parse(problem, item) for item in items)
    for one, other in itertools.combinations(tuned, 2):
        if one.name == other.name and (
            one.component == other.component or None in (one.component, other.component)
        ):
            raise InvalidInputError("parameters", other.label, "each quantity named once")
    return tuned


def components(tuned: TunedParameter, declared: Parameter) -> Sequence[int]:
    """Indices of the declared parameter that are tuned."""
    return range(declared.size) if tuned.component is None else (tuned.component,)


def check_corners(
    problem: OptimalControlProblem, tuned: Sequence[TunedParameter], values: Mapping[str, Value]
) -> None:
    """Refuse bounds that let two parameters contradict each other.

    Args:
        problem: Whose parameters they are.
        tuned: What is tuned.
        values: Parameters that differ from the defaults, SI.

    Raises:
        InvalidInputError: Two of the bounds contradict each other, or a value.
    """
    table = problem.table
    limits = [
        (table.slice(t.name).start + i, limit, t.label)
        for t in tuned
        if not t.is_network and t.name not in WEIGHTS
        for i in components(t, table[t.name])
        for limit in (t.lower, t.upper)
    ]
    if problem.check_parameters is None:
        return
    for first, second in itertools.combinations_with_replacement(limits, 2):
        packed = problem.pack(values)
        packed[first[0]], packed[second[0]] = first[1], second[1]
        try:
            problem.require_consistent(packed)
        except InvalidInputError as error:
            names = " and ".join(dict.fromkeys((first[2], second[2])))
            raise InvalidInputError(
                f"bounds of {names}", error.value, f"{error.field} {error.bound}"
            ) from None


def _parse(problem: OptimalControlProblem, item: str) -> TunedParameter:
    found = _ITEM.fullmatch(item)
    if found is None:
        raise InvalidInputError("parameters", item, _GRAMMAR)
    name = found["name"].strip()
    if name == NETWORK:
        if item != NETWORK:
            raise InvalidInputError("parameters", item, f"{NETWORK} without bounds and start")
        return TunedParameter(NETWORK, None, -math.inf, math.inf, None, NETWORK)
    declared = _declared(problem, name)
    component = _component(problem, declared, found["component"])
    label = name if found["component"] is None else f"{name}.{found['component'].strip()}"
    lower, upper = _bounds(declared, label, found["lower"], found["upper"])
    start = None if found["start"] is None else _number(f"start of {label}", found["start"])
    if start is not None and not lower <= start <= upper:
        raise InvalidInputError(f"start of {label}", start, f"[{lower:g}, {upper:g}]")
    if start is not None and name in WEIGHTS and start <= 0.0:
        raise InvalidInputError(f"start of {label}", start, "> 0")
    return TunedParameter(name, component, lower, upper, start, label)


def _declared(problem: OptimalControlProblem, name: str) -> Parameter:
    table = problem.table
    if name not in table.names:
        known = (*_tunable(problem), NETWORK)
        near = difflib.get_close_matches(name, known, n=3, cutoff=0.5)
        hint = f"; did you mean {', '.join(near)}?" if near else f": {', '.join(known)}"
        raise InvalidInputError("parameters", name, f"a known name{hint}")
    if name in problem.initial_state_parameters:
        raise InvalidInputError("parameters", name, "no initial state: those come from the logs")
    return table[name]


def _tunable(problem: OptimalControlProblem) -> Iterator[str]:
    return (n for n in problem.table.names if n not in problem.initial_state_parameters)


def _component(problem: OptimalControlProblem, declared: Parameter, text: str | None) -> int | None:
    if text is None:
        return None
    names = {
        TRUST_REGION_STATE: [s.name for s in problem.states],
        TRUST_REGION_CONTROL: [c.name for c in problem.controls],
    }.get(declared.name, [str(i) for i in range(declared.size)] if declared.is_vector else [])
    if text.strip() not in names:
        if not names:
            raise InvalidInputError("parameters", f"{declared.name}.{text}", "no component: scalar")
        near = difflib.get_close_matches(text, names, n=3, cutoff=0.5) or names
        raise InvalidInputError(f"component of {declared.name}", text, f"one of {', '.join(near)}")
    return names.index(text.strip())


def _bounds(
    declared: Parameter, label: str, lower: str | None, upper: str | None
) -> tuple[float, float]:
    weight = declared.name in WEIGHTS
    if lower is None or upper is None:
        if not weight:
            raise InvalidInputError(f"bounds of {label}", None, f"{label}=LOWER:UPPER, SI")
        return 0.0, math.inf
    low, high = _number(f"bounds of {label}", lower), _number(f"bounds of {label}", upper)
    if not low < high:
        raise InvalidInputError(f"bounds of {label}", (low, high), "LOWER < UPPER")
    if weight and low <= 0.0:
        raise InvalidInputError(f"bounds of {label}", (low, high), "> 0, a weight")
    if low < declared.lower or high > declared.upper:
        raise InvalidInputError(
            f"bounds of {label}",
            (low, high),
            f"within [{declared.lower:g}, {declared.upper:g}] {declared.unit}".rstrip(),
        )
    return low, high


def _number(field: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise InvalidInputError(field, text, "a number") from None
    if not math.isfinite(value):
        raise InvalidInputError(field, value, "finite")
    return value

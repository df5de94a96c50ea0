"""What commands share: options that describe a case, and strict JSON."""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from enum import Enum
from typing import TYPE_CHECKING, Any

from dscp_core.errors import InvalidInputError
from dscp_ros.cli.options import add_values
from dscp_ros.cli.results import print_document

if TYPE_CHECKING:
    from dscp_core.planning.planner import Planner
    from dscp_core.planning.settings import PlannerSettings
    from dscp_core.problem.declaration import OptimalControlProblem
    from dscp_core.problem.parameters import Parameter, ParameterTable, Value
    from dscp_core.scp.scp import ScpOptions

# Beyond this, memory and time grow without a visible gain in accuracy.
MOST_INTERVALS = 2000


def add_case_arguments(parser: argparse.ArgumentParser, *, optional: bool = False) -> None:
    """Declares the options that describe a case; the problem may be optional."""
    parser.add_argument(
        "problem",
        metavar="PROBLEM",
        nargs="?" if optional else None,
        help="what to solve: a known name, or FILE.py:NAME for a problem, or a function that "
        "returns one, in a Python file, which is run",
    )
    group = parser.add_argument_group("case")
    add_values(group)
    group.add_argument(
        "--list-parameters",
        action="store_true",
        help="print every parameter with its value in this case, unit and bounds, and exit",
    )
    group = parser.add_argument_group("method")
    group.add_argument(
        "--free-terminal-time",
        action=argparse.BooleanOptionalAction,
        help="let the solver choose the terminal time; --set terminal_time is then a first guess "
        "(default: the problem's own)",
    )
    group.add_argument(
        "--formulation",
        metavar="NAME",
        help="which form of the problem, where it has several (default: the problem's own)",
    )
    group.add_argument(
        "--intervals",
        type=int,
        metavar="N",
        help=f"time intervals of the trajectory, 2 to {MOST_INTERVALS} (default: the problem's "
        "own)",
    )
    group.add_argument(
        "--hold",
        choices=("mean", "linear"),
        default="mean",
        help="how the controls are flown between the nodes: constant at the mean of both (default) "
        "or linear",
    )
    group.add_argument(
        "--discretisation",
        choices=("propagated", "midpoint"),
        default="propagated",
        help="dynamics of the intervals: those that are flown (default), or the paper's midpoint "
        "rule",
    )
    group.add_argument(
        "--solver",
        metavar="NAME[,NAME]",
        help="clarabel (default), qoco, ecos, or several to try in this order",
    )


def overrides(
    args: argparse.Namespace, problem: OptimalControlProblem | None = None
) -> dict[str, Value]:
    """Parameters that the case changes, by name.

    Args:
        args: Parsed arguments.
        problem: Whose tables the vehicle file may point to; None for a file of parameters alone.

    Raises:
        InvalidInputError: A file that cannot be read, or an assignment that cannot be parsed.
    """
    from dscp_core.problem.parameters import load_parameter_file

    assigned = parse_assignments(args.assignments)
    if args.vehicle is None:
        return assigned
    read = load_parameter_file if problem is None else problem.read_vehicle
    return {**read(args.vehicle), **assigned}


def parse_assignments(assignments: Sequence[str], option: str = "--set") -> dict[str, Value]:
    """Values of NAME=VALUE texts; names and bounds are checked where the values are used.

    Args:
        assignments: The texts.
        option: Where they were given.

    Raises:
        InvalidInputError: No NAME=VALUE, a value that is no number, or a name given twice.
    """
    values: dict[str, Value] = {}
    for assignment in assignments:
        name, equals, text = (part.strip() for part in assignment.partition("="))
        if not (name and equals and text):
            raise InvalidInputError(option, assignment, "NAME=VALUE")
        if name in values:
            raise InvalidInputError(option, assignment, f"{name} only once")
        try:
            numbers = [float(part) for part in text.split(",")]
        except ValueError:
            raise InvalidInputError(name, text, "a number, or numbers as a,b,c") from None
        values[name] = numbers if len(numbers) > 1 else numbers[0]
    return values


def case_planner(
    args: argparse.Namespace, options: ScpOptions, *, best_effort: bool = False
) -> Planner:
    """Planner of the case.

    Args:
        args: Parsed arguments.
        options: How to iterate; the solver comes from the arguments.
        best_effort: Whether to make the plan of least violation where no feasible one is found.

    Raises:
        InvalidInputError: A value that cannot be used.
    """
    from dscp_core.planning.planner import Planner

    problem, settings = case_settings(args, options)
    return Planner(problem, settings, best_effort=best_effort)


def case_settings(
    args: argparse.Namespace, options: ScpOptions
) -> tuple[OptimalControlProblem, PlannerSettings]:
    """Problem of the case, and how to plan it; see `case_planner`.

    Raises:
        InvalidInputError: A value that cannot be used.
    """
    from dataclasses import replace

    from dscp_core import problems
    from dscp_core.planning.plan import TerminalTime
    from dscp_core.planning.settings import PlannerSettings

    problem = problems.get(args.problem, args.formulation)
    intervals = problem.default_intervals if args.intervals is None else args.intervals
    if not 2 <= intervals <= MOST_INTERVALS:
        raise InvalidInputError("--intervals", intervals, f"[2, {MOST_INTERVALS}]")
    free = problem.free_terminal_time
    if args.free_terminal_time is not None:
        free = args.free_terminal_time
    if args.solver is not None:
        options = replace(options, solver=args.solver)
    settings = PlannerSettings(
        parameters=overrides(args, problem),
        intervals=intervals,
        terminal_time=TerminalTime.FREE if free else TerminalTime.FIXED,
        hold=args.hold,
        discretisation=args.discretisation,
        options=options,
    )
    return problem, settings


def print_parameters(
    args: argparse.Namespace, options: Mapping[str, ParameterTable] | None = None
) -> None:
    """Prints the parameters of the case.

    Args:
        args: Parsed arguments.
        options: What else can be set, by the name of the command's option.

    Raises:
        InvalidInputError: Unknown problem or formulation, or a bad value.
    """
    from dscp_core import problems

    problem = problems.get(args.problem, args.formulation)
    changed = overrides(args, problem)
    tables = {"set": problem.table.with_defaults(changed), **(options or {})}
    if args.json:
        parameters = [
            _described(problem.table[p.name], p.default) for p in tables.pop("set").parameters
        ]
        further = {
            option: [_described(p, p.default) for p in table.parameters]
            for option, table in tables.items()
        }
        print_json({"problem": args.problem, "parameters": parameters, **further})
        return
    for option, table in tables.items():
        if option != "set":
            print(f"\n--{option}:")
        rows = [
            (p.name, _text(p.default), p.unit, f"[{p.lower:g}, {p.upper:g}]", p.description)
            for p in table.parameters
        ]
        value = "value" if changed else "default"
        print_table(("name", value, "unit", "bounds", "description"), rows)


def print_table(header: Sequence[str], rows: Sequence[Sequence[str]], indent: str = "") -> None:
    """Prints columns, left-aligned, two spaces apart; an empty header for none."""
    lines = [header, *rows] if header else rows
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    for row in lines:
        cells = (cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        print((indent + "  ".join(cells)).rstrip())


def print_json(value: Any) -> None:
    """Prints strict JSON: null stands for numbers that are not finite."""
    print_document(json_ready(value), allow_nan=False)


def json_ready(value: Any) -> Any:
    """The value made of what JSON knows: arrays as lists, NaN and infinity as null."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): json_ready(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [json_ready(item) for item in value]
    if isinstance(value, Enum):
        return value.name.lower()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _described(declared: Parameter, value: float | tuple[float, ...]) -> dict[str, Any]:
    return {
        "name": declared.name,
        "default": declared.default,
        "value": value,
        "unit": declared.unit,
        "lower": declared.lower,
        "upper": declared.upper,
        "description": declared.description,
        "source": declared.source,
    }


def _text(value: float | tuple[float, ...]) -> str:
    return ",".join(f"{number:.9g}" for number in (value if isinstance(value, tuple) else (value,)))

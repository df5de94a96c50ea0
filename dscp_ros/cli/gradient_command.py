"""`dscp gradient`: differentiate a plan, without ROS."""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING

from dscp_core.errors import InvalidInputError
from dscp_ros.cli import ExitCode
from dscp_ros.cli.arguments import (
    add_case_arguments,
    case_planner,
    print_json,
    print_parameters,
    print_table,
)

if TYPE_CHECKING:
    from dscp_core.gradients.quantities import Quantity
    from dscp_core.problem.declaration import OptimalControlProblem
    from dscp_ros.cli.gradient_report import GradientReport, ParameterGradient

DESCRIPTION = """\
Differentiates a plan with respect to parameters of the vehicle, the mission or the algorithm.

  --of cost         d J / d parameter, in the cost's unit per unit of the parameter
  --of STATE        d (its final value) / d parameter; final_STATE means the same
  --of convergence  d (sum over k > 1 of |J_k - J_K|) / d parameter: how fast the iterations settle

Methods:
  unrolled   exact derivative of the K iterations (K: those to convergence, or --iterations)
  implicit   derivative of the point that they converge to, whatever the way there

The first line says of what, of which run (feasible? converged?), and the verdict: trusted, or the
reasons why not. --check compares with differences of
the whole SCP at the same K, extrapolated; its uncertainty tells how much they are worth.
"""

EPILOG = """\
examples:
  dscp gradient powered_descent --of final_mass --wrt terminal_time --check
  dscp gradient powered_descent --of final_mass --wrt initial_position specific_impulse --json
  dscp gradient powered_descent --of final_mass --wrt thrust_max --free-terminal-time
  dscp gradient powered_descent --of cost --wrt initial_mass --method implicit --check
  dscp gradient powered_descent --of convergence --wrt trust_region_control \\
      --set trust_region_control=1e-3,1e-3,1e-3 --iterations 6
  dscp gradient entry --of cost --wrt surface_to_mass_ratio --formulation printed --iterations 5

`dscp gradient powered_descent --list-parameters` lists the names. Units are SI.

--json prints one object: headline, gradient, trusted, feasible, converged, reasons, and with
--check central_difference and relative_error; each of these a number, for a vector parameter an
array, and for several NAMEs an object by name. A relative error of an array's component is relative
to its largest component. null: the difference cannot be had, or does not tell the derivative from
zero; see notes.

exit codes: 0 good, 2 bad input, 3 no plan to differentiate.
"""

# Enough for the nodal thrust to settle, which the optimum hardly depends on (powered descent).
IMPLICIT_ITERATIONS = 40


MOST_ITERATIONS = 1000
MOST_REASONS_SHOWN = 5


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declares the command."""
    parser = subparsers.add_parser(
        "gradient", help="differentiate a plan, without ROS", description=DESCRIPTION, epilog=EPILOG
    )
    add_case_arguments(parser)
    group = parser.add_argument_group("gradient")
    group.add_argument(
        "--of", metavar="QUANTITY", help="what is differentiated: cost, convergence, or a state"
    )
    group.add_argument(
        "--wrt", nargs="+", default=(), metavar="NAME", help="with respect to these parameters"
    )
    group.add_argument(
        "--method", choices=("unrolled", "implicit"), default="unrolled", help="default: unrolled"
    )
    group.add_argument(
        "--iterations",
        type=int,
        metavar="K",
        help=f"do exactly K iterations (default: to convergence; implicit: {IMPLICIT_ITERATIONS})",
    )
    group.add_argument(
        "--check", action="store_true", help="compare with differences of the whole SCP"
    )
    group.add_argument(
        "--step",
        type=float,
        metavar="H",
        help="longest step of the differences, in the parameter's unit; shortened where an active "
        "set changes within it (default: suits the parameter)",
    )
    group = parser.add_argument_group("output")
    group.add_argument("--json", action="store_true", help="print the result as JSON on stdout")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Plans, differentiates, checks, prints.

    Returns:
        The exit code.

    Raises:
        InvalidInputError: A value that cannot be used.
    """
    if args.list_parameters:
        print_parameters(args)
        return ExitCode.OK
    _require(args)
    from dscp_core.gradients.gradient import Method
    from dscp_core.scp.scp import ScpOptions
    from dscp_ros.cli.gradient_report import check, differentiate

    fixed = args.iterations
    if fixed is None and args.method == "implicit":
        fixed = IMPLICIT_ITERATIONS
    planner = case_planner(args, ScpOptions.for_gradients(fixed_iterations=fixed))
    of = _quantity(planner.problem, args.of)
    names = tuple(dict.fromkeys(args.wrt))
    for name in names:
        planner.problem.table.slice(name)
    trace = planner.scp.run(planner.check_state(planner.initial_state))
    report = differentiate(planner.scp, trace, of, names, Method(args.method))
    if args.check and report.parameters:
        report = check(planner.scp, trace, report, args.step)
    if args.json:
        print_json({"problem": args.problem, **report.as_dict()})
    else:
        _print(report)
    return ExitCode.NO_PLAN if report.infeasible else ExitCode.OK


def _require(args: argparse.Namespace) -> None:
    """Refuses what can be refused before anything is computed."""
    if args.of is None:
        raise InvalidInputError("--of", None, "cost, convergence, or the name of a state")
    if not args.wrt:
        raise InvalidInputError("--wrt", None, "one name or more; see --list-parameters")
    if args.iterations is not None and not 1 <= args.iterations <= MOST_ITERATIONS:
        raise InvalidInputError("--iterations", args.iterations, f"[1, {MOST_ITERATIONS}]")
    if args.step is not None and not (math.isfinite(args.step) and args.step > 0.0):
        raise InvalidInputError("--step", args.step, "finite and > 0")
    if args.step is not None and not args.check:
        raise InvalidInputError("--step", args.step, "--check beside it")


def _quantity(problem: OptimalControlProblem, text: str) -> Quantity:
    """What ``--of`` means for a problem.

    Raises:
        InvalidInputError: Nothing.
    """
    from dscp_core.gradients.quantities import quantity

    try:
        return quantity(problem, text)
    except InvalidInputError as error:
        raise InvalidInputError("--of", text, error.bound) from None


def _print(report: GradientReport) -> None:
    """Prints the report."""
    print(report.headline)
    unit = report.of.unit
    if report.gradient is not None:
        print(f"  {report.of.symbol} = {report.gradient.value:.9g} {_shown(unit)}".rstrip())
    if report.parameters:
        rows = [row for p in report.parameters for row in _rows(p, unit)]
        header = ["parameter", "gradient", ""]
        if len(rows[0]) > len(header):
            header += ["central difference", "uncertainty", "relative error", "step"]
        print_table(header, rows, indent="  ")
    for note in report.notes:
        print(f"  note: {note}")
    # Without a gradient, the headline has said it.
    reasons = () if report.gradient is None else report.reasons
    for reason in reasons[:MOST_REASONS_SHOWN]:
        print(f"  reason: {reason}")
    hidden = len(reasons) - MOST_REASONS_SHOWN
    if hidden > 0:
        print(f"  and {hidden} more reasons; see --json")


def _shown(unit: str) -> str:
    return "" if unit == "1" else unit


def _rows(parameter: ParameterGradient, unit: str) -> list[list[str]]:
    per = "" if parameter.unit == "1" else f"per {parameter.unit}"
    unit = f"{_shown(unit)} {per}".strip()
    rows = [
        [parameter.label(component), f"{value: .9g}", unit]
        for component, value in enumerate(parameter.values)
    ]
    if parameter.differences:
        pairs = zip(parameter.differences, parameter.relative_errors, strict=True)
        for row, (difference, error) in zip(rows, pairs, strict=True):
            row += [
                "-" if difference.value is None else f"{difference.value: .9g}",
                "-" if difference.value is None else f"{difference.uncertainty:.0e}",
                "-" if error is None else f"{error:.1e}",
                f"{difference.step:.1e} ({difference.kind})",
            ]
    return rows

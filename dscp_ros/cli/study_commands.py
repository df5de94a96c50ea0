"""`dscp study`: compute a published result again."""

from __future__ import annotations

import argparse
import math
from dataclasses import asdict
from typing import TYPE_CHECKING

from dscp_core.errors import InvalidInputError
from dscp_ros.cli import ExitCode, entry_study_commands
from dscp_ros.cli.arguments import print_json, print_table
from dscp_ros.cli.options import add_computing, add_folder, add_json
from dscp_ros.cli.output_files import check_folder, complete_file, write_csv

if TYPE_CHECKING:
    from dscp_core.studies.terminal_time import SweepPoint, SweepSummary

DESCRIPTION = "Computes a published result again and prints it beside the published number."

EPILOG = """\
examples:
  dscp study terminal-time --quick
  dscp study terminal-time --output out/study --jobs 4
  dscp study trust-region --quick
  dscp study surface-to-mass --quick

`dscp study STUDY --help` explains each study.
"""

TERMINAL_TIME_DESCRIPTION = """\
Sweeps the terminal time of the paper's powered descent (its Fig. 1-1): final mass, its gradient by
differentiating the iterations, the same by differences of the whole SCP at the same number of
iterations, and the feasible region.

Writes terminal_time.csv and terminal_time.png into a directory, and prints a summary. The optimum
comes three times: the best of the sweep, the zero of the gradient, and a run with the terminal
time as a decision.
"""

TERMINAL_TIME_EPILOG = """\
examples:
  dscp study terminal-time --quick                      (41 points)
  dscp study terminal-time --output out/study           (201 points, minutes on two cores)
  dscp study terminal-time --from 32.7 --to 32.9 --step 0.005 --json
"""

QUICK_STEP_S = 0.05
FULL_STEP_S = 0.01


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declares the command."""
    parser = subparsers.add_parser(
        "study", help="reproduce a published result", description=DESCRIPTION, epilog=EPILOG
    )
    studies = parser.add_subparsers(title="studies", metavar="STUDY", required=True)
    _add_terminal_time(studies)
    entry_study_commands.add_parsers(studies)


def _add_terminal_time(studies: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = studies.add_parser(
        "terminal-time",
        help="final mass and its gradient over the terminal time",
        description=TERMINAL_TIME_DESCRIPTION,
        epilog=TERMINAL_TIME_EPILOG,
    )
    for option, name, default in (("--from", "start", 32.0), ("--to", "stop", 34.0)):
        parser.add_argument(
            option,
            dest=name,
            type=float,
            default=default,
            metavar="S",
            help="terminal time in seconds (default %(default)s)",
        )
    parser.add_argument(
        "--step", type=float, metavar="S", help=f"distance of points (default {FULL_STEP_S:g})"
    )
    parser.add_argument(
        "--quick", action="store_true", help=f"fewer points: a step of {QUICK_STEP_S:g} s"
    )
    add_computing(parser, "--jobs")
    add_folder(parser, "out/study")
    add_json(parser, "summary")
    parser.set_defaults(run=run_terminal_time)


def run_terminal_time(args: argparse.Namespace) -> int:
    """Sweeps, writes the files, prints the summary.

    Returns:
        The exit code.

    Raises:
        InvalidInputError: A value that cannot be used.
    """
    if args.quick and args.step is not None:
        raise InvalidInputError("--step", args.step, "no --step beside --quick")
    check_folder(args.output)
    from tqdm import tqdm

    from dscp_core.studies.terminal_time import Sweep, run_sweep, summarise
    from dscp_core.studies.terminal_time_figure import sweep_figure

    step = args.step if args.step is not None else (QUICK_STEP_S if args.quick else FULL_STEP_S)
    sweep = Sweep(args.start, args.stop, step)
    args.output.mkdir(parents=True, exist_ok=True)
    # disable=None: no bar where stderr is no terminal.
    with tqdm(total=len(sweep.times_s), unit="point", disable=None) as bar:
        points = run_sweep(sweep, jobs=args.jobs, ray_address=args.ray, report=bar.update)
    summary = summarise(sweep, points)
    table, picture = args.output / "terminal_time.csv", args.output / "terminal_time.png"
    write_csv(table, _COLUMNS, map(_row, points))
    with complete_file(picture) as partial:
        sweep_figure(points, summary).savefig(partial)
    files = {"csv": str(table), "figure": str(picture)}
    if args.json:
        print_json({**asdict(summary), **files})
    else:
        _print(summary, files)
    return ExitCode.OK


_NUMBERS = (
    "terminal_time_s",
    "iterations",
    "final_mass_kg",
    "virtual_control",
    "gradient_kg_s",
    "central_difference_kg_s",
    "uncertainty_kg_s",
    "relative_error",
)
_COLUMNS = (*_NUMBERS, "status", "trusted", "across_kink", "reasons")


def _row(point: SweepPoint) -> tuple[object, ...]:
    numbers = (getattr(point, name) for name in _NUMBERS)
    cells = (number if math.isfinite(number) else "" for number in numbers)
    verdict = (point.status.name.lower(), point.trusted, point.across_kink)
    return (*cells, *verdict, "; ".join(point.reasons))


def _print(summary: SweepSummary, files: dict[str, str]) -> None:
    from dscp_core.studies.terminal_time import GROSS_ERROR, RELIABLE_FROM_S

    low_high = summary.infeasible_s
    infeasible = "none" if low_high is None else f"{low_high[0]:.2f} .. {low_high[1]:.2f} s"
    worst = _text(summary.max_relative_error, ".1e")
    if summary.max_relative_error_at_s is not None:
        worst += f" (at {summary.max_relative_error_at_s:.2f} s)"
    paper = f"{summary.paper_optimum_s:.2f} s"
    share = None if summary.regular_share is None else 100.0 * summary.regular_share
    print(f"terminal-time sweep, {summary.points} points")
    print_table(
        ("", "here", "paper"),
        [
            ("optimum: best point", _text(summary.best_swept_s, ".4f", "s"), paper),
            ("optimum: gradient's zero", _text(summary.gradient_zero_s, ".4f", "s"), paper),
            ("optimum: time as decision", _text(summary.free_optimum_s, ".4f", "s"), paper),
            ("its final mass", _text(summary.free_final_mass_kg, ".3f", "kg"), ""),
            ("infeasible points", infeasible, "32.00 .. 32.05 s"),
            ("least feasible time", _text(summary.least_feasible_s, ".4f", "s"), ""),
        ],
        indent="  ",
    )
    print(f"feasible points from {RELIABLE_FROM_S} s on, gradient against central differences:")
    print_table(
        (),
        [
            ("mean iterations", _text(summary.mean_iterations, ".2f")),
            ("regular points", _text(share, ".1f", "%")),
            ("of these compared", str(summary.compared)),
            ("not, next to a kink", str(summary.across_kink)),
            ("median relative error", _text(summary.median_relative_error, ".1e")),
            ("greatest relative error", worst),
            (f"unflagged above {GROSS_ERROR:g}", str(summary.unflagged_gross_errors)),
        ],
        indent="  ",
    )
    for path in files.values():
        print(f"wrote {path}")


def _text(value: float | None, form: str, unit: str = "") -> str:
    return "-" if value is None else f"{value:{form}} {unit}".rstrip()

"""`dscp study trust-region` and `dscp study surface-to-mass`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dscp_core.errors import InvalidInputError
from dscp_ros.cli import ExitCode
from dscp_ros.cli.arguments import print_json, print_table
from dscp_ros.cli.options import add_computing, add_folder, add_json
from dscp_ros.cli.output_files import check_folder, complete_file, write_csv

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from dscp_core.studies.surface_to_mass import SurfaceToMassRow
    from dscp_core.studies.trust_region import TrustRegionSummary
    from dscp_core.workers.grid import GridResult, Item, Row

TRUST_REGION_DESCRIPTION = """\
Solves the paper's entry trajectory over a grid of trust-region weights w_gamma and w_u (its
section 4.2): iterations, cost, the convergence metric and its gradient by differentiating the
iterations. Then the paper's four cases, and a descent on the metric from a slow start.

Writes trust_region.csv, trust_region_descent.csv and six figures into a directory, and prints the
paper's numbers beside these. A point that stops far from the dynamics is a false stop: it counts
as not converged.
"""

SURFACE_TO_MASS_DESCRIPTION = """\
Sweeps the entry vehicle's surface-to-mass ratio (the paper's section 4.3) for the four cases of
trust-region weights, with 100 and 200 intervals: cost, iterations, and the gradient of the cost by
differentiating the iterations, against differences at the same number of iterations and against
the slope of the sweep. The optimum comes twice: the best point of the sweep, and by gradient
descent through the iterations.

Writes surface_to_mass.csv, surface_to_mass_table.csv and four figures into a directory, and prints
the paper's table beside this one.
"""

EPILOG = """\
examples:
  dscp study {name} --quick
  dscp study {name} --output out/study
  dscp study {name} --output out/study --ray 10.0.0.1:6379

Every result is kept in {file} as soon as it is there: the same command, started again,
goes on where it was interrupted.
"""

TRUST_REGION_FILE = "trust_region.results"
SURFACE_TO_MASS_FILE = "surface_to_mass.results"


def add_parsers(studies: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declares both."""
    parser = studies.add_parser(
        "trust-region",
        help="iterations and cost over the trust-region weights of the entry",
        description=TRUST_REGION_DESCRIPTION,
        epilog=EPILOG.format(name="trust-region", file=TRUST_REGION_FILE),
    )
    _add_options(parser)
    parser.set_defaults(run=run_trust_region)
    parser = studies.add_parser(
        "surface-to-mass",
        help="cost and its gradient over the entry vehicle's surface-to-mass ratio",
        description=SURFACE_TO_MASS_DESCRIPTION,
        epilog=EPILOG.format(name="surface-to-mass", file=SURFACE_TO_MASS_FILE),
    )
    _add_options(parser)
    parser.set_defaults(run=run_surface_to_mass)


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--quick", action="store_true", help="a coarse grid")
    parser.add_argument(
        "--restart", action="store_true", help="forget the results of an earlier run"
    )
    add_computing(parser, "--jobs")
    add_folder(parser, "out/study")
    add_json(parser, "summary")


def run_trust_region(args: argparse.Namespace) -> int:
    """Computes, writes the files, prints the summary.

    Returns:
        The exit code.

    Raises:
        InvalidInputError: A value that cannot be used.
        GridFileError: The results of an earlier run cannot be continued.
    """
    from dscp_core.studies import trust_region, trust_region_figures
    from dscp_core.studies.trust_region_cases import PAPER_INTERVALS

    items = trust_region.grid_items(
        trust_region.QUICK_POINTS if args.quick else trust_region.FULL_POINTS
    )
    model = trust_region.TrustRegionModel(PAPER_INTERVALS)
    settings = {"study": "trust-region", "intervals": PAPER_INTERVALS}
    result = _compute(args, TRUST_REGION_FILE, settings, items, model)
    summary = trust_region.summarise(items, result.rows)
    pairs = list(zip(items, result.rows, strict=True))
    points = [row for item, row in pairs if item[0] == "point"]
    steps = next(row["steps"] for item, row in pairs if item[0] == "descent")
    cases = {str(item[1]): row for item, row in pairs if item[0] == "case"}
    files = [
        _table(args.output / "trust_region.csv", _POINT_COLUMNS, map(_split_pairs, points)),
        _table(args.output / "trust_region_descent.csv", _STEP_COLUMNS, map(_split_pairs, steps)),
        *_draw(
            args.output,
            {
                "trust_region_iterations": trust_region_figures.iteration_map(points),
                "trust_region_cost": trust_region_figures.loss_map(points, steps),
                "trust_region_gradient": trust_region_figures.gradient_field(points),
                "trust_region_cases": trust_region_figures.evolution_figure(cases),
                "trust_region_states": trust_region_figures.state_figure(cases),
                "trust_region_altitude_speed": trust_region_figures.altitude_speed_figure(cases),
            },
        ),
    ]
    if args.json:
        print_json({**summary.document(), **_about(result, files)})
    else:
        _print_trust_region(summary, files)
    return ExitCode.OK


def run_surface_to_mass(args: argparse.Namespace) -> int:
    """Computes, writes the files, prints the table.

    Returns:
        The exit code.

    Raises:
        InvalidInputError: A value that cannot be used.
        GridFileError: The results of an earlier run cannot be continued.
    """
    from dscp_core.studies import surface_to_mass, surface_to_mass_figures

    items = surface_to_mass.sweep_items(
        surface_to_mass.QUICK_POINTS if args.quick else surface_to_mass.FULL_POINTS
    )
    settings = {"study": "surface-to-mass"}
    model = surface_to_mass.SurfaceToMassModel()
    result = _compute(args, SURFACE_TO_MASS_FILE, settings, items, model)
    summary = surface_to_mass.summarise(items, result.rows)
    points = [
        {"case": item[1], "intervals": item[2], **row}
        for item, row in zip(items, result.rows, strict=True)
        if item[0] == "point"
    ]
    figures: dict[str, Figure] = {}
    for count in sorted({row.intervals for row in summary}):
        sweep = surface_to_mass_figures.sweep_figure(items, result.rows, count)
        scatter = surface_to_mass_figures.gradient_figure(items, result.rows, count)
        figures |= {
            f"surface_to_mass_sweep_{count}": sweep,
            f"surface_to_mass_gradients_{count}": scatter,
        }
    documents = [row.document() for row in summary]
    files = [
        _table(args.output / "surface_to_mass.csv", list(points[0]), points),
        _table(
            args.output / "surface_to_mass_table.csv",
            list(_flat(documents[0])),
            map(_flat, documents),
        ),
        *_draw(args.output, figures),
    ]
    if args.json:
        print_json({"rows": documents, **_about(result, files)})
    else:
        _print_surface_to_mass(summary, files)
    return ExitCode.OK


def _compute(
    args: argparse.Namespace,
    name: str,
    settings: Row,
    items: Sequence[Item],
    model: Callable[[], Callable[[Item], Row]],
) -> GridResult:
    if args.jobs is not None and args.jobs < 1:
        raise InvalidInputError("--jobs", args.jobs, ">= 1")
    check_folder(args.output)
    from tqdm import tqdm

    from dscp_core.workers.choice import make_engine
    from dscp_core.workers.grid import code_version, run_grid

    path = args.output / name
    # disable=None: no bar where stderr is no terminal.
    with tqdm(total=len(items), unit="point", disable=None, smoothing=0.05) as bar:
        result = run_grid(
            path,
            {**settings, "code": code_version()},
            items,
            lambda: make_engine(model, args.jobs, args.ray),
            bar.update,
            restart=args.restart,
        )
    if result.kept or result.damaged:
        damaged = f", {result.damaged} damaged lines left out" if result.damaged else ""
        print(f"{path}: {result.kept} results of an earlier run used{damaged}", file=sys.stderr)
    return result


def _about(result: GridResult, files: Sequence[Path]) -> dict[str, Any]:
    return {
        "resumed": result.kept,
        "damaged": result.damaged,
        "files": [str(path) for path in files],
    }


_POINT_COLUMNS = (
    *("log_gamma", "log_control", "status", "iterations", "cost", "loss"),
    *("gradient_log_gamma", "gradient_log_control", "trusted", "max_defect"),
)
_STEP_COLUMNS = (
    *("log_gamma", "log_control", "iterations", "false_stop", "cost", "loss"),
    *("gradient_log_gamma", "gradient_log_control", "trusted"),
)


def _split_pairs(row: Row) -> dict[str, Any]:
    """A row with a column for each of the two weights."""
    gradient = row["gradient"] or (None, None)
    return {
        **row,
        "log_gamma": row["log_weights"][0],
        "log_control": row["log_weights"][1],
        "gradient_log_gamma": gradient[0],
        "gradient_log_control": gradient[1],
    }


def _flat(document: Row) -> dict[str, Any]:
    """Without nesting: names joined by underscores."""
    flat: dict[str, Any] = {}
    for name, value in document.items():
        if isinstance(value, dict):
            flat |= {f"{name}_{inner}": part for inner, part in value.items()}
        else:
            flat[name] = value
    return flat


def _table(path: Path, columns: Sequence[str], rows: Any) -> Path:
    write_csv(path, columns, ([row[column] for column in columns] for row in rows))
    return path


def _draw(directory: Path, figures: dict[str, Figure]) -> list[Path]:
    paths = []
    for name, figure in figures.items():
        path = directory / f"{name}.png"
        with complete_file(path) as partial:
            figure.savefig(partial)
        paths.append(path)
    return paths


def _print_trust_region(summary: TrustRegionSummary, files: Sequence[Path]) -> None:
    print(f"trust-region weights of the entry, {summary.points} points")
    print_table(
        ("case", "log10 w_gamma", "log10 w_u", "iterations", "paper", "cost", "defect"),
        [
            (
                case.case,
                f"{case.log_gamma:.3f}",
                f"{case.log_control:.3f}",
                _count(case.iterations),
                _count(case.paper_iterations),
                _number(case.cost, ".5f"),
                _number(case.max_defect, ".0e"),
            )
            for case in summary.cases
        ],
        indent="  ",
    )
    basin = summary.basin_iterations
    share = summary.basin_converged
    last = summary.descent_log_weights
    place = "-" if last is None else f"({last[0]:.3f}, {last[1]:.3f})"
    print_table(
        ("", "here", "paper"),
        [
            ("iterations in the paper's basin", _range(basin), "4 .. 9"),
            ("of it converged", "-" if share is None else f"{100 * share:.0f} %", ""),
            ("fewest iterations", _count(summary.fewest_iterations), "4"),
            ("points converged", f"{summary.converged} of {summary.points}", ""),
            ("false stops, not counted", str(summary.false_stops), ""),
            ("descent: iterations", ", ".join(map(_count, summary.descent_iterations)), ""),
            ("descent: fastest at", place, "(1.346, -0.635)"),
            ("descent: iterations there", _count(summary.descent_final_iterations), "4"),
            ("descent: cost there", _number(summary.descent_final_cost, ".5f"), "0.0358"),
        ],
        indent="  ",
    )
    for path in files:
        print(f"wrote {path}")


def _count(value: int | None) -> str:
    return "> 20" if value is None else str(value)


def _range(values: tuple[int, int] | None) -> str:
    return "-" if values is None else f"{values[0]} .. {values[1]}"


def _print_surface_to_mass(rows: Sequence[SurfaceToMassRow], files: Sequence[Path]) -> None:
    print("surface-to-mass ratio of the entry vehicle (the paper's numbers in brackets)")
    print_table(
        (
            *("N", "case", "optimum", "cost", "by descent", "its cost", "iterations"),
            *("correlation: equal K", "sweep", "with false stops", "largest error"),
            *("flagged", "at kinks", "false stops", "failed"),
        ),
        [
            (
                str(row.intervals),
                row.case,
                f"{_number(row.optimal_ratio, '.3f')} ({row.paper.ratio:.2f})",
                f"{_number(row.optimal_cost, '.5f')} ({row.paper.cost:.4f})",
                _number(row.descent_ratio, ".3f"),
                _number(row.descent_cost, ".5f"),
                f"{_number(row.mean_iterations, '.2f')}+-{_number(row.std_iterations, '.2f')} "
                f"({row.paper.mean_iterations:.2f}+-{row.paper.std_iterations:.2f})",
                _number(row.gradient_correlation["equal_k"], ".7f"),
                _number(row.gradient_correlation["sweep"], ".4f"),
                _number(row.gradient_correlation["sweep_all"], ".4f"),
                _number(row.max_relative_error, ".0e"),
                str(row.flagged),
                str(row.across_kink),
                str(row.false_stops),
                str(row.failed),
            )
            for row in rows
        ],
        indent="  ",
    )
    for path in files:
        print(f"wrote {path}")


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else f"{value:{form}}"

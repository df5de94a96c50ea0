"""`dscp evaluate`: measure what was learnt against brute force."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm import tqdm

from dscp_core.errors import InvalidInputError
from dscp_ros.cli import ExitCode
from dscp_ros.cli.arguments import overrides, print_json, print_table
from dscp_ros.cli.options import add_computing, add_json, add_values
from dscp_ros.cli.output_files import check_folder

if TYPE_CHECKING:
    from dscp_core.learning.evaluation import Measurement
    from dscp_core.learning.evaluator import Job, OptimumModel, Outcome
    from dscp_core.planning.terminal_time_network import TerminalTimeNetwork
    from dscp_core.workers.engine import Engine

DESCRIPTION = "Measures what was learnt against brute force."

EPILOG = """\
examples:
  dscp evaluate terminal-time --quick
  dscp evaluate terminal-time out/training/terminal_time.safetensors --output out/evaluation
"""

TERMINAL_TIME_DESCRIPTION = """\
Compares the predicted terminal times with the optimal ones, which are computed with the terminal
time as a decision, on three sets of states:

  vertical    r_x and v_x over the box, r_y = r_z = 100 m, no lateral velocity
  horizontal  r_y and r_z over the box, r_x = 5200 m, v_x = -135 m/s, no lateral velocity
  box         random states of the whole box

and plans at the predicted times: fuel lost against the optimum, and how many predictions are too
short to land in. In these plans the mean thrust of every interval keeps its lower bound, so that
alternating thrust directions gain nothing. Some optima are computed again by IPOPT.
"""

TERMINAL_TIME_EPILOG = """\
examples:
  dscp evaluate terminal-time --quick                (the two profiles only, below a minute)
  dscp evaluate terminal-time --json
  dscp evaluate terminal-time --samples 10000 --output out/evaluation
"""

PROFILE_POINTS = 11
LATERAL_POINTS = 21
IPOPT_STATES = 20
SETS = ("vertical", "horizontal", "box")


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declares the command."""
    parser = subparsers.add_parser(
        "evaluate", help="measure what was learnt", description=DESCRIPTION, epilog=EPILOG
    )
    parts = parser.add_subparsers(title="what to evaluate", metavar="WHAT", required=True)
    _add_terminal_time(parts)


def _add_terminal_time(parts: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = parts.add_parser(
        "terminal-time",
        help="the network that predicts the terminal time",
        description=TERMINAL_TIME_DESCRIPTION,
        epilog=TERMINAL_TIME_EPILOG,
    )
    parser.add_argument(
        "network", nargs="?", type=Path, metavar="NETWORK", help="its file (default: the built-in)"
    )
    parser.add_argument("--quick", action="store_true", help="the two profiles only")
    parser.add_argument(
        "--samples",
        type=int,
        default=1000,
        metavar="N",
        help="states of the box whose optimum is computed (default %(default)s)",
    )
    parser.add_argument(
        "--feasibility-samples",
        type=int,
        default=10000,
        metavar="N",
        help="further states of the box planned at the predicted time (default %(default)s)",
    )
    parser.add_argument(
        "--seed", type=int, default=1, metavar="N", help="of the random states (default 1)"
    )
    add_computing(parser)
    parser.add_argument(
        "--output", type=Path, metavar="DIR", help="draw the two profiles into this directory"
    )
    add_json(parser)
    group = parser.add_argument_group("vehicle", "the one that the network was trained for")
    add_values(group)
    parser.set_defaults(run=run_terminal_time)


def run_terminal_time(args: argparse.Namespace) -> int:
    """Measures, draws, prints.

    Returns:
        The exit code.

    Raises:
        InvalidInputError: A value that cannot be used, or a network of another vehicle.
    """
    for name in ("samples", "feasibility_samples"):
        if getattr(args, name) < 1:
            raise InvalidInputError(f"--{name.replace('_', '-')}", getattr(args, name), ">= 1")
    if args.output is not None:
        check_folder(args.output)
    from dscp_core import problems
    from dscp_core.learning.evaluator import OptimumModel
    from dscp_core.planning.terminal_time_network import TerminalTimeNetwork
    from dscp_core.workers.choice import make_engine

    problem = problems.get(problems.DEFAULT)
    parameters = overrides(args)
    shipped = args.network or problem.extras.network
    if shipped is None:
        raise InvalidInputError("NETWORK", None, f"a file: {problem.name} ships no network")
    network = TerminalTimeNetwork.load(
        shipped,
        vehicle=problem.vehicle_of(problem.table.unpack(problem.table.pack(parameters))),
    )
    model = OptimumModel(
        problem, {**parameters, "mean_thrust_fraction": 1.0}, network.data.intervals
    )
    rng = np.random.default_rng(args.seed)
    engine = make_engine(model, args.workers, args.ray)
    try:
        measurements = _measure(args, engine, network, rng)
        document: dict[str, Any] = {
            name: measurements[name].document() if name in measurements else None for name in SETS
        }
        if not args.quick:
            document |= _check(args, engine, network, model, rng)
    finally:
        engine.close()
    files = [] if args.output is None else _draw(args.output, measurements)
    document["files"] = [str(path) for path in files]
    if args.json:
        print_json(document)
    else:
        _print(document)
    return ExitCode.OK


def _measure(
    args: argparse.Namespace,
    engine: Engine[Job, Outcome],
    network: TerminalTimeNetwork,
    rng: np.random.Generator,
) -> dict[str, Measurement]:
    """Errors and fuel on every set."""
    from dscp_core.learning import evaluation
    from dscp_core.learning.sampling import PAPER_BOX, horizontal_profile, vertical_profile
    from dscp_core.planning.terminal_time_network import FeatureMap

    sets = {
        "vertical": vertical_profile(PROFILE_POINTS),
        "horizontal": horizontal_profile(LATERAL_POINTS),
    }
    if not args.quick:
        sets["box"] = PAPER_BOX.uniform(args.samples, rng)
    measurements = {}
    for name, states in sets.items():
        with tqdm(desc=name, unit="plan", disable=None) as bar:
            measurements[name] = evaluation.measure(
                engine,
                network.evaluate,
                states,
                symmetric=network.data.features is FeatureMap.AXISYMMETRIC,
                progress=bar.update,
            )
    return measurements


def _check(
    args: argparse.Namespace,
    engine: Engine[Job, Outcome],
    network: TerminalTimeNetwork,
    model: OptimumModel,
    rng: np.random.Generator,
) -> dict[str, Any]:
    """Feasibility of many predictions, and optimal times against IPOPT."""
    from dscp_core.learning import evaluation
    from dscp_core.learning.sampling import PAPER_BOX

    further = PAPER_BOX.uniform(args.feasibility_samples, rng)
    with tqdm(desc="feasibility", total=len(further), unit="plan", disable=None) as bar:
        refused = evaluation.infeasible_predictions(
            engine, network.evaluate, further, progress=bar.update
        )
    with tqdm(desc="IPOPT", total=IPOPT_STATES, unit="state", disable=None) as bar:
        checked = PAPER_BOX.uniform(IPOPT_STATES, rng)
        check = evaluation.check_against_ipopt(engine, model, checked, bar.update)
    return {
        "feasibility": {"states": len(further), "infeasible": len(refused)},
        "ipopt": asdict(check),
    }


def _draw(output: Path, measurements: dict[str, Measurement]) -> list[Path]:
    from dscp_core.learning.figures import profile_figure, write_figure

    axes = {
        "vertical": ((3, 0), ("v_x [m/s]", "r_x [m]")),
        "horizontal": ((1, 2), ("r_y [m]", "r_z [m]")),
    }
    files = []
    for name, (columns, labels) in axes.items():
        path = output / f"terminal_time_{name}.png"
        title = f"Terminal-time network, {name} profile"
        write_figure(profile_figure(measurements[name], columns, labels, title), path)
        files.append(path)
    return files


def _print(document: dict[str, Any]) -> None:
    rows = []
    for name in SETS:
        figures = document[name]
        if figures is not None:
            rows.append(
                (
                    name,
                    str(figures["states"]),
                    *(f"{figures[f'{key}_relative_error']:.1e}" for key in ("mean", "p99", "max")),
                    *(_text(figures[f"{key}_fuel_lost_kg"]) for key in ("mean", "p99", "max")),
                    str(figures["infeasible"]),
                    str(figures["unsolved"]),
                )
            )
    print_table(
        (
            "",
            "states",
            "error mean",
            "p99",
            "max",
            "fuel lost mean",
            "p99",
            "max [kg]",
            "infeasible",
            "no optimum",
        ),
        rows,
    )
    if "feasibility" in document:
        part = document["feasibility"]
        print(f"infeasible predictions among {part['states']} further states: {part['infeasible']}")
    if "ipopt" in document:
        part = document["ipopt"]
        print(
            f"optimal times against IPOPT, {part['states']} states: relative difference at most "
            f"{part['max_relative_difference']:.1e} ({part['failed']} not solved by IPOPT)"
        )
    for path in document["files"]:
        print(f"wrote {path}")


def _text(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}"

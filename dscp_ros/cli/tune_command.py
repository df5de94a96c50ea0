"""`dscp tune`: parameters that come from logs."""

from __future__ import annotations

import argparse
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dscp_core.errors import InvalidInputError
from dscp_ros.cli import ExitCode
from dscp_ros.cli.arguments import json_ready, print_json
from dscp_ros.cli.tune_report import print_logs, print_result, result_document, tuned_document

if TYPE_CHECKING:
    from dscp_core.tuning.settings import TuningSettings
    from dscp_core.tuning.tuner import TuningResult
    from dscp_ros.tuning.gathering import Gathered, GatheringOptions
    from dscp_ros.tuning.start import Start

DESCRIPTION = """\
Reads initial states from logs of the planner node (MCAP), plans from each of them, differentiates
every plan through all of its iterations, and moves the parameters of --parameters downhill. The
result is judged on states that were held out, and written as a parameter set: a directory whose
parameters.yaml the node takes by --params-file.

States are those of ~/vehicle_state, of ~/state with ~/mass where the problem takes odometry, and
those that ~/report tells of. They pass the node's own checks first. A damaged log is read as far as
it goes.

--parameters NAME[.COMPONENT][=LOWER:UPPER][@START],...
  network                     weights of the network that predicts the terminal time
  trust_region_state.mass     weight of one state; without a component, of all
  trust_region_control        weights of all controls
  virtual_control_weight      weight of the virtual control
  thrust_max=8e5:9e5          any other parameter, with bounds; SI, axes as in `dscp plan`
"""

EPILOG = """\
examples:
  dscp tune flights/*.mcap --parameters virtual_control_weight --output sets/first
  dscp tune a b --held-out c --parameters trust_region_control --loss iterations --output sets/fast
  dscp tune a b c --parameters network --params-file vehicle.yaml --output sets/mine --overwrite
  dscp tune a b --parameters network --output sets/mine --resume       (after a crash)
  dscp planner --params-file sets/first/parameters.yaml

While it runs, a checkpoint is kept in DIR.tuning.

exit codes: 0 set written; 2 bad input; 4 not written: the set is not better on the held-out states.
"""

HELD_OUT_SHARE = 0.2
MOST_STATES = 100_000
NETWORK_LEARNING_RATE = 1e-5
_NO_OPTIONS = ("run", "version")


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declares the command."""
    parser = subparsers.add_parser(
        "tune", help="tune parameters on logs", description=DESCRIPTION, epilog=EPILOG
    )
    parser.add_argument("logs", nargs="+", type=Path, metavar="BAG", help="log to tune on")
    parser.add_argument("--parameters", required=True, metavar="LIST", help="what is tuned; above")
    parser.add_argument(
        "--output", required=True, type=Path, metavar="DIR", help="directory of the parameter set"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace a set that is there")
    parser.add_argument(
        "--even-if-worse",
        "--keep-worse",
        action="store_true",
        help="write the set even if it is not better on the held-out states",
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON on stdout")
    _add_start(parser.add_argument_group("start"))
    _add_states(parser.add_argument_group("states"))
    _add_method(parser.add_argument_group("method"))
    parser.set_defaults(run=run)


def _add_start(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--params-file",
        type=Path,
        action="append",
        default=[],
        metavar="FILE",
        help="the node's parameter file with vehicle and settings to start from, or that of a "
        "parameter set; may be repeated, later ones win",
    )
    group.add_argument(
        "--problem",
        metavar="PROBLEM",
        help="a known name, or FILE.py:NAME (default: the node's)",
    )
    group.add_argument(
        "--network",
        type=Path,
        metavar="FILE",
        help="terminal-time network to start from (default: the one that the node would take)",
    )


def _add_states(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--held-out",
        type=Path,
        nargs="+",
        default=[],
        metavar="BAG",
        help="logs to judge the result by",
    )
    group.add_argument(
        "--held-out-share",
        type=float,
        metavar="X",
        help=f"share of the logs that is drawn for that instead (default {HELD_OUT_SHARE}); of a "
        "single log, the last part",
    )
    group.add_argument(
        "--states",
        type=int,
        default=MOST_STATES,
        metavar="N",
        help="most states of each log, evenly spread (default %(default)s)",
    )
    group.add_argument(
        "--node",
        default="/planner",
        metavar="NAME",
        help="name of the planner node in the logs (default %(default)s)",
    )
    group.add_argument(
        "--topic",
        action="append",
        default=[],
        metavar="NAME:=TOPIC",
        help="where a log has one of state, mass, vehicle_state and report; may be repeated",
    )


def _add_method(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--loss",
        metavar="NAME",
        help="fuel (default where the state has a mass), cost (default elsewhere), convergence, "
        "iterations, miss, or FILE.py:FUNCTION",
    )
    group.add_argument("--optimiser", default="adam", metavar="NAME", help="adam (default), lbfgs")
    group.add_argument(
        "--epochs",
        "--steps",
        type=int,
        default=20,
        metavar="N",
        help="passes over the states (adam) or steps (lbfgs) (default %(default)s)",
    )
    group.add_argument("--learning-rate", type=float, metavar="X", help="of the optimiser")
    group.add_argument(
        "--network-learning-rate",
        type=float,
        default=NETWORK_LEARNING_RATE,
        metavar="X",
        help="adam's, of a network's weights (default %(default)g)",
    )
    group.add_argument(
        "--batch",
        type=int,
        default=32,
        metavar="N",
        help="states per step of adam (default %(default)s)",
    )
    group.add_argument(
        "--fixed-iterations",
        type=int,
        metavar="N",
        help="differentiate runs of so many iterations (default: until they converge)",
    )
    group.add_argument(
        "--seed", type=int, default=0, metavar="N", help="of everything random (default 0)"
    )
    group.add_argument(
        "--workers",
        type=int,
        metavar="N",
        help="processes (default: one per processor, of this machine or the cluster)",
    )
    group.add_argument("--ray", metavar="ADDRESS", help="evaluate on a Ray cluster instead")
    group.add_argument("--resume", action="store_true", help="go on from the checkpoint")


def run(args: argparse.Namespace) -> int:
    """Tunes, judges, writes.

    Returns:
        The exit code.

    Raises:
        DscpError: Bad input, or a file that cannot be written.
    """
    from dscp_core.learning.checkpoint import CHECKPOINT_FILE
    from dscp_core.tuning.tuner import discard_checkpoint, tune
    from dscp_ros.parameter_set import check_target
    from dscp_ros.tuning.gathering import gather
    from dscp_ros.tuning.logs import topics_of_node

    check_target(args.output, overwrite=args.overwrite)
    start = _start(args)
    topics = topics_of_node(args.node, _renamed(args.topic), start.layout)
    settings = _settings(args, start)
    gathered = gather(_gathering(args, topics), start, settings, _warn)
    if not args.json:
        print_logs(gathered)
    result = tune(settings, gathered.training, gathered.held_out, network=start.network)
    for note in (*start.notes, *result.notes):
        _warn(note)
    written = None
    if result.improved or args.even_if_worse:
        written = _save(args, start, settings, gathered, result)
        for left in settings.output.glob(f".{CHECKPOINT_FILE}.*"):
            left.unlink()  # half-written by a process that was killed
        discard_checkpoint(settings.output)
    if args.json:
        logs = {"logs": gathered.document(), "held_out_rule": gathered.split.rule}
        print_json({**logs, **result_document(result), "parameter_set": written})
    else:
        print_result(settings.loss, result)
        if written is not None:
            print(f"wrote {args.output}: {written}")
    if written is None:
        _warn(
            "no better on the held-out states than before, so nothing is written; "
            "--resume --even-if-worse writes it all the same"
        )
        return ExitCode.NOT_BETTER
    return ExitCode.OK


def _warn(text: str) -> None:
    print(f"dscp tune: {text}", file=sys.stderr)


def _renamed(assignments: list[str]) -> dict[str, str]:
    renamed = {}
    for assignment in assignments:
        name, separator, topic = assignment.partition(":=")
        if not (name and separator and topic.startswith("/")):
            raise InvalidInputError("--topic", assignment, "NAME:=/TOPIC")
        renamed[name] = topic
    return renamed


def _start(args: argparse.Namespace) -> Start:
    from dscp_core.tuning.quantities import NETWORK
    from dscp_ros.tuning.start import read_start

    return read_start(
        args.params_file,
        args.node,
        problem=args.problem,
        network=args.network,
        tunes_network=NETWORK in (part.strip() for part in args.parameters.split(",")),
    )


def _settings(args: argparse.Namespace, start: Start) -> TuningSettings:
    from dscp_core.tuning.quantities import parse_tuned
    from dscp_core.tuning.settings import TuningSettings
    from dscp_ros.tuning.start import check_tuned

    tuned = parse_tuned(start.values.problem, args.parameters)
    check_tuned(start, tuned)
    output = args.output.absolute()
    return TuningSettings(
        problem=start.values.problem,
        planner=start.values.planner,
        tuned=tuned,
        output=output.with_name(f"{output.name}.tuning"),
        loss=_loss(args.loss, start),
        optimiser=args.optimiser,
        epochs=args.epochs,
        learning_rate=args.learning_rate,
        network_learning_rate=args.network_learning_rate,
        batch=args.batch,
        seed=args.seed,
        fixed_iterations=args.fixed_iterations,
        workers=args.workers,
        ray_address=args.ray,
        resume=args.resume,
        show_progress=not args.json,
    )


def _loss(name: str | None, start: Start) -> str:
    """The loss that was asked for, or the one that suits the problem.

    Raises:
        InvalidInputError: Fuel, of a problem without a mass.
    """
    from dscp_core.tuning.choice import COST, FUEL, LossChoice

    problem = start.values.problem
    has_fuel = LossChoice(FUEL).is_fuel(problem)
    if name == FUEL and not has_fuel:
        states = ", ".join(state.name for state in problem.states)
        raise InvalidInputError("--loss", name, f"a state called mass; {problem.name} has {states}")
    return name or (FUEL if has_fuel else COST)


def _gathering(args: argparse.Namespace, topics: dict[str, str]) -> GatheringOptions:
    from dscp_ros.tuning.gathering import GatheringOptions

    if args.held_out and args.held_out_share is not None:
        raise InvalidInputError(
            "--held-out-share", args.held_out_share, "not together with --held-out"
        )
    share = HELD_OUT_SHARE if args.held_out_share is None else args.held_out_share
    return GatheringOptions(args.logs, args.held_out, share, topics, args.states, args.seed)


def _save(
    args: argparse.Namespace,
    start: Start,
    settings: TuningSettings,
    gathered: Gathered,
    result: TuningResult,
) -> str:
    """Writes the set; returns its name and identifier."""
    from dscp_ros.parameter_set import save
    from dscp_ros.tuning.outcome import set_values
    from dscp_ros.tuning.sources import code_version, problem_source

    provenance = {
        "made_by": {
            "command": "dscp tune",
            **code_version(),
            "time": datetime.now(UTC).isoformat(timespec="seconds"),
        },
        "options": {k: _plain(v) for k, v in vars(args).items() if k not in _NO_OPTIONS},
        "start": start.origin,
        "problem_source": problem_source(start.values.choice),
        "tuned": [tuned_document(parameter) for parameter in settings.tuned],
        "logs": gathered.document(),
        "held_out_rule": gathered.split.rule,
        **result_document(result),
    }
    return save(
        args.output,
        set_values(start.values, result.values),
        start.network if result.network is None else result.network,
        json_ready(provenance),
        choice=start.values.choice,
        overwrite=args.overwrite,
    ).label


def _plain(value: Any) -> Any:
    if isinstance(value, list):
        return [_plain(item) for item in value]
    return str(value) if isinstance(value, Path) else value

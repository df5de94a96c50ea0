"""`dscp simulate`: fly a problem in closed loop, many times, without ROS."""

from __future__ import annotations

import argparse
import shlex
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from dscp_core.errors import InvalidInputError
from dscp_ros.cli import ExitCode
from dscp_ros.cli.arguments import (
    add_case_arguments,
    case_settings,
    parse_assignments,
    print_json,
    print_parameters,
)
from dscp_ros.cli.options import add_computing, add_folder, add_json
from dscp_ros.cli.output_files import check_folder, complete_file, write_csv
from dscp_ros.cli.simulate_report import (
    headline,
    print_campaign,
    print_replayed,
    write_document,
)

if TYPE_CHECKING:
    from dscp_core.campaigns.campaign import Campaign, CampaignResult
    from dscp_core.campaigns.statistics import CampaignStatistics
    from dscp_core.problem.parameters import ParameterTable
    from dscp_core.problem.simulation import FlightRecord, Simulated

DESCRIPTION = """\
Flies a problem in closed loop, once per seed: its guidance replans from what navigation tells, in a
world that differs from what guidance assumes. Prints how many flights succeeded and how their
figures are distributed, with confidence intervals, and every failure with the command that flies
it again.
"""

EPILOG = """\
examples:
  dscp simulate --flights 20
  dscp simulate powered_descent --flights 1000 --seed 1000 --output out/campaign
  dscp simulate --dispersions 3 --truth delay_s=0.1 --guidance replan_s=2
  dscp simulate --replay 1017 --output out/campaign
  dscp simulate --list-parameters

writes into DIR: flights.jsonl (the setup, then one flight a line as they come), flights.csv,
statistics.json and campaign.png. Every flight is kept as soon as it is there: the same command,
started again, goes on where it was interrupted, and more --flights are flown on top; another setup
is refused. --replay writes flight_SEED.json and flight_SEED.png.

exit codes: 0 every flight was flown (whether it succeeded or not), 2 bad input, 130 interrupted.
"""

FLIGHTS_FILE = "flights.jsonl"
OPTIONS = ("truth", "guidance", "bounds")
"""What a simulation has options of."""


_SINGLE = (
    *("vehicle", "formulation", "intervals", "hold", "discretisation", "solver"),
    "dispersions",
)
"""Options with one value that a replay needs."""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declares the command."""
    parser = subparsers.add_parser(
        "simulate",
        help="fly closed-loop campaigns, without ROS",
        description=DESCRIPTION,
        epilog=EPILOG,
    )
    add_case_arguments(parser, optional=True)
    group = parser.add_argument_group("campaign")
    group.add_argument(
        "--flights", type=int, default=100, metavar="N", help="how many (default %(default)s)"
    )
    group.add_argument(
        "--seed",
        type=int,
        default=1,
        metavar="S",
        help="of the first flight; the others follow one by one (default %(default)s)",
    )
    group.add_argument(
        "--dispersions", type=float, metavar="FACTOR", help="on all random errors (default 1)"
    )
    for option, what in zip(
        OPTIONS, ("the world that flies", "guidance", "what a success is"), strict=True
    ):
        group.add_argument(
            f"--{option}",
            action="append",
            default=[],
            metavar="NAME=VALUE",
            help=f"set an option of {what}, SI; may be repeated",
        )
    group.add_argument(
        "--replay", type=int, metavar="SEED", help="fly one flight again, and write it in full"
    )
    group.add_argument(
        "--over-ros",
        action="store_true",
        help="let a planner node, a process of its own, make the plans over ROS 2 topics; one "
        "flight after the other",
    )
    add_computing(parser)
    add_folder(parser, "out/simulate")
    group = parser.add_argument_group("output")
    group.add_argument(
        "--restart", action="store_true", help="forget the flights of an earlier run"
    )
    group.add_argument(
        "--write-bags",
        type=Path,
        metavar="DIR",
        help="write MCAP logs of the worst flights, or of that of --replay; needs ROS",
    )
    add_json(parser, "statistics")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Flies, writes the files, prints the statistics.

    Returns:
        The exit code.

    Raises:
        InvalidInputError: A value that cannot be used.
        GridFileError: The flights of an earlier run cannot be continued.
    """
    from dscp_core import problems

    args.problem = args.problem or problems.DEFAULT
    if args.list_parameters:
        simulated = problems.get(args.problem, args.formulation).extras.simulation
        print_parameters(args, None if simulated is None else _option_tables(simulated, args))
        return ExitCode.OK
    if args.workers is not None and args.workers < 1:
        raise InvalidInputError("--workers", args.workers, ">= 1")
    check_folder(args.output)
    if args.write_bags is not None:
        check_folder(args.write_bags, "--write-bags")
    campaign = make_campaign(args)
    with _over_ros(args, campaign) if args.over_ros else nullcontext(campaign) as chosen:
        if args.replay is not None:
            _replay(args, chosen)
        else:
            _fly(args, chosen)
    return ExitCode.OK


@contextmanager
def _over_ros(args: argparse.Namespace, campaign: Campaign) -> Iterator[Campaign]:
    """The same campaign, planned by a planner node for the length of the block."""
    if args.workers is not None or args.ray is not None:
        raise InvalidInputError("--over-ros", True, "neither --workers nor --ray beside it")
    from dscp_ros.flights.node_planner import node_planner

    args.output.mkdir(parents=True, exist_ok=True)
    log = args.output / "planner.log"
    with node_planner(args.problem, campaign.problem, campaign.settings, log) as planner:
        yield replace(campaign, planner=planner)


def make_campaign(args: argparse.Namespace) -> Campaign:
    """What the arguments ask for.

    Raises:
        InvalidInputError: A value that cannot be used.
    """
    from dscp_core.campaigns.campaign import Campaign
    from dscp_core.problem.simulation import DISPERSION
    from dscp_core.scp.scp import ScpOptions

    if args.free_terminal_time is None:
        args.free_terminal_time = True  # a replan has less time to go than the plan before it
    problem, settings = case_settings(args, ScpOptions())
    simulated = problem.extras.simulation
    if simulated is None:
        raise InvalidInputError("problem", args.problem, "one that brings a simulation")
    _option_tables(simulated, args)
    options = {
        name: value
        for option in OPTIONS
        for name, value in parse_assignments(getattr(args, option), f"--{option}").items()
    }
    if args.dispersions is not None:
        if DISPERSION not in (parameter.name for parameter in simulated.truth):
            raise InvalidInputError("--dispersions", args.dispersions, "none for this problem")
        if DISPERSION in options:
            raise InvalidInputError(
                "--dispersions", args.dispersions, f"no --truth {DISPERSION} beside it"
            )
        options[DISPERSION] = args.dispersions
    return Campaign(problem, settings, options)


def replay_command(args: argparse.Namespace, seed: int) -> str:
    """The command that flies one flight again."""
    words = ["dscp", "simulate", args.problem]
    given = {"set": args.assignments, **{option: getattr(args, option) for option in OPTIONS}}
    for option, values in given.items():
        words += [word for value in values for word in (f"--{option}", value)]
    for option in _SINGLE:
        if getattr(args, option) is not None:
            words += [f"--{option}", str(getattr(args, option))]
    if args.over_ros:
        words.append("--over-ros")
    if args.free_terminal_time is False:
        words.append("--no-free-terminal-time")
    return shlex.join([*words, "--replay", str(seed)])


def _fly(args: argparse.Namespace, campaign: Campaign) -> None:
    from tqdm import tqdm

    from dscp_core.campaigns.campaign import run_campaign, seeds_of
    from dscp_core.campaigns.documents import document
    from dscp_core.campaigns.statistics import statistics

    seeds = seeds_of(args.seed, args.flights)
    path = args.output / FLIGHTS_FILE
    started_s = time.perf_counter()
    # disable=None: no bar where stderr is no terminal.
    with tqdm(total=len(seeds), unit="flight", disable=None, smoothing=0.05) as bar:
        result = run_campaign(
            path,
            campaign,
            seeds,
            workers=args.workers,
            ray_address=args.ray,
            report=bar.update,
            restart=args.restart,
        )
    wall_s = time.perf_counter() - started_s
    if result.kept or result.damaged:
        damaged = f", {result.damaged} damaged lines left out" if result.damaged else ""
        print(f"{path}: {result.kept} flights of an earlier run used{damaged}", file=sys.stderr)
    summed = statistics(result.simulation, result.flights)
    files = _write(args, campaign, result, summed)
    commands = {flight.seed: replay_command(args, flight.seed) for flight in summed.failed}
    about = {
        "problem": campaign.problem.name,
        "seeds": [seeds[0], seeds[-1]],
        "digest": result.digest,
        "resumed": result.kept,
        "damaged": result.damaged,
        "wall_s": wall_s,
        "flights_per_minute": 60.0 * (len(seeds) - result.kept) / wall_s,
        "files": [str(file) for file in files],
    }
    described = {**about, **document(result.simulation, summed), "replay": commands}
    write_document(args.output / "statistics.json", described)
    if args.json:
        print_json(described)
    else:
        print_campaign(campaign.problem.name, summed, commands, about)


def _write(
    args: argparse.Namespace,
    campaign: Campaign,
    result: CampaignResult,
    summed: CampaignStatistics,
) -> list[Path]:
    from dscp_core.campaigns.documents import flight_columns, flight_row
    from dscp_core.campaigns.figures import campaign_figure, worst_seeds

    table, picture = args.output / "flights.csv", args.output / "campaign.png"
    simulation = result.simulation
    rows = (flight_row(simulation, flight) for flight in result.flights)
    write_csv(table, flight_columns(simulation), rows)
    worst = [simulation.record(seed) for seed in worst_seeds(simulation, result.flights)]
    title = headline(campaign.problem.name, summed)
    with complete_file(picture) as partial:
        campaign_figure(simulation, result.flights, summed, worst, title).savefig(partial)
    files = [args.output / FLIGHTS_FILE, table, args.output / "statistics.json", picture]
    return [*files, *_write_bags(args, campaign, worst)]


def _replay(args: argparse.Namespace, campaign: Campaign) -> None:
    from dscp_core.campaigns.documents import flight_document
    from dscp_core.campaigns.figures import flight_figure

    seed = args.replay
    if seed < 0:
        raise InvalidInputError("--replay", seed, ">= 0")
    simulation = campaign.simulation()
    record = simulation.record(seed)
    described = flight_document(campaign.problem, simulation, record)
    args.output.mkdir(parents=True, exist_ok=True)
    whole, picture = (args.output / f"flight_{seed}{suffix}" for suffix in (".json", ".png"))
    write_document(whole, described)
    classes = ", ".join(described["classes"]) or "success"
    title = f"{campaign.problem.name}, seed {seed}: {classes}"
    with complete_file(picture) as partial:
        flight_figure(record, title).savefig(partial)
    files = [whole, picture, *_write_bags(args, campaign, [record])]
    if args.json:
        print_json({**described, "files": [str(file) for file in files]})
    else:
        print_replayed(title, described, files)


def _write_bags(
    args: argparse.Namespace, campaign: Campaign, records: Sequence[FlightRecord]
) -> list[Path]:
    if args.write_bags is None:
        return []
    from dscp_ros.flights.logs import write_flight

    return [
        write_flight(
            args.write_bags / f"{campaign.problem.name}_{record.summary.seed}",
            campaign.problem,
            record,
        )
        for record in records
    ]


def _option_tables(simulated: Simulated, args: argparse.Namespace) -> dict[str, ParameterTable]:
    """Options of truth and guidance with the given values as defaults.

    Raises:
        InvalidInputError: An unknown option, or a value out of bounds.
    """
    from dscp_core.problem.parameters import ParameterTable

    return {
        name: ParameterTable(getattr(simulated, name)).with_defaults(
            parse_assignments(getattr(args, name), f"--{name}")
        )
        for name in OPTIONS
    }

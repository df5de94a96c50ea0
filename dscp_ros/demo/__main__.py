"""Entry point of the demonstration: options, signals, exit codes."""

from __future__ import annotations

import argparse
import math
import os
import shlex
import signal
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FrameType
from typing import NoReturn

from dscp_core.errors import DscpError, InvalidInputError
from dscp_core.problems import DEFAULT
from dscp_ros.bag import BagError
from dscp_ros.cli import ExitCode
from dscp_ros.cli.output_files import complete_file
from dscp_ros.demo.cases import (
    CAMPAIGN_FLIGHTS,
    CASES,
    LOOP_BAGS,
    LOOP_EPOCHS,
    LOOP_RATE,
    LOOP_VEHICLE,
    DemoCase,
    shared,
)

DESCRIPTION = """\
Starts the planner node as a process of its own, replays recorded flights into it on real ROS 2
topics, records what it publishes, prints what became of every state, and draws a plan.

It uses a ROS domain of its own on this machine only: other nodes are neither heard nor disturbed.
"""

EPILOG = """\
writes into DIR:
  planner_output/       what the planner published, an MCAP bag (try: dscp bag info)
  landing.png           one of its plans: as planned, and as integrated afterwards (entry.png)
  planner.log, BAG.log  what the processes said (ros_log/: the same as ROS keeps it)
  parameter_set/        with --loop: what the node reloaded; tune.log: how it was made

exit codes: 0 good, 1 a process failed or time is up, 2 bad input, 3 no certified plan,
130 interrupted
"""

_FAILED = 1


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the demonstration.

    Args:
        argv: Arguments after the program's name; the process's own by default.

    Returns:
        Exit code.
    """
    parser = argparse.ArgumentParser(
        prog="python -m dscp_ros.demo",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument(
        "--output", type=Path, required=True, metavar="DIR", help="folder for the results"
    )
    parser.add_argument(
        "--problem",
        choices=tuple(CASES),
        default=DEFAULT,
        help=f"what the bags hold ({DEFAULT})",
    )
    parser.add_argument(
        "--loop",
        action="store_true",
        help="plan, tune on the log, reload, and plan from states that the tuning has not seen",
    )
    parser.add_argument(
        "--campaign",
        type=int,
        nargs="?",
        const=CAMPAIGN_FLIGHTS,
        metavar="N",
        help="fly the problem in closed loop instead, without ROS: dscp simulate --flights N "
        f"({CAMPAIGN_FLIGHTS})",
    )
    parser.add_argument(
        "--epochs",
        type=int,
        default=LOOP_EPOCHS,
        metavar="N",
        help=f"of that tuning ({LOOP_EPOCHS})",
    )
    parser.add_argument(
        "--bag",
        type=Path,
        action="append",
        metavar="BAG",
        help="replay this bag instead of the sample bags; may be given several times, in the "
        "order of recording (--loop: the log, and the unseen one)",
    )
    rates = ", ".join(f"{case.rate:g} for {case.problem}" for case in CASES.values())
    parser.add_argument(
        "--rate", type=float, metavar="R", help=f"recorded seconds per second ({rates})"
    )
    parser.add_argument(
        "--timeout", type=float, default=300.0, metavar="S", help="longest time in seconds (300)"
    )
    args = parser.parse_args(argv)
    # SIGTERM and a closed terminal end the children too, as Ctrl-C does.
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, _interrupt)
    case = CASES[args.problem]
    rate = case.rate if args.rate is None else args.rate
    try:
        _require_positive("--rate", rate)
        _require_positive("--timeout", args.timeout)
        if args.campaign is not None:
            if args.loop or args.bag:
                raise InvalidInputError("--campaign", args.campaign, "neither --loop nor --bag")
            return _fly(args.problem, args.campaign, args.output)
        if args.loop:
            return _run_loop(args.output, args.bag, args.epochs, args.rate, args.timeout)
        return _run(case, args.output, args.bag or case.bags(), rate, args.timeout)
    except KeyboardInterrupt:
        print("interrupted; every process was stopped", file=sys.stderr)
        return ExitCode.INTERRUPTED
    except (InvalidInputError, BagError) as error:
        return _fail(error, ExitCode.BAD_INPUT)
    except DscpError as error:
        return _fail(error, _FAILED)


def _require_positive(option: str, value: float) -> None:
    if not (math.isfinite(value) and value > 0.0):
        raise InvalidInputError(option, value, "> 0")


def _isolate(folder: Path) -> None:
    """Keep to a domain on this machine. Before ROS is imported; child processes inherit it."""
    os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ["ROS_LOG_DIR"] = str(folder.resolve() / "ros_log")


def _teller() -> Callable[[str], None]:
    started_s = time.monotonic()

    def say(line: str) -> None:
        print(f"[{time.monotonic() - started_s:5.1f} s] {line}", flush=True)

    return say


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidInputError("--output", str(folder), f"a folder ({error.strerror})") from None


def _fly(problem: str, flights: int, folder: Path) -> int:
    from dscp_ros.cli.main import main as dscp

    command = ["simulate", problem, "--flights", str(flights), "--output", str(folder)]
    print(shlex.join(["dscp", *command]), flush=True)
    return dscp([*command, "--restart"])


def _run_loop(
    folder: Path, bags: Sequence[Path] | None, epochs: int, rate: float | None, timeout_s: float
) -> int:
    say = _teller()
    _isolate(folder)
    from dscp_ros.demo.loop import LoopSettings, run_loop
    from dscp_ros.demo.session import open_input

    paths = bags or [shared(f"bags/{name}", "--bag") for name in LOOP_BAGS]
    if len(paths) != 2:
        raise InvalidInputError("--bag", [str(path) for path in paths], "two: log and unseen one")
    log, unseen = (open_input(path) for path in paths)
    _make_folder(folder)
    before, after = run_loop(
        LoopSettings(
            vehicle=shared(LOOP_VEHICLE, "--loop"),
            log=log,
            unseen=unseen,
            folder=folder,
            epochs=epochs,
            rate=LOOP_RATE if rate is None else rate,
            timeout_s=timeout_s,
        ),
        say,
    )
    if not (before.certified and after.certified):
        return _fail("no certified plan came out", ExitCode.NO_PLAN)
    say(f"results in {folder}")
    return ExitCode.OK


def _run(case: DemoCase, folder: Path, paths: Sequence[Path], rate: float, timeout_s: float) -> int:
    say = _teller()
    _isolate(folder)
    from dscp_core.planning.histories import plan_figure
    from dscp_ros.demo.recorded import recorded_plan
    from dscp_ros.demo.session import open_input, run_session
    from dscp_ros.demo.summary import figures_of, read_reports, table

    bags = [open_input(path) for path in paths]
    _make_folder(folder)
    recording = run_session(
        bags,
        folder,
        rate=rate,
        timeout_s=timeout_s,
        say=say,
        node_arguments=case.node_arguments(),
    )
    say(f"reading {recording}")
    reports = read_reports(recording)
    parts = [figures_of(bag, reports) for bag in bags]
    print(f"\n{table(parts)}\n", flush=True)
    found = recorded_plan(recording, parts, case.problem, case.frame)
    if found is None:
        return _fail("no certified plan came out", ExitCode.NO_PLAN)
    picture = folder / case.picture
    with complete_file(picture) as partial:
        plan_figure(found.problem, found.plan, found.certificate, found.parameters).savefig(partial)
    say(f"drew the plan from {case.start_text(found.report.state)}; results:")
    print(f"  {recording}\n  {picture}")
    if not found.certificate.passed:
        reasons = "; ".join(found.certificate.reasons)
        return _fail(f"the recorded plan does not pass a second check: {reasons}", _FAILED)
    return ExitCode.OK


def _interrupt(_number: int, _frame: FrameType | None) -> NoReturn:
    raise KeyboardInterrupt


def _fail(why: object, code: int) -> int:
    print(f"demo failed: {why}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())

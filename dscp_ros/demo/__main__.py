"""Entry point of the demonstration: options, signals, exit codes."""

from __future__ import annotations

import argparse
import math
import os
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from types import FrameType
from typing import NoReturn

from dscp_core.errors import DscpError, InvalidInputError
from dscp_ros.bag import BagError
from dscp_ros.cli import ExitCode
from dscp_ros.cli.output_files import complete_file

DESCRIPTION = """\
Starts the planner node as a process of its own, replays recorded descents into it on real ROS 2
topics, records what it publishes, prints what became of every state, and draws a landing.

It uses a ROS domain of its own on this machine only: other nodes are neither heard nor disturbed.
"""

EPILOG = """\
writes into DIR:
  planner_output/       what the planner published, an MCAP bag (try: dscp bag info)
  landing.png           one of its plans: as planned, and as integrated afterwards
  planner.log, BAG.log  what the processes said (ros_log/: the same as ROS keeps it)

exit codes: 0 good, 1 a process failed or time is up, 2 bad input, 3 no certified plan,
130 interrupted
"""

SAMPLE_BAGS = ("powered_descent_dispersed", "powered_descent_nominal")
"""In the order of their recorded time, so that the clock moves forward."""

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
        "--bag",
        type=Path,
        action="append",
        metavar="BAG",
        help="replay this bag instead of the sample bags; may be given several times, in the "
        "order of recording",
    )
    parser.add_argument(
        "--rate", type=float, default=1.5, metavar="R", help="recorded seconds per second (1.5)"
    )
    parser.add_argument(
        "--timeout", type=float, default=120.0, metavar="S", help="longest time in seconds (120)"
    )
    args = parser.parse_args(argv)
    # SIGTERM and a closed terminal end the children too, as Ctrl-C does.
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, _interrupt)
    try:
        _require_positive("--rate", args.rate)
        _require_positive("--timeout", args.timeout)
        return _run(args.output, args.bag or sample_bags(), args.rate, args.timeout)
    except KeyboardInterrupt:
        print("interrupted; every process was stopped", file=sys.stderr)
        return ExitCode.INTERRUPTED
    except (InvalidInputError, BagError) as error:
        return _fail(error, ExitCode.BAD_INPUT)
    except DscpError as error:
        return _fail(error, _FAILED)


def sample_bags() -> list[Path]:
    """The sample bags: beside the packages in a checkout, under share/ where they are installed.

    Raises:
        InvalidInputError: They are in neither place.
    """
    folders = (Path(__file__).parents[2] / "bags", Path(sys.prefix) / "share" / "dscp_ros" / "bags")
    for folder in folders:
        bags = [folder / name for name in SAMPLE_BAGS]
        if all(bag.exists() for bag in bags):
            return bags
    places = " or ".join(str(folder) for folder in folders)
    raise InvalidInputError(
        "--bag", None, f"a bag, as {', '.join(SAMPLE_BAGS)} are not in {places}"
    )


def _require_positive(option: str, value: float) -> None:
    if not (math.isfinite(value) and value > 0.0):
        raise InvalidInputError(option, value, "> 0")


def _run(folder: Path, paths: Sequence[Path], rate: float, timeout_s: float) -> int:
    started_s = time.monotonic()
    # Before ROS is imported; the child processes inherit these.
    os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ["ROS_LOG_DIR"] = str(folder.resolve() / "ros_log")
    from dscp_core.plotting import plan_figure
    from dscp_ros.demo.landing import recorded_landing
    from dscp_ros.demo.session import open_input, run_session
    from dscp_ros.demo.summary import figures_of, read_reports, table

    def say(line: str) -> None:
        print(f"[{time.monotonic() - started_s:5.1f} s] {line}", flush=True)

    bags = [open_input(path) for path in paths]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidInputError("--output", str(folder), f"a folder ({error.strerror})") from None
    recording = run_session(bags, folder, rate=rate, timeout_s=timeout_s, say=say)
    say(f"reading {recording}")
    reports = read_reports(recording)
    parts = [figures_of(bag, reports) for bag in bags]
    print(f"\n{table(parts)}\n", flush=True)
    landing = recorded_landing(recording, parts)
    if landing is None:
        return _fail("no certified plan came out", ExitCode.NO_PLAN)
    picture = folder / "landing.png"
    with complete_file(picture) as partial:
        plan_figure(landing.plan, landing.certificate, landing.parameters).savefig(partial)
    say(f"drew the plan from {landing.start_text}; results:")
    print(f"  {recording}\n  {picture}")
    if not landing.certificate.passed:
        reasons = "; ".join(landing.certificate.reasons)
        return _fail(f"the recorded plan does not pass a second check: {reasons}", _FAILED)
    return ExitCode.OK


def _interrupt(_number: int, _frame: FrameType | None) -> NoReturn:
    raise KeyboardInterrupt


def _fail(why: object, code: int) -> int:
    print(f"demo failed: {why}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())

"""`dscp replay`: publishes a bag's messages on ROS 2 topics."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from dscp_ros.cli.results import print_document
from dscp_ros.replay.options import (
    DEFAULT_CLOCK_HZ,
    DEFAULT_WAIT_S,
    ReplayOptions,
    SubscriberWait,
    parse_remaps,
    read_qos_overrides,
)

if TYPE_CHECKING:
    from dscp_ros.bag import RecoveryReport
    from dscp_ros.replay.result import ReplayResult

DESCRIPTION = """\
Publishes the messages of a bag on real ROS 2 topics, at the times at which they were recorded.
BAG is a bag directory or a single .mcap file. A damaged bag is replayed as far as it is readable.

Quality of service is that of the recording. Latched (transient local) topics are sent first with
what they held at the start, also with --start-offset and at each pass of --loop.

While it runs: space or s pauses and resumes (in a terminal), and so do the services
/dscp_replay/pause, /dscp_replay/resume and /dscp_replay/toggle_paused (std_srvs/Trigger).
Ctrl-C or SIGTERM stops it with exit code 0.
"""

EPILOG = """\
examples:
  dscp replay BAG
  dscp replay BAG --topics /state /mass --remap /state:=/planner/state
  dscp replay BAG --restamp --wait-for-subscribers 1
  dscp replay BAG --start-offset 10 --duration 5 --rate 0.5 --loop
  dscp replay BAG --clock 100        (the consumers need use_sim_time)

QoS override file (policies that are not given stay as recorded):
  /state:
    reliability: best_effort
    depth: 5
"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Adds the command to the command line."""
    parser = subparsers.add_parser(
        "replay",
        help="publish a bag's messages on ROS 2 topics",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("bag", metavar="BAG", type=Path, help="bag directory or .mcap file")
    _add_timing(parser)
    _add_topics(parser)
    _add_output(parser)
    parser.set_defaults(run=run)


def _add_timing(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("timing")
    group.add_argument(
        "--rate",
        type=float,
        default=1.0,
        metavar="R",
        help="seconds of the bag per second, above 0 up to 1000 (default 1)",
    )
    group.add_argument("--loop", action="store_true", help="start again at the end")
    group.add_argument(
        "--start-offset",
        type=float,
        default=0.0,
        metavar="S",
        help="seconds of the bag to skip (default 0)",
    )
    group.add_argument(
        "--duration", type=float, metavar="S", help="seconds of the bag to play (default: the rest)"
    )
    group.add_argument(
        "--delay",
        type=float,
        default=0.0,
        metavar="S",
        help="seconds to wait before each pass (default 0)",
    )
    group.add_argument("--paused", action="store_true", help="start paused")
    group.add_argument(
        "--as-fast-as-possible",
        action="store_true",
        help="ignore the bag's timing; reliable subscribers set the pace",
    )
    group.add_argument(
        "--clock",
        type=float,
        nargs="?",
        const=DEFAULT_CLOCK_HZ,
        metavar="HZ",
        help=f"publish the bag's time on /clock (default {DEFAULT_CLOCK_HZ:g} Hz of real time, or "
        "of the bag's time with --as-fast-as-possible)",
    )
    group.add_argument(
        "--wait-for-subscribers",
        metavar="N[/TIMEOUT]",
        help="wait until every replayed topic has N subscribers, at most TIMEOUT seconds "
        f"(default {DEFAULT_WAIT_S:g})",
    )


def _add_topics(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("topics")
    group.add_argument("--topics", nargs="+", default=(), metavar="TOPIC", help="only these")
    group.add_argument("--exclude", nargs="+", default=(), metavar="TOPIC", help="not these")
    group.add_argument(
        "--remap", nargs="+", default=(), metavar="OLD:=NEW", help="publish under another name"
    )
    group.add_argument(
        "--restamp",
        action="store_true",
        help="set header.stamp to the time of publishing (with --clock: that of /clock)",
    )
    group.add_argument(
        "--qos-overrides",
        type=Path,
        metavar="FILE",
        help="YAML file with quality of service by topic, in rosbag2's format",
    )
    group.add_argument(
        "--skip-unknown-types",
        action="store_true",
        help="leave out topics whose message type is not installed, instead of refusing the bag",
    )


def _add_output(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("output")
    group.add_argument(
        "--progress",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="progress bar on stderr (default: if stderr is a terminal)",
    )
    group.add_argument("--json", action="store_true", help="print the result as JSON on stdout")
    group.add_argument(
        "--ros-args",
        nargs=argparse.REMAINDER,
        default=(),
        metavar="...",
        help="arguments for ROS 2 itself; must come last",
    )


def run(args: argparse.Namespace) -> int:
    """Replays a bag; returns the exit code.

    Raises:
        DscpError: If the bag or an option is bad.
    """
    options = options_from(args)
    from dscp_ros.replay.node import replay

    result, report = replay(
        options,
        show_progress=args.progress,
        ros_args=args.ros_args,
        say=lambda line: print(f"dscp replay: {line}", file=sys.stderr),
    )
    if args.json:
        print_document({"bag": str(options.bag), **result.to_dict(), "report": report.to_dict()})
    else:
        _print(result, report)
    return 0


def options_from(args: argparse.Namespace) -> ReplayOptions:
    """Returns the checked options.

    Raises:
        InvalidInputError: If a value is out of range.
    """
    wait = args.wait_for_subscribers
    return ReplayOptions(
        bag=args.bag,
        rate=args.rate,
        loop=args.loop,
        start_offset_s=args.start_offset,
        duration_s=args.duration,
        topics=tuple(args.topics),
        exclude=tuple(args.exclude),
        remaps=parse_remaps(args.remap),
        clock_hz=args.clock,
        delay_s=args.delay,
        paused=args.paused,
        restamp=args.restamp,
        as_fast_as_possible=args.as_fast_as_possible,
        qos_overrides={} if args.qos_overrides is None else read_qos_overrides(args.qos_overrides),
        wait=None if wait is None else SubscriberWait.parse(wait),
        skip_unknown_types=args.skip_unknown_types,
    )


def _print(result: ReplayResult, report: RecoveryReport) -> None:
    verb = "stopped after" if result.interrupted else "replayed"
    passes = f", {result.passes} passes" if result.passes > 1 else ""
    print(
        f"{verb} {result.message_count} messages on {len(result.published)} topics "
        f"in {result.seconds:.1f} s{passes} "
        f"(late by {result.lateness_mean_s * 1e3:.2f} ms on average, "
        f"{result.lateness_max_s * 1e3:.2f} ms at most)"
    )
    if result.unacknowledged:
        print(f"not confirmed by every subscriber: {', '.join(result.unacknowledged)}")
    if not report.intact:
        print("the bag is damaged:")
        for line in report.lines():
            print(f"  {line}")

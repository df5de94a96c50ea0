"""`dscp bag`: looks into, checks, repairs and records bags."""

from __future__ import annotations

import argparse
from pathlib import Path

from dscp_ros.cli import ExitCode
from dscp_ros.cli.results import print_document

DESCRIPTION = """\
Works on ROS 2 bags in the MCAP format: a bag directory, with or without metadata.yaml, or a single
.mcap file. All but `record` work without ROS.
"""

EPILOG = """\
examples:
  dscp bag info BAG
  dscp bag check BAG && echo good
  dscp bag recover DAMAGED_BAG GOOD_BAG
  dscp bag record BAG /planner/trajectory /planner/report
"""

_COMPRESSIONS = ("zstd", "lz4", "none")


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Adds the command to the command line."""
    parser = subparsers.add_parser(
        "bag",
        help="look into, check and repair MCAP bags",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    actions = parser.add_subparsers(title="actions", metavar="ACTION", required=True)

    info = actions.add_parser("info", help="show topics, times and damage of a bag")
    _add_bag(info)
    info.set_defaults(run=run_info)

    check = actions.add_parser(
        "check",
        help="read everything and compare all checksums; exit code 2 if the bag is damaged",
    )
    _add_bag(check)
    check.set_defaults(run=run_check)

    recover = actions.add_parser("recover", help="write a good bag from what can be saved")
    _add_bag(recover)
    _add_output(recover)
    recover.set_defaults(run=run_recover)

    record = actions.add_parser(
        "record", help="record topics until Ctrl-C, with the publishers' quality of service"
    )
    _add_output(record)
    record.add_argument("topics", metavar="TOPIC", nargs="+", help="topic to record")
    record.add_argument("--json", action="store_true", help="print the result as JSON")
    record.set_defaults(run=run_record)


def _add_bag(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("bag", metavar="BAG", type=Path, help="bag directory or .mcap file")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def _add_output(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "output", metavar="OUTPUT", type=Path, help="bag to write: a directory, or NAME.mcap"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace OUTPUT if it is a bag")
    parser.add_argument(
        "--compression",
        choices=_COMPRESSIONS,
        default=_COMPRESSIONS[0],
        help="compression of the bag's chunks (default %(default)s)",
    )


def run_info(args: argparse.Namespace) -> int:
    """Shows what is in a bag; returns the exit code."""
    from dscp_ros.bag.info import bag_info, info_lines
    from dscp_ros.bag.reader import BagReader

    with BagReader(args.bag) as reader:
        _print(args.json, bag_info(reader), info_lines(reader))
    return ExitCode.OK


def run_check(args: argparse.Namespace) -> int:
    """Checks a bag; returns 0 if it is good and 2 if it is damaged."""
    from dscp_ros.bag.reader import BagReader

    with BagReader(args.bag) as reader:
        report = reader.verify()
    lines = [f"{args.bag}: {report.messages_read} readable messages", *report.lines()]
    _print(args.json, {"path": str(args.bag), **report.to_dict()}, lines)
    return ExitCode.OK if report.intact else ExitCode.BAD_INPUT


def run_recover(args: argparse.Namespace) -> int:
    """Writes a good bag from a damaged one; returns the exit code."""
    from dscp_ros.bag.salvage import recover_bag

    report = recover_bag(
        args.bag, args.output, overwrite=args.overwrite, compression=args.compression
    )
    content = {"path": str(args.bag), "output": str(args.output), **report.to_dict()}
    lines = [f"{args.output}: {report.messages_read} messages saved", *report.lines()]
    _print(args.json, content, lines)
    return ExitCode.OK


def run_record(args: argparse.Namespace) -> int:
    """Records topics until SIGINT or SIGTERM; returns the exit code."""
    from dscp_ros.record import record

    counts = record(
        args.output, args.topics, overwrite=args.overwrite, compression=args.compression
    )
    total = sum(counts.values())
    lines = [f"{args.output}: {total} messages recorded"]
    lines.extend(f"  {topic}: {count}" for topic, count in counts.items())
    content = {"output": str(args.output), "message_count": total, "recorded": counts}
    _print(args.json, content, lines)
    return ExitCode.OK


def _print(as_json: bool, content: object, lines: list[str]) -> None:
    if as_json:
        print_document(content)
    else:
        print("\n".join(lines))

"""Options that several commands share, each declared once."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_json(parser: argparse.ArgumentParser, what: str = "result") -> None:
    """Declares ``--json``."""
    parser.add_argument("--json", action="store_true", help=f"print the {what} as JSON on stdout")


def add_computing(parser: argparse.ArgumentParser, count: str = "--workers") -> None:
    """Declares where a command computes: on how many processors, or on a cluster."""
    parser.add_argument(
        count, type=int, metavar="N", help="how many at once (default: one per processor)"
    )
    parser.add_argument(
        "--ray", metavar="ADDRESS", help="compute on the Ray cluster with this head, HOST:PORT"
    )


def add_folder(parser: argparse.ArgumentParser, default: str) -> None:
    """Declares the folder that files go to."""
    parser.add_argument(
        "--output",
        type=Path,
        default=Path(default),
        metavar="DIR",
        help="where the files go (default %(default)s)",
    )


def add_values(group: argparse._ArgumentGroup) -> None:
    """Declares how parameters get other values."""
    group.add_argument(
        "--set",
        action="append",
        default=[],
        dest="assignments",
        metavar="NAME=VALUE",
        help="set a parameter in SI units, a vector as a,b,c; may be repeated",
    )
    group.add_argument(
        "--vehicle",
        type=Path,
        metavar="FILE",
        help="YAML file of parameter names and SI values; --set wins over it",
    )

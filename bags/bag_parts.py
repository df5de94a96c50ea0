"""Parts that several sample bags are made of."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from sensor_msgs.msg import JointState

from dscp_core.planning.plan import PlanStatus
from dscp_ros.bag import Qos
from msg_adapters.errors import InputCode

VEHICLE_STATE_TOPIC = "/planner/vehicle_state"
STORY_TOPIC = "/story"
RELIABLE = Qos(depth=10, reliability="reliable", durability="volatile")

Spoil = Callable[[JointState], None]


@dataclass(frozen=True)
class Fault:
    """What is wrong with a state on purpose.

    Attributes:
        text: In words.
        expected: Code by which the planner refuses the state or reports its attempt.
        spoil: Changes the good state's message.
    """

    text: str
    expected: InputCode | PlanStatus
    spoil: Spoil

    @property
    def announcement(self) -> str:
        """What is wrong and what is expected of the planner, for the story."""
        return f"{self.text}, expected {self.expected.name} ({self.expected:d})"


def set_value(name: str, value: float) -> Spoil:
    """Spoils one named value."""

    def spoil(message: JointState) -> None:
        message.position[message.name.index(name)] = value

    return spoil


def shuffle_names(message: JointState, random: np.random.Generator) -> None:
    """Brings the named values into random order."""
    order = random.permutation(len(message.name))
    message.name = [message.name[k] for k in order]
    message.position = [message.position[k] for k in order]


def write_bags(description: str, write: Callable[[Path], Iterable[Path]]) -> None:
    """Command line of a script that writes bags into a folder and says how big they are.

    Args:
        description: The script's documentation; its first line is printed as help.
        write: Writes bags into a folder and returns them.
    """
    parser = argparse.ArgumentParser(description=description.splitlines()[0])
    parser.add_argument(
        "--output", type=Path, default=Path(__file__).parent, help="folder (default: this one)"
    )
    for bag in write(parser.parse_args().output):
        size = sum(file.stat().st_size for file in bag.iterdir())
        print(f"{bag}: {size / 1024:.0f} KiB")

"""What the demonstration shows of each problem."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from dscp_core.errors import InvalidInputError
from dscp_core.problems.entry.definition import NAME as ENTRY
from dscp_core.problems.entry.messages import PLANET_FRAME
from dscp_core.problems.powered_descent.definition import NAME as POWERED_DESCENT
from dscp_core.problems.powered_descent.messages import LANDING_FRAME

_FOLDERS = (Path(__file__).parents[2], Path(sys.prefix) / "share" / "dscp_ros")
"""Where bags/ and config/ are: beside the packages in a checkout, or where they are installed."""


@dataclass(frozen=True)
class DemoCase:
    """One problem's part of the demonstration.

    Attributes:
        problem: Its name.
        frame: Frame of its plans.
        sample_bags: In the order of their recorded time, so that the clock moves forward.
        rate: Recorded seconds per second.
        parameter_file: Of the node, or None for its defaults.
        picture: Name of the figure's file.
        start_text: Says where a plan starts, from the state in its report.
    """

    problem: str
    frame: str
    sample_bags: tuple[str, ...]
    rate: float
    parameter_file: str | None
    picture: str
    start_text: Callable[[Mapping[str, float]], str]

    def bags(self) -> list[Path]:
        """The sample bags.

        Raises:
            InvalidInputError: They are not there.
        """
        return [shared(f"bags/{name}", "--bag") for name in self.sample_bags]

    def node_arguments(self) -> list[str]:
        """Command line of the planner node for this problem.

        Raises:
            InvalidInputError: The parameter file is not there.
        """
        if self.parameter_file is None:
            return []
        return ["--params-file", str(shared(self.parameter_file, "--problem"))]


def shared(name: str, option: str) -> Path:
    """A file or folder that comes with the packages.

    Raises:
        InvalidInputError: It is in none of the places.
    """
    for folder in _FOLDERS:
        if (folder / name).exists():
            return folder / name
    places = " or ".join(str(folder) for folder in _FOLDERS)
    raise InvalidInputError(option, None, f"{name} in {places}")


def _landing_start(state: Mapping[str, float]) -> str:
    return (
        f"{state['z']:.0f} m up, {math.hypot(state['x'], state['y']):.0f} m aside, "
        f"at {math.hypot(state['vx'], state['vy'], state['vz']):.0f} m/s"
    )


def _entry_start(state: Mapping[str, float]) -> str:
    longitude, latitude = (math.degrees(state[name]) for name in ("longitude", "latitude"))
    return (
        f"{state['r'] / 1e3:.1f} km from the planet's centre, longitude {longitude:.2f} and "
        f"latitude {latitude:.2f} deg, at {state['speed']:.0f} m/s"
    )


CASES = {
    case.problem: case
    for case in (
        DemoCase(
            problem=POWERED_DESCENT,
            frame=LANDING_FRAME,
            sample_bags=("powered_descent_dispersed", "powered_descent_nominal"),
            rate=2.0,
            parameter_file=None,
            picture="landing.png",
            start_text=_landing_start,
        ),
        DemoCase(
            problem=ENTRY,
            frame=PLANET_FRAME,
            sample_bags=("entry_dispersed", "entry_nominal"),
            rate=100.0,
            parameter_file="config/entry.yaml",
            picture="entry.png",
            start_text=_entry_start,
        ),
    )
}

# Of the loop of log, tuning and reload: the log and the unseen one, the vehicle, the replay's rate,
# the tuning's epochs.
LOOP_BAGS = ("ignitions_log", "ignitions_unseen")
LOOP_VEHICLE = "config/aged_engine.yaml"
LOOP_RATE = 1.0
LOOP_EPOCHS = 6

CAMPAIGN_FLIGHTS = 20
"""Less than a minute on two cores."""

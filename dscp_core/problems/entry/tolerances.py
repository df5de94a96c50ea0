"""What a certificate of hypersonic entry accepts, as parameters of the mission."""

from __future__ import annotations

import math

from dscp_core.problem.parameters import Parameter


def _accepted(name: str, default: float, unit: str, what: str, upper: float) -> Parameter:
    return Parameter(
        name, default, unit, what, lower=0.0, upper=upper, source="chosen", fixes_optimum=False
    )


TOLERANCES: tuple[Parameter, ...] = (
    _accepted(
        "final_position_tolerance",
        2000.0,
        "m",
        "Greatest distance from the target, altitude included.",
        1e6,
    ),
    _accepted("final_altitude_tolerance", 100.0, "m", "Greatest error of the final altitude.", 1e5),
    _accepted(
        "final_speed_tolerance",
        10.0,
        "m/s",
        "Greatest part of the final velocity across the wanted direction; the speed is free.",
        1e3,
    ),
    _accepted(
        "final_flight_path_angle_tolerance",
        math.radians(0.5),
        "rad",
        "Greatest error of the final flight-path angle.",
        0.5,
    ),
    _accepted(
        "final_heading_tolerance",
        math.radians(0.5),
        "rad",
        "Greatest error of the final heading.",
        0.5,
    ),
    _accepted(
        "path_tolerance",
        5e-3,
        "1",
        "By which share dynamic pressure, heat rate and load factor may exceed their limits, as "
        "the flight curves between the nodes.",
        0.1,
    ),
    _accepted(
        "angle_tolerance",
        math.radians(0.5),
        "rad",
        "How far angle of attack and bank may be out of their bounds, as at a start that is "
        "measured with noise.",
        0.1,
    ),
)

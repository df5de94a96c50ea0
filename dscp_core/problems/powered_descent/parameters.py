"""Parameters of powered descent guidance, with unit, bounds and source."""

from __future__ import annotations

import math

from dscp_core.problem.declaration import TERMINAL_TIME
from dscp_core.problem.parameters import Parameter

PAPER = "Table 1 of the paper"

THRUST_PROX = "thrust_prox"
TILT_UPPER_RAD = 1.55
"""Near the horizontal, where a cone about the vertical ends."""


def _accepted(
    name: str, default: float, unit: str, what: str, upper: float, source: str = "chosen"
) -> Parameter:
    """Something that a certificate accepts; no optimum depends on it."""
    return Parameter(
        name, default, unit, what, lower=0.0, upper=upper, source=source, fixes_optimum=False
    )


_CERTIFICATE: tuple[Parameter, ...] = (
    _accepted(
        "contact_position_max",
        1.0,
        "m",
        "Greatest distance from the target where a plan ends: at contact, or at the gate.",
        1e4,
        "what landing sites are surveyed to",
    ),
    _accepted(
        "contact_speed_max",
        0.5,
        "m/s",
        "Greatest difference from final_velocity there.",
        100.0,
    ),
    _accepted(
        "contact_lateral_speed_max",
        0.5,
        "m/s",
        "Greatest lateral difference from final_velocity at contact.",
        100.0,
    ),
    Parameter(
        "contact_tilt_max",
        math.radians(30.0),
        "rad",
        "Greatest angle between thrust and vertical in the last interval, and so at contact, where "
        "it is less than pointing_angle_max. A vehicle file that does not give it has none.",
        lower=1e-3,
        upper=TILT_UPPER_RAD,
        source="the paper's pointing limit",
    ),
    _accepted(
        "altitude_floor_tolerance",
        0.02,
        "m",
        "How far a flight may be below final_position before contact, such as at a start that is "
        "measured with noise.",
        0.5,
    ),
    _accepted(
        "glideslope_tolerance",
        1.0,
        "m",
        "How far a flight may be outside the glideslope's cone, as it bulges between the nodes.",
        1e3,
    ),
    _accepted(
        "thrust_tolerance",
        1e-3,
        "1",
        "How far a flight may pass a limit of the thrust: as a share of thrust_max for its size, "
        "change and distance to the pointing cone, of contact_tilt_max for its angle.",
        0.1,
    ),
)

PARAMETERS: tuple[Parameter, ...] = (
    Parameter(
        TERMINAL_TIME,
        32.81,
        "s",
        "Flight time; the first guess when the terminal time is free.",
        lower=1.0,
        upper=600.0,
        source="section 4.1.2, optimum of the paper's case",
    ),
    Parameter(
        "terminal_time_min",
        1.0,
        "s",
        "Least terminal time when it is free.",
        lower=1e-3,
        upper=600.0,
        source="chosen",
        fixes_optimum=False,
    ),
    Parameter(
        "terminal_time_max",
        200.0,
        "s",
        "Greatest terminal time when it is free.",
        lower=1e-3,
        upper=600.0,
        source="chosen",
        fixes_optimum=False,
    ),
    Parameter(
        "initial_position",
        (5000.0, 500.0, 500.0),
        "m",
        "Position at the start, x up.",
        lower=-1e6,
        upper=1e6,
        source="section 4.1.2",
    ),
    Parameter(
        "initial_velocity",
        (-150.0, 30.0, -30.0),
        "m/s",
        "Velocity at the start, x up.",
        lower=-1e4,
        upper=1e4,
        source="section 4.1.2",
    ),
    Parameter(
        "initial_mass",
        38000.0,
        "kg",
        "Mass at the start.",
        lower=1.0,
        upper=1e7,
        source=PAPER,
    ),
    Parameter(
        "final_position",
        (0.0, 0.0, 0.0),
        "m",
        "Position at touchdown, x up.",
        lower=-1e6,
        upper=1e6,
        source="inferred: reproduces the paper's optimum",
    ),
    Parameter(
        "final_velocity",
        (0.0, 0.0, 0.0),
        "m/s",
        "Velocity at touchdown, x up.",
        lower=-1e4,
        upper=1e4,
        source="inferred: reproduces the paper's optimum",
    ),
    Parameter(
        "gate_height",
        0.0,
        "m",
        "Height above final_position at which a plan ends, with final_velocity; 0: it ends in "
        "contact with the ground there.",
        lower=0.0,
        upper=1e4,
        source="chosen",
    ),
    Parameter(
        "thrust_min",
        169.0e3,
        "N",
        "Least thrust of the lit engine.",
        lower=1.0,
        upper=1e9,
        source=PAPER,
    ),
    Parameter("thrust_max", 845.2e3, "N", "Greatest thrust.", lower=1.0, upper=1e9, source=PAPER),
    Parameter(
        "thrust_rate_max",
        math.inf,
        "N/s",
        "Greatest change of the thrust vector per time; infinite: no limit. Needs controls that "
        "are held linearly.",
        lower=1.0,
        source="not in the paper",
        infinite=True,
    ),
    Parameter(
        "dry_mass",
        22200.0,
        "kg",
        "Mass without usable propellant, below which no plan may burn; 0: unknown, not checked. A "
        "vehicle file that does not give it leaves it unknown.",
        lower=0.0,
        upper=1e7,
        source="chosen: published for the first stage of a launcher of this size",
    ),
    Parameter(
        "specific_impulse",
        282.0,
        "s",
        "Specific impulse.",
        lower=1.0,
        upper=1e4,
        source=PAPER,
    ),
    Parameter(
        "pointing_angle_max",
        math.radians(30.0),
        "rad",
        "Greatest angle between thrust and vertical (eta_max).",
        lower=1e-3,
        upper=TILT_UPPER_RAD,
        source=PAPER,
    ),
    Parameter(
        "glideslope_angle_max",
        math.radians(80.0),
        "rad",
        "Greatest angle between the line of sight from the landing point and the vertical "
        "(beta_max).",
        lower=1e-3,
        upper=1.57,
        source=PAPER,
    ),
    Parameter(
        "gravity",
        9.80655,
        "m/s^2",
        "Gravitational acceleration, downwards.",
        lower=0.0,
        upper=100.0,
        source=PAPER,
    ),
    Parameter(
        "standard_gravity",
        9.80655,
        "m/s^2",
        "Gravity in the definition of the specific impulse.",
        lower=1.0,
        upper=100.0,
        source=PAPER,
    ),
    Parameter(
        "fuel_weight",
        1.0,
        "1",
        "Weight of the final mass in the cost, which is -fuel_weight m(t_f) + time_weight t_f.",
        lower=0.0,
        source="section 4.1.1",
    ),
    Parameter(
        "time_weight",
        0.0,
        "kg/s",
        "Weight of the terminal time in the cost; matters where the terminal time is free.",
        lower=0.0,
        source="chosen",
    ),
    Parameter(
        "mean_thrust_fraction",
        0.999,
        "1",
        "Least thrust of an interval's mean as a fraction of thrust_min. At 1 the bounds at nodes "
        "and means nearly coincide along an arc of least thrust, and gradients lose their active "
        "set.",
        lower=0.0,
        upper=1.0,
        source="chosen: costs at most 0.4 kg against 1, and no accuracy of gradients",
        fixes_optimum=False,
    ),
    Parameter(
        THRUST_PROX,
        1e-8,
        "1",
        "Proximal weight on the scaled nodal thrust; it vanishes at convergence and fixes the "
        "nodal alternation that the midpoint rule does not see.",
        lower=0.0,
        source="chosen",
        fixes_optimum=False,
    ),
    *_CERTIFICATE,
)

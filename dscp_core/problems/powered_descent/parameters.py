"""Parameters of powered descent guidance, with unit, bounds and source."""

from __future__ import annotations

import math

from dscp_core.problem.declaration import TERMINAL_TIME
from dscp_core.problem.parameters import Parameter

PAPER = "Table 1 of the paper"

THRUST_PROX = "thrust_prox"

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
        upper=1.55,
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
)

"""Parameters of hypersonic entry, with unit, bounds and source."""

from __future__ import annotations

import math

from dscp_core.problem.declaration import TERMINAL_TIME
from dscp_core.problem.parameters import Parameter
from dscp_core.problems.entry.tolerances import TOLERANCES

TABLE = "Table 2 of the paper"
TEXT = "section 4.2.1 of the paper"
APPENDIX = "entry appendix of the paper"
INFERRED = "inferred: reproduces the paper's figures"

_SHALLOW = 1.2  # rad; beyond, cos(gamma) and cos(latitude) are too near to the poles of the model
_TURN = 2.0 * math.pi


def _degrees(value: float) -> float:
    return math.radians(value)


def _bounds(
    name: str, what: str, symbol: str, low: float, high: float, unit: str, reach: float
) -> tuple[Parameter, Parameter]:
    """Least and greatest value of an angle or rate, both given in degrees."""
    return (
        Parameter(
            f"{name}_min",
            _degrees(low),
            unit,
            f"Least {what} ({symbol}_min).",
            lower=-reach,
            upper=reach,
            source=TABLE,
        ),
        Parameter(
            f"{name}_max",
            _degrees(high),
            unit,
            f"Greatest {what} ({symbol}_max).",
            lower=-reach,
            upper=reach,
            source=TABLE,
        ),
    )


_TIMES: tuple[Parameter, ...] = (
    Parameter(
        TERMINAL_TIME,
        2500.0,
        "s",
        "Flight time of the initial reference (t_f0), and so the first guess of the free one.",
        lower=1.0,
        upper=1e4,
        source=APPENDIX,
    ),
    Parameter(
        "terminal_time_min",
        1800.0,
        "s",
        "Least flight time.",
        lower=1.0,
        upper=1e4,
        source=TABLE,
        fixes_optimum=False,
    ),
    Parameter(
        "terminal_time_max",
        3000.0,
        "s",
        "Greatest flight time.",
        lower=1.0,
        upper=1e4,
        source=f"{TABLE}, where the row is named t_f,min again",
        fixes_optimum=False,
    ),
)

_ENDS: tuple[Parameter, ...] = (
    Parameter(
        "initial_radius",
        6449.1e3,
        "m",
        "Distance from the planet's centre at the start.",
        lower=1e5,
        upper=1e9,
        source=TABLE,
    ),
    Parameter(
        "initial_longitude",
        0.0,
        "rad",
        "Longitude at the start, eastwards.",
        lower=-_TURN,
        upper=_TURN,
        source=TABLE,
    ),
    Parameter(
        "initial_latitude",
        0.0,
        "rad",
        "Latitude at the start.",
        lower=-_SHALLOW,
        upper=_SHALLOW,
        source=TABLE,
    ),
    Parameter(
        "initial_speed",
        6700.0,
        "m/s",
        "Speed against the rotating planet at the start.",
        lower=100.0,
        upper=2e4,
        source=TABLE,
    ),
    Parameter(
        "initial_flight_path_angle",
        0.0,
        "rad",
        "Flight-path angle at the start, upwards.",
        lower=-_SHALLOW,
        upper=_SHALLOW,
        source=TABLE,
    ),
    Parameter(
        "initial_heading",
        _degrees(90.0),
        "rad",
        "Heading at the start, from north towards east.",
        lower=-_TURN,
        upper=_TURN,
        source=TABLE,
    ),
    Parameter(
        "initial_angle_of_attack",
        _degrees(30.0),
        "rad",
        "Angle of attack at the start.",
        lower=-1.5,
        upper=1.5,
        source=TABLE,
    ),
    Parameter(
        "initial_bank_angle",
        0.0,
        "rad",
        "Bank angle at the start; positive turns the heading clockwise.",
        lower=-math.pi,
        upper=math.pi,
        source=TABLE,
    ),
    Parameter(
        "final_radius",
        6401.1e3,
        "m",
        "Distance from the planet's centre at the end.",
        lower=1e5,
        upper=1e9,
        source=TABLE,
    ),
    Parameter(
        "final_longitude",
        _degrees(120.0),
        "rad",
        "Longitude at the end; the flight goes the short way round.",
        lower=-_TURN,
        upper=_TURN,
        source=TABLE,
    ),
    Parameter(
        "final_latitude",
        _degrees(12.0),
        "rad",
        "Latitude at the end.",
        lower=-_SHALLOW,
        upper=_SHALLOW,
        source=TABLE,
    ),
    Parameter(
        "final_flight_path_angle",
        0.0,
        "rad",
        "Flight-path angle at the end.",
        lower=-_SHALLOW,
        upper=_SHALLOW,
        source=TABLE,
    ),
    Parameter(
        "final_heading",
        _degrees(90.0),
        "rad",
        "Heading at the end; the vehicle turns the short way round.",
        lower=-_TURN,
        upper=_TURN,
        source=TABLE,
    ),
    Parameter(
        "speed_min",
        1000.0,
        "m/s",
        "Least speed (V_f,min), at every node as in the appendix.",
        lower=1.0,
        upper=2e4,
        source=TABLE,
    ),
)

_LIMITS: tuple[Parameter, ...] = (
    *_bounds("angle_of_attack", "angle of attack", "alpha", 0.0, 40.0, "rad", 1.5),
    *_bounds("bank_angle", "bank angle", "sigma", -60.0, 60.0, "rad", math.pi),
    *_bounds("angle_of_attack_rate", "rate of the angle of attack", "u_1", -5.0, 5.0, "rad/s", 10),
    *_bounds("bank_rate", "rate of the bank angle", "u_2", -5.0, 5.0, "rad/s", 10),
    Parameter(
        "dynamic_pressure_max",
        1.1e5,
        "Pa",
        "Greatest dynamic pressure.",
        lower=1.0,
        upper=1e8,
        source=TEXT,
    ),
    Parameter(
        "heat_rate_max",
        2.5e6,
        "W/m^2",
        "Greatest heat rate.",
        lower=1.0,
        upper=1e10,
        source=TEXT,
    ),
    Parameter(
        "load_factor_max",
        2.0,
        "1",
        "Greatest aerodynamic load in units of standard gravity.",
        lower=1e-3,
        upper=1e3,
        source=TEXT,
    ),
)

_VEHICLE: tuple[Parameter, ...] = (
    Parameter("mass", 907.186, "kg", "Vehicle mass.", lower=1e-3, upper=1e7, source=TABLE),
    Parameter(
        "reference_area",
        0.48,
        "m^2",
        "Reference area of the coefficients.",
        lower=1e-6,
        upper=1e4,
        source=TEXT,
    ),
    Parameter(
        "surface_to_mass_ratio",
        1.0,
        "1",
        "Factor w_S/m on reference area over mass.",
        lower=0.1,
        upper=10.0,
        source="section 4.3 of the paper, nominal value",
    ),
    Parameter(
        "lift_coefficients",
        (2.497, 1.477, -0.03731),
        "1",
        "C_L11, C_L21, C_L22 of C_L = C_L11 a + C_L21 a^2 + C_L22 a Ma, a in rad.",
        lower=-1e3,
        upper=1e3,
        source=TABLE,
    ),
    Parameter(
        "drag_coefficients",
        (0.2298, -0.02432, 2.36, 0.0007079),
        "1",
        "C_D01, C_D11, C_D21, C_D22 of C_D = C_D01 + C_D11 Ma + C_D21 a^2 + C_D22 Ma^2, a in rad.",
        lower=-1e3,
        upper=1e3,
        source=TABLE,
    ),
    Parameter(
        "heat_rate_constant",
        9.437e-5,
        "kg^0.5 m^-1.65 s^0.15",
        "k_q of the heat rate k_q rho^0.5 V^3.15.",
        lower=0.0,
        upper=1.0,
        source=TEXT,
    ),
)

_PLANET: tuple[Parameter, ...] = (
    Parameter(
        "planet_radius",
        6371.1e3,
        "m",
        "Radius of the ground, where altitude is zero.",
        lower=1e5,
        upper=1e9,
        source=INFERRED,
    ),
    Parameter(
        "gravitational_parameter",
        3.986004418e14,
        "m^3/s^2",
        "Gravitational parameter; gravity is this over the squared radius.",
        lower=1e9,
        upper=1e20,
        source="WGS 84",
    ),
    Parameter(
        "rotation_rate",
        7.292115e-5,
        "rad/s",
        "Rotation rate of the planet (omega_E).",
        lower=-1e-2,
        upper=1e-2,
        source="WGS 84",
    ),
    Parameter(
        "sea_level_density",
        1.225,
        "kg/m^3",
        "Density at altitude zero (rho_0).",
        lower=1e-6,
        upper=1e3,
        source=INFERRED,
    ),
    Parameter(
        "scale_height",
        7920.0,
        "m",
        "Altitude over which the density falls by e (h_s).",
        lower=100.0,
        upper=1e6,
        source=INFERRED,
    ),
    Parameter(
        "speed_of_sound",
        320.0,
        "m/s",
        "Speed of sound of the Mach number in the coefficients.",
        lower=10.0,
        upper=1e4,
        source=INFERRED,
    ),
    Parameter(
        "standard_gravity",
        9.80665,
        "m/s^2",
        "Unit of the load factor (g_0).",
        lower=0.1,
        upper=100.0,
        source="conventional value",
    ),
)

_COST: tuple[Parameter, ...] = (
    Parameter(
        "flight_path_angle_weight",
        1.0,
        "1/s",
        "C_1 of the cost, the integral of C_1 gamma^2 + C_2 (u_1^2 + u_2^2).",
        lower=0.0,
        upper=1e9,
        source="section 4.2.2 of the paper",
    ),
    Parameter(
        "rate_weight",
        1.1,
        "s",
        "C_2 of the cost.",
        lower=0.0,
        upper=1e9,
        source="section 4.2.2 of the paper",
    ),
    Parameter(
        "guess_angle_of_attack",
        math.pi / 9.0,
        "rad",
        "Angle of attack that the initial reference ends with.",
        lower=-1.5,
        upper=1.5,
        source=APPENDIX,
    ),
)

PARAMETERS: tuple[Parameter, ...] = (
    *_TIMES,
    *_ENDS,
    *_LIMITS,
    *_VEHICLE,
    *_PLANET,
    *_COST,
    *TOLERANCES,
)

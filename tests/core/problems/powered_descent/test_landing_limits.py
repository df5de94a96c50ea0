"""Every bound of a landing: a plan just inside is certified, one just outside is not, by name."""

from __future__ import annotations

import itertools
import math
import re
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from oracles.landing_flight import land
from oracles.powered_descent_physics import DescentParameters, ThrustLaw
from oracles.random_landings import flown_backwards, random_landing

from dscp_core import problems
from dscp_core.errors import InvalidInputError
from dscp_core.planning.certificate import PlanCertificate, PlanVerifier
from dscp_core.planning.plan import PlanStatus
from dscp_core.planning.planner import Planner, PlannerSettings
from dscp_core.problem.flight import ControlHold

Array = NDArray[np.float64]

PROBLEM = problems.get("powered_descent")
INTERVALS = 10
TIMES = np.linspace(0.0, 12.0, INTERVALS + 1)
VEHICLE = DescentParameters(
    specific_impulse_s=300.0, gravity_m_s2=3.7, mass_flow_gravity_m_s2=9.80665
)
LAWS = {ControlHold.MEAN: ThrustLaw.INTERVAL_MEAN, ControlHold.LINEAR: ThrustLaw.LINEAR}
VERIFIERS = {hold: PlanVerifier(PROBLEM, INTERVALS, hold=hold) for hold in ControlHold}
MASS_KG = 2000.0
"""At contact."""
ROOM = 1e-5
"""How far inside or outside of a bound."""

LOOSE: dict[str, Any] = {
    "specific_impulse": 300.0,
    "gravity": 3.7,
    "standard_gravity": 9.80665,
    "thrust_min": 100.0,
    "thrust_max": 30e3,
    "pointing_angle_max": 1.0,
    "glideslope_angle_max": 1.5,
    "dry_mass": 1000.0,
    "contact_position_max": 10.0,
    "contact_speed_max": 5.0,
    "contact_lateral_speed_max": 5.0,
    "contact_tilt_max": 1.5,
}


def controls() -> Array:
    """Thrust that swings from side to side, and is back near the vertical at the end."""
    share = np.linspace(0.0, 1.0, INTERVALS + 1)
    size = MASS_KG * 3.7 * (1.1 + 0.6 * share)
    tilt = 0.4 * np.where(np.arange(INTERVALS + 1) % 2, -1.0, 1.0) * (1.0 - 0.8 * share)
    return np.column_stack([size * np.cos(tilt), size * np.sin(tilt), 0.1 * size])


def certificate(
    hold: ControlHold = ControlHold.LINEAR,
    contact: tuple[float, ...] = (0.0, 0.4, 0.3, -0.3, 0.06, 0.08),
    thrust: Array | None = None,
    **values: Any,
) -> PlanCertificate:
    """Of a flight that comes to this state at the plan's end, SI."""
    thrust = controls() if thrust is None else thrust
    end = np.array([*contact, MASS_KG])
    start = flown_backwards(TIMES, thrust, end, VEHICLE, LAWS[hold])
    states = np.tile(start, (INTERVALS + 1, 1))
    packed = PROBLEM.pack(LOOSE | values)
    return VERIFIERS[hold].certify(TIMES, states, thrust, packed)


def flown(hold: ControlHold) -> Array:
    """Thrust as flown, on a grid that no step of the certificate shares."""
    nodes = controls()
    share = np.linspace(0.0, 1.0, 20_011)[:, None]
    if hold is ControlHold.MEAN:
        return (nodes[1:] + nodes[:-1]) / 2
    return np.vstack([a + share * (b - a) for a, b in itertools.pairwise(nodes)])


def assert_on_the_edge(
    name: str, inside: float, outside: float, parameter: str, **others: Any
) -> None:
    """Certified with one value of a parameter, refused for ``name`` alone with the other."""
    good = certificate(**{**others, parameter: inside})
    assert good.passed, good.reasons
    bad = certificate(**{**others, parameter: outside})
    assert not bad.passed
    assert {reason.split()[0] for reason in bad.reasons} == {name}
    for certified in (good, bad):
        check = certified.check(name)
        # The room, and by how much a peak may be taken for higher than it is.
        assert abs(check.margin) <= 3e-3 * abs(check.bound) + 5 * ROOM * abs(outside)
        assert check.margin == check.bound - check.worst_value
        assert check.passed is (check.margin >= 0.0)


def edges(value: float, *, above: bool, room: float = ROOM) -> tuple[float, float]:
    """Values of a bound inside and outside of which something is that lies below (or above) it."""
    sign = 1.0 if above else -1.0
    return value * (1.0 + sign * room), value * (1.0 - sign * room)


@pytest.mark.parametrize("hold", ControlHold)
def test_the_loose_flight_is_certified(hold: ControlHold) -> None:
    good = certificate(hold)
    assert good.passed
    assert good.contact_time_s == pytest.approx(12.0, abs=1e-6)
    assert good.propellant_left_kg == pytest.approx(1000.0, abs=1e-6)
    assert set(good.unchecked) == {"thrust_rate_max"}


@pytest.mark.parametrize("hold", ControlHold)
def test_thrust_between_its_bounds(hold: ControlHold) -> None:
    size = np.linalg.norm(flown(hold), axis=1)
    newtons = 1e-3 * 30e3
    assert_on_the_edge(
        "thrust_min",
        *edges(size.min() + newtons, above=False),
        "thrust_min",
        hold=hold,
        mean_thrust_fraction=0.5,
    )
    assert_on_the_edge(
        "thrust_max",
        *edges(size.max() / (1.0 + 1e-3), above=True),
        "thrust_max",
        hold=hold,
    )


def test_a_dip_of_the_thrust_that_no_node_shows() -> None:
    nodes = np.linalg.norm(controls(), axis=1)
    between = np.linalg.norm(flown(ControlHold.LINEAR), axis=1)
    least = nodes.min() - 40.0
    assert between.min() < least - 1e-3 * 30e3
    bad = certificate(thrust_min=least, mean_thrust_fraction=0.5)
    assert [reason.split()[0] for reason in bad.reasons] == ["thrust_min"]
    assert bad.value("thrust_min") == pytest.approx(least - between.min(), rel=1e-3)
    # Nor one that only looks at the fine grid's points.
    on_grid = np.linalg.norm(bad.controls[bad.times_s <= 12.0 - 1e-6], axis=1)
    assert bad.value("thrust_min") > least - on_grid.min()


def tilt_of(thrust: Array) -> Array:
    return np.arctan2(np.linalg.norm(thrust[:, 1:], axis=1), thrust[:, 0])


@pytest.mark.parametrize("hold", ControlHold)
def test_pointing(hold: ControlHold) -> None:
    thrust = flown(hold)
    size, tilt = np.linalg.norm(thrust, axis=1), tilt_of(thrust)

    def violation(angle: float) -> float:
        return float(np.max(size * np.sin(tilt - angle)))

    low, high = 0.1, 1.0  # the angle at which 30 N are violated
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if violation(middle) > 30.0 else (low, middle)
    assert_on_the_edge("pointing", *edges(low, above=True), "pointing_angle_max", hold=hold)


@pytest.mark.parametrize("hold", ControlHold)
def test_tilt_at_contact(hold: ControlHold) -> None:
    tilt = float(tilt_of(flown(hold))[-1])
    inside, outside = edges(tilt / (1.0 + 1e-3), above=True)
    # Not tighter than the pointing limit: then the cone, in N, is not imposed as well.
    for value, passes in ((inside, True), (outside, False)):
        found = certificate(hold, contact_tilt_max=value, pointing_angle_max=1.0)
        names = {reason.split()[0] for reason in found.reasons}
        assert ("contact_tilt" in names) is not passes
        assert found.value("contact_tilt") == pytest.approx(tilt, rel=1e-6)


@pytest.mark.parametrize("hold", ControlHold)
@pytest.mark.parametrize(
    ("name", "parameter", "value"),
    [
        ("miss_position", "contact_position_max", 0.5),
        ("contact_lateral_speed", "contact_lateral_speed_max", 0.1),
        ("miss_speed", "contact_speed_max", math.hypot(0.3, 0.1)),
    ],
)
def test_at_contact(hold: ControlHold, name: str, parameter: str, value: float) -> None:
    others = {"contact_lateral_speed_max": 0.2} if name != "contact_lateral_speed" else {}
    assert_on_the_edge(name, *edges(value, above=True), parameter, hold=hold, **others)


def test_vertical_speed_at_contact_is_the_planned_speeds_error() -> None:
    assert certificate().value("contact_vertical_speed") == pytest.approx(0.3, rel=1e-5)
    planned = certificate(final_velocity=[-0.2, 0.0, 0.0])
    assert planned.value("contact_vertical_speed") == pytest.approx(0.1, rel=1e-5)
    fast = certificate(contact_speed_max=0.29, contact_lateral_speed_max=0.2)
    assert {r.split()[0] for r in fast.reasons} == {"miss_speed", "contact_vertical_speed"}


@pytest.mark.parametrize("hold", ControlHold)
@pytest.mark.parametrize("height", [1e-4, 1e-2])
def test_an_end_above_the_ground_costs_its_fall(hold: ControlHold, height: float) -> None:
    still = certificate(hold, (height, 0.0, 0.0, 0.0, 0.0, 0.0))
    assert still.value("miss_speed") == pytest.approx(math.sqrt(2 * 3.7 * height), rel=1e-3)
    assert still.contact_time_s == pytest.approx(12.0 + math.sqrt(2 * height / 3.7), abs=1e-4)
    assert still.value("altitude_floor") == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("hold", ControlHold)
def test_an_end_below_the_ground_is_contact_before(hold: ControlHold) -> None:
    deep = certificate(hold, (-0.05, 0.0, 0.0, 0.0, 0.0, 0.0))
    assert deep.contact_time_s is not None
    assert deep.contact_time_s < 12.0
    last = np.linalg.norm(flown(hold)[-1:] / MASS_KG - [3.7, 0.0, 0.0])
    assert deep.value("miss_speed") == pytest.approx(math.sqrt(2 * last * 0.05), rel=0.1)


@pytest.mark.parametrize("hold", ControlHold)
def test_dry_mass(hold: ControlHold) -> None:
    dry = MASS_KG / (1.0 - 1e-6)
    inside, outside = dry * (1.0 - 1e-7), dry * (1.0 + 1e-7)
    assert certificate(hold, dry_mass=inside).passed
    bad = certificate(hold, dry_mass=outside)
    assert [reason.split()[0] for reason in bad.reasons] == ["dry_mass"]
    unknown = certificate(hold, dry_mass=0.0)
    assert unknown.passed
    assert "dry_mass" in unknown.unchecked
    assert unknown.propellant_left_kg is None
    assert unknown.mass_used_kg == pytest.approx(bad.mass_used_kg)


def test_thrust_rate() -> None:
    change = np.linalg.norm(np.diff(controls(), axis=0), axis=1).max()
    # 30 N of the change over an interval are accepted.
    rate = float(change - 30.0) / 1.2
    assert_on_the_edge("thrust_rate_max", *edges(rate, above=True), "thrust_rate_max")
    with pytest.raises(InvalidInputError, match="hold: got 'mean', expected linear"):
        certificate(ControlHold.MEAN, thrust_rate_max=rate)


@pytest.mark.parametrize("hold", ControlHold)
def test_glideslope(hold: ControlHold) -> None:
    thrust = controls()
    aside = (0.0, 0.0, 0.0, -0.1, 4.6, 0.0)  # comes from the side, low
    start = flown_backwards(TIMES, thrust, np.array([*aside, MASS_KG]), VEHICLE, LAWS[hold])
    values = PROBLEM.table.unpack(PROBLEM.pack(LOOSE))
    outcome = land(TIMES, thrust, start, values | {"glideslope_angle_max": 1.0}, LAWS[hold])
    metres = outcome.excess["glideslope"]  # a metre is accepted
    assert metres > 1.0
    assert_on_the_edge(
        "glideslope",
        # The independent flight's dense output may just miss the peak.
        *edges(metres, above=True, room=5e-4),
        "glideslope_tolerance",
        hold=hold,
        contact=aside,
        glideslope_angle_max=1.0,
    )


@pytest.mark.parametrize(("below", "passes"), [(0.0199, True), (0.0201, False)])
def test_altitude_floor(below: float, passes: bool) -> None:
    # A hop from a pad that is measured too low.
    contact = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, MASS_KG])
    thrust = np.zeros((INTERVALS + 1, 3))
    thrust[:, 0] = MASS_KG * 3.7 * np.interp(TIMES, [0, 3, 9, 12], [1.3, 0.7, 0.7, 1.3])
    start = flown_backwards(TIMES, thrust, contact, VEHICLE, ThrustLaw.LINEAR)
    start[0] = -below
    packed = PROBLEM.pack(LOOSE | {"altitude_floor_tolerance": 0.02})
    states = np.tile(start, (INTERVALS + 1, 1))
    found = VERIFIERS[ControlHold.LINEAR].certify(TIMES, states, thrust, packed)
    check = found.check("altitude_floor")
    assert (check.worst_value, check.time_s) == (pytest.approx(below), 0.0)
    assert check.passed is passes
    assert any(reason.startswith("altitude_floor") for reason in found.reasons) is not passes


@pytest.mark.parametrize("hold", ControlHold)
def test_a_gate_above_the_pad(hold: ControlHold) -> None:
    at_gate = (6.0, 0.4, 0.3, -6.86 + 0.3, 0.06, 0.08)
    values = {"gate_height": 6.0, "final_velocity": [-6.86, 0.0, 0.0]}
    good = certificate(hold, at_gate, **values)
    assert good.passed
    assert good.contact_time_s is None
    assert good.miss_position_m == pytest.approx(0.5, abs=1e-6)
    assert good.value("altitude_floor") == pytest.approx(-6.0, abs=1e-6)
    # The rest of what is limited at contact is not a plan's business.
    assert [c.name for c in good.checks if c.name.startswith("contact_")] == ["contact_pointing"]
    edge = certificate(hold, at_gate, **values, contact_position_max=0.49)
    assert [reason.split()[0] for reason in edge.reasons] == ["miss_position"]
    # The way to the gate leads through the ground.
    through = certificate(hold, (6.0, 0.0, 0.0, 6.5, 0.0, 0.0), **values)
    assert through.reasons[0].startswith("contact at ")
    assert through.reasons[0].endswith(" s, where none is meant to be")


@pytest.mark.parametrize("seed", range(60))
def test_random_landings_are_judged_as_an_independent_flight_judges_them(seed: int) -> None:
    one = random_landing(np.random.default_rng(seed), INTERVALS)
    hold = next(h for h, law in LAWS.items() if law is one.law)
    packed = PROBLEM.pack(one.values)
    found = VERIFIERS[hold].certify(one.times_s, one.states, one.controls, packed)
    values = PROBLEM.table.unpack(packed)
    landing = land(one.times_s, one.controls, one.states[0], values, one.law)
    nearest = max(landing.excess.values())
    if found.passed:
        assert landing.contact_s == pytest.approx(found.contact_time_s, abs=1e-6)
        assert nearest <= 1.0 + 1e-5
    elif landing.contact_s is not None:
        assert nearest >= 1.0 - 2e-3


REFUSED = [
    ({"thrust_min": 2e6}, "thrust_min: got 2000000.0, expected <= thrust_max, 845200"),
    (
        {"contact_lateral_speed_max": 0.6},
        "contact_lateral_speed_max: got 0.6, expected <= contact_speed_max, 0.5",
    ),
    (
        {"altitude_floor_tolerance": 0.2, "contact_position_max": 0.1},
        "altitude_floor_tolerance: got 0.2, expected <= contact_position_max, 0.1",
    ),
    ({"altitude_floor_tolerance": -0.01}, r"altitude_floor_tolerance: got -0.01, expected \[0, "),
    ({"gate_height": -1.0}, r"gate_height: got -1.0, expected \[0, "),
    ({"dry_mass": -1.0}, r"dry_mass: got -1.0, expected \[0, "),
    ({"contact_tilt_max": 0.0}, r"contact_tilt_max: got 0.0, expected \[0.001, "),
    ({"final_velocity": [0.1, 0.0, 0.0]}, r"final_velocity\[0\]: got 0.1, expected <= 0 m/s"),
    ({"thrust_rate_max": math.nan}, "thrust_rate_max: got nan"),
    ({"thrust_rate_max": 1e6}, "hold: got 'mean', expected linear where thrust_rate_max"),
]


@pytest.mark.parametrize(("values", "message"), REFUSED)
def test_values_that_contradict_each_other(values: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        Planner(PROBLEM, parameters=values, intervals=4)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"dry_mass": 38000.0}, "mass: got 38000.0, expected above dry_mass, 38000 kg"),
        ({"gate_height": 6000.0}, r"x: got 5000.0, expected >= 6000 m, 6000 m \(gate_height\)"),
        ({"final_position": [5001.0, 0.0, 0.0]}, "x: got 5000.0, expected >= 5001 m"),
    ],
)
def test_starts_of_no_plan(values: dict[str, Any], message: str) -> None:
    outcome = Planner(PROBLEM, parameters=values, intervals=4).plan()
    assert outcome.status is PlanStatus.INVALID_STATE
    assert re.match(message, outcome.message)


def test_a_vehicle_file_that_is_silent_about_the_dry_mass(tmp_path: Any) -> None:
    silent, said = tmp_path / "silent.yaml", tmp_path / "said.yaml"
    silent.write_text("thrust_max: 9.0e+5\n")
    said.write_text("dry_mass: 2.5e+4\ncontact_tilt_max: 0.1\n")
    unknown = {"dry_mass": 0.0, "contact_tilt_max": 1.55}
    assert PROBLEM.read_vehicle(silent) == {"thrust_max": 9.0e5, **unknown}
    assert PROBLEM.read_vehicle(said) == {"dry_mass": 2.5e4, "contact_tilt_max": 0.1}
    assert PROBLEM.table.unpack(PROBLEM.pack())["dry_mass"] == 22200.0
    # What is said elsewhere is not unsaid by a silent file.
    settings = PlannerSettings(parameters={"dry_mass": 2.4e4}, intervals=4)
    for file, mass in ((silent, 2.4e4), (said, 2.5e4)):
        planner = Planner(PROBLEM, settings, vehicle=file)
        assert PROBLEM.table.unpack(planner.parameters)["dry_mass"] == mass


def test_a_plan_that_burns_the_structure_is_not_certified() -> None:
    burning = Planner(PROBLEM, parameters={"specific_impulse": 60.0}).plan()
    assert not burning.certified
    light = {"specific_impulse": 60.0, "dry_mass": 0.0}
    unknown = Planner(PROBLEM, parameters=light).plan()
    assert unknown.certificate is not None
    assert unknown.certificate.propellant_left_kg is None
    assert unknown.certificate.mass_used_kg is not None
    assert unknown.certificate.mass_used_kg > 38000.0 - 22200.0

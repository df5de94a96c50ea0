"""The guidance that powered descent brings along for a node."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dscp_core import Planner, problems
from dscp_core.errors import InvalidInputError
from dscp_core.problems.powered_descent.guidance.landing import LandingGuidance
from dscp_core.problems.powered_descent.guidance.offered import LandingGuidances, NoLandingError
from dscp_core.problems.powered_descent.guidance.settings import GuidanceSettings

PROBLEM = problems.get("powered_descent")


@pytest.fixture(scope="module")
def planner() -> Planner:
    return Planner(PROBLEM, terminal_time="free")


def offered() -> LandingGuidances:
    found = PROBLEM.extras.guidance
    assert isinstance(found, LandingGuidances)
    return found


def test_settings_are_suited_where_none_are_chosen(planner: Planner) -> None:
    guidance = offered()(planner, planner.initial_state, {"replan_s": 2.0})
    assert isinstance(guidance, LandingGuidance)
    landing_kg = planner.plan().plan.states[-1, 6]
    values = PROBLEM.table.unpack(planner.parameters)
    suited = GuidanceSettings.suited(values, landing_kg, replan_s=2.0, known_delay_s=0.0)
    for name in ("gate_altitude_m", "profile_deceleration_m_s2", "tilt_per_altitude_rad_m"):
        assert getattr(guidance.settings, name) == pytest.approx(getattr(suited, name), rel=1e-6)
    assert guidance.settings.replan_s == 2.0
    assert guidance.waits
    assert not guidance.follows_plan
    defaults = {setting.name: setting.default for setting in offered().settings}
    assert math.isnan(defaults["gate_altitude_m"])
    assert defaults["replan_s"] == 1.0


def test_what_cannot_be_is_refused(planner: Planner) -> None:
    state = planner.initial_state
    with pytest.raises(InvalidInputError, match="known_delay_s"):  # stamps tell it
        offered()(planner, state, {"known_delay_s": 0.1})
    with pytest.raises(InvalidInputError, match="contact_margin_m"):
        offered()(planner, state, {"contact_margin_m": 50.0})
    heavy, low = state * ([1.0] * 6 + [2.4]), np.array([4.0, 0.0, 0.0, -1.0, 0.0, 0.0, 32000.0])
    with pytest.raises(InvalidInputError, match=r"thrust_max: .* the weight at the start"):
        offered()(planner, heavy, {})
    assert offered()(planner, low, {}).settings.gate_altitude_m == 2.0  # below where it is
    with pytest.raises(NoLandingError, match="no plan to the pad"):
        offered()(planner, np.array([300.0, 0.0, 0.0, -150.0, 0.0, 0.0, 38000.0]), {})

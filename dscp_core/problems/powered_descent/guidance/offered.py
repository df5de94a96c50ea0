"""The guidance as a node makes it: from what suits the vehicle, and a state to begin with."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

from dscp_core.errors import DscpError
from dscp_core.planning.planner import Planner
from dscp_core.problem.options import declared
from dscp_core.problem.parameters import Parameter, ParameterTable
from dscp_core.problems.powered_descent.guidance.landing import LandingGuidance
from dscp_core.problems.powered_descent.guidance.settings import GuidanceSettings
from dscp_core.problems.powered_descent.guidance.vehicle import Array, Vehicle

_TOLD_BY_STAMPS = "known_delay_s"


class NoLandingError(DscpError):
    """No plan leads from the first state to the pad."""


class LandingGuidances:
    """Makes the guidance of one landing after another."""

    @property
    def settings(self) -> tuple[Parameter, ...]:
        """See `Guided`. Stamps of states tell how old these are, not a setting."""
        return tuple(
            replace(p, default=math.nan) if p.name in GuidanceSettings.SUITED else p
            for p in declared(GuidanceSettings)
            if p.name != _TOLD_BY_STAMPS
        )

    def __call__(
        self, planner: Planner, state: Array, settings: Mapping[str, float]
    ) -> LandingGuidance:
        """See `Guided`.

        Raises:
            InvalidInputError: An unknown setting, a bad value, or thrust that does not carry the
                vehicle.
            NoLandingError: There is no plan from this state.
        """
        table = ParameterTable(self.settings)
        chosen = {table[name].name: value for name, value in settings.items()}
        nominal, values = planner.plan(state), planner.problem.table.unpack(planner.parameters)
        if nominal.plan is None or not (nominal.certified or nominal.converged):
            Vehicle.of(values).require_carries(float(state[6]), "at the start")
            raise NoLandingError(f"no plan to the pad: {nominal.message}")
        here = {**values, "initial_position": state[:3]}
        suited = GuidanceSettings.suited(
            here, float(nominal.plan.states[-1, 6]), **chosen, known_delay_s=0.0
        )
        return LandingGuidance(values, suited, planner.settings.hold)

"""What a problem may bring along beside its mathematics, from its own folder; all of it optional.

What a problem does not bring has a generic form: a figure of every state and control, a terminal
time that is free or given, named scalars in messages, no markers.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from dscp_core.problem import checks
from dscp_core.problem.guidance import Guided
from dscp_core.problem.messages import Messages
from dscp_core.problem.scene import SceneOf
from dscp_core.problem.simulation import Simulated
from dscp_core.problem.trajectory import Plan

if TYPE_CHECKING:
    from collections.abc import Mapping

    from matplotlib.figure import Figure


class PlanFigure(Protocol):
    """Draws a plan as it was made, and as it went when it was flown."""

    def __call__(
        self,
        plan: Plan,
        certificate: Any,
        parameters: Mapping[str, Any],
        title: str | None = None,
    ) -> Figure:
        """The figure.

        Args:
            plan: The plan.
            certificate: Its `PlanCertificate` of `dscp_core.planning.certificate`, with the flight.
            parameters: Vehicle and mission by name, SI, as `ParameterTable.unpack` gives them.
            title: Headline; None for one of its own.
        """
        ...


@dataclass(frozen=True)
class Extras:
    """What one problem brings.

    Attributes:
        figure: Its own figure of a plan.
        network: File of the terminal-time network of the default vehicle.
        messages: How states and plans are told of in messages.
        scene: Its plans in space; None for none.
        simulation: Its closed-loop flights; None for none.
        guidance: What guides its vehicle in a node; None for none.

    Example:
        >>> from dscp_core import problems
        >>> problems.get("powered_descent").extras.figure is None  # it brings its own
        False
        >>> from dscp_core import Extras
        >>> Extras().figure is None
        True
    """

    figure: PlanFigure | None = None
    network: Path | None = None
    messages: Messages = field(default_factory=Messages)
    scene: SceneOf | None = None
    simulation: Simulated | None = None
    guidance: Guided | None = None

    def __post_init__(self) -> None:
        for name in ("figure", "scene", "simulation", "guidance"):
            if getattr(self, name) is not None:
                checks.function(f"{name} of extras", getattr(self, name))
        checks.plain("extras", self, Messages=Messages)

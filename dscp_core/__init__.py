"""Differentiable sequential convex programming: certified plans and their gradients, no ROS.

What users write can be imported from here; it is loaded when it is first used, PyTorch only by
`Planner.layer` and the layers.

Example:
    >>> from dscp_core import Planner, problems
    >>> planner = Planner(problems.get("powered_descent"), parameters={"terminal_time": 33.0})
    >>> outcome = planner.plan()
    >>> outcome.headline
    'certified, converged: terminal time 33 s (fixed), cost -31759.15 kg,
    at most 0... kg to gain'
    >>> gradient = planner.gradient("cost", at=outcome)
    >>> round(gradient["specific_impulse"], 2), gradient.trusted
    (-19.78, True)
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dscp_core import problems
    from dscp_core.errors import DscpError, InvalidInputError
    from dscp_core.gradients.gradient import Gradient, Method
    from dscp_core.gradients.losses import ConvergenceLoss, CostLoss, FinalStateLoss
    from dscp_core.gradients.plan_layer import PlanLayer
    from dscp_core.gradients.run import DifferentiationError
    from dscp_core.gradients.torch_layer import DscpLossLayer, DscpTrajectoryLayer
    from dscp_core.planning.plan import BestEffort, PlanOutcome, PlanStatus, TerminalTime
    from dscp_core.planning.planner import Planner
    from dscp_core.planning.settings import PlannerSettings
    from dscp_core.problem.concessions import Concessions, Shortfall
    from dscp_core.problem.declaration import (
        ConeConstraint,
        CostTerm,
        EndEvent,
        EventLimit,
        InitialGuess,
        Miss,
        OptimalControlProblem,
        PathConstraint,
        Propellant,
        Quadrature,
        StagePoint,
        Variable,
        Where,
    )
    from dscp_core.problem.extras import Extras
    from dscp_core.problem.messages import Messages, Odometry
    from dscp_core.problem.parameters import Parameter
    from dscp_core.problem.scene import Arrows, Line, Scene, Sphere, Triangles
    from dscp_core.problem.trajectory import Plan
    from dscp_core.problems.loading import ProblemFamily
    from dscp_core.scp.scp import ScpOptions

_HOMES = {
    "errors": ("DscpError", "InvalidInputError"),
    "gradients.gradient": ("Gradient", "Method"),
    "gradients.losses": ("ConvergenceLoss", "CostLoss", "FinalStateLoss"),
    "gradients.plan_layer": ("PlanLayer",),
    "gradients.run": ("DifferentiationError",),
    "gradients.torch_layer": ("DscpLossLayer", "DscpTrajectoryLayer"),
    "planning.plan": ("BestEffort", "PlanOutcome", "PlanStatus", "TerminalTime"),
    "planning.planner": ("Planner",),
    "planning.settings": ("PlannerSettings",),
    "problem.concessions": ("Concessions", "Shortfall"),
    "problem.declaration": (
        "ConeConstraint",
        "CostTerm",
        "EndEvent",
        "EventLimit",
        "InitialGuess",
        "Miss",
        "OptimalControlProblem",
        "PathConstraint",
        "Propellant",
        "Quadrature",
        "StagePoint",
        "Variable",
        "Where",
    ),
    "problem.extras": ("Extras",),
    "problem.flight": ("ControlHold", "Discretisation"),
    "problem.messages": ("Messages", "Odometry"),
    "problem.parameters": ("Parameter",),
    "problem.scene": ("Arrows", "Line", "Scene", "Sphere", "Triangles"),
    "problem.trajectory": ("Plan",),
    "problems.loading": ("ProblemFamily",),
    "scp.scp": ("ScpOptions",),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = [
    "Arrows",
    "BestEffort",
    "Concessions",
    "ConeConstraint",
    "ControlHold",
    "ConvergenceLoss",
    "CostLoss",
    "CostTerm",
    "DifferentiationError",
    "Discretisation",
    "DscpError",
    "DscpLossLayer",
    "DscpTrajectoryLayer",
    "EndEvent",
    "EventLimit",
    "Extras",
    "FinalStateLoss",
    "Gradient",
    "InitialGuess",
    "InvalidInputError",
    "Line",
    "Messages",
    "Method",
    "Miss",
    "Odometry",
    "OptimalControlProblem",
    "Parameter",
    "PathConstraint",
    "Plan",
    "PlanLayer",
    "PlanOutcome",
    "PlanStatus",
    "Planner",
    "PlannerSettings",
    "ProblemFamily",
    "Propellant",
    "Quadrature",
    "Scene",
    "ScpOptions",
    "Shortfall",
    "Sphere",
    "StagePoint",
    "TerminalTime",
    "Triangles",
    "Variable",
    "Where",
    "problems",
]


def __getattr__(name: str) -> Any:
    if name in _HOME_OF:
        value = getattr(import_module(f"{__name__}.{_HOME_OF[name]}"), name)
    elif name == "problems":
        value = import_module(f"{__name__}.problems")
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})

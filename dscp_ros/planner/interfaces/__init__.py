"""What the node offers for one problem besides planning: frames, input limits, drawings."""

from dscp_core.errors import InvalidInputError
from dscp_ros.planner.interfaces.entry import ENTRY_INTERFACE
from dscp_ros.planner.interfaces.interface import VEHICLE_PREFIX, ProblemInterface
from dscp_ros.planner.interfaces.landing import LANDING_INTERFACE
from msg_adapters.frames import ENTRY, POWERED_DESCENT

__all__ = ["VEHICLE_PREFIX", "ProblemInterface", "interface_of"]

_INTERFACES = {POWERED_DESCENT: LANDING_INTERFACE, ENTRY: ENTRY_INTERFACE}


def interface_of(problem: str) -> ProblemInterface:
    """Interface of a problem by name.

    Raises:
        InvalidInputError: The node has no interface for it.
    """
    if problem not in _INTERFACES:
        raise InvalidInputError("problem", problem, f"one of {', '.join(_INTERFACES)}")
    return _INTERFACES[problem]

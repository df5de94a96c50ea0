"""Parameter sets: what a tuning found, as a directory that the planner node loads.

``parameters.yaml`` is a ROS 2 parameter file, ``terminal_time.safetensors`` the network if there is
one, ``provenance.json`` says where they come from and holds the checksums of all of it.
"""

from dscp_ros.parameter_set.errors import ParameterSetError
from dscp_ros.parameter_set.format import NETWORK_FILE, PARAMETERS_FILE, PROVENANCE_FILE
from dscp_ros.parameter_set.loading import ParameterSet, directory_of, lies_in_set, load
from dscp_ros.parameter_set.saving import check_target, save

__all__ = [
    "NETWORK_FILE",
    "PARAMETERS_FILE",
    "PROVENANCE_FILE",
    "ParameterSet",
    "ParameterSetError",
    "check_target",
    "directory_of",
    "lies_in_set",
    "load",
    "save",
]

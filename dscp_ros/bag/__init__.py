"""Writing, reading, checking and recovering ROS 2 bags in the MCAP format.

The modules need rclpy only where a message is serialised or decoded, so bags can be inspected,
checked and recovered without ROS.
"""

from dscp_ros.bag.errors import (
    BagDamagedError,
    BagError,
    BagExistsError,
    BagFormatError,
    BagNotFoundError,
    BagWriteError,
    MessageDecodeError,
    TopicNotFoundError,
    UnknownMessageTypeError,
)
from dscp_ros.bag.qos import Qos
from dscp_ros.bag.reader import BagReader
from dscp_ros.bag.recovery import Damage, DamageKind, RecoveryReport
from dscp_ros.bag.salvage import recover_bag
from dscp_ros.bag.topics import BagMessage, TopicInfo
from dscp_ros.bag.writer import BagWriter

__all__ = [
    "BagDamagedError",
    "BagError",
    "BagExistsError",
    "BagFormatError",
    "BagMessage",
    "BagNotFoundError",
    "BagReader",
    "BagWriteError",
    "BagWriter",
    "Damage",
    "DamageKind",
    "MessageDecodeError",
    "Qos",
    "RecoveryReport",
    "TopicInfo",
    "TopicNotFoundError",
    "UnknownMessageTypeError",
    "recover_bag",
]

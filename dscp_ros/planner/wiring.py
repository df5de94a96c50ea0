"""What nodes that take states have in common: the quality of their inputs, and a clock set back."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.clock import JumpHandle, JumpThreshold, TimeJump
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSProfile, QoSReliabilityPolicy

from dscp_ros.planner.parameters import RELIABLE


def input_quality(reliability: str, depth: int) -> QoSProfile:
    """Of a subscription, with the reliability that the parameter of this name asks for."""
    policy = (
        QoSReliabilityPolicy.RELIABLE
        if reliability == RELIABLE
        else QoSReliabilityPolicy.BEST_EFFORT
    )
    return QoSProfile(depth=depth, reliability=policy)


def on_clock_set_back(node: Node, call: Callable[[str], None]) -> JumpHandle:
    """Call with the cause when a node's clock was set back, as by a simulation or a bag's loop.

    Returns:
        The handle; until it is unregistered, calls come.
    """

    def jumped(jump: TimeJump) -> None:
        jump_s = jump.delta.nanoseconds / 1e9
        call(f"jumped by {jump_s:.3f} s" if jump_s else "changed its source")

    threshold = JumpThreshold(
        min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=True
    )
    return node.get_clock().create_jump_callback(threshold, post_callback=jumped)

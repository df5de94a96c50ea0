"""Replaying a bag on real ROS 2 topics with its own timing."""

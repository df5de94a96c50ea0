"""Closed-loop flights in ROS: their logs."""

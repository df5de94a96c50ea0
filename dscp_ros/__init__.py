"""The ROS 2 side of the project: planner node, bags, replay and the command line.

Importing this package imports no ROS module; its modules import ROS where they need it.
"""

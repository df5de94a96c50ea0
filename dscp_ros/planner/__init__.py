"""The planner node: ROS states in, certified trajectories out."""

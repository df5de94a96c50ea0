"""The guidance node: commands a vehicle along the plans of a planner node."""

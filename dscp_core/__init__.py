"""Differentiable sequential convex programming: numbers only, no ROS."""

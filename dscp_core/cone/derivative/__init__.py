"""The derivative of a cone program's solution, with a verdict on it."""

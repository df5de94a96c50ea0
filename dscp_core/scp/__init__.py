"""Sequential convex programming: the forward pass, its trace, its stopping rules."""

"""Published results, computed again: one module per study, and what they share."""

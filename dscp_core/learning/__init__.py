"""Learning the optimal terminal time of powered descent (section 4.1.3)."""

"""Independent truths, sharing no code with the packages that they test."""

"""Evaluating many independent items: here, in processes, or on a Ray cluster."""

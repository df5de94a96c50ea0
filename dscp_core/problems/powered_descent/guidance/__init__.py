"""Guidance of a landing: observer, plans to a gate, tracker, and a last stretch without a clock."""

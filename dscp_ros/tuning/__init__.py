"""From logs to what is tuned on, and from a tuning to a parameter set."""

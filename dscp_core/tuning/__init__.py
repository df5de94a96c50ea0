"""Offline tuner: parameters and networks from logged states, by gradients through the SCP."""

"""Gradients of a whole run: unrolled, implicit, forward, by differences; losses; PyTorch layers."""

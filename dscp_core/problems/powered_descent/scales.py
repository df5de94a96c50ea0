"""SI values of one scaled unit: the paper's case."""

from __future__ import annotations

LENGTH_M = 5000.0
SPEED_M_S = 150.0
MASS_KG = 38000.0
THRUST_N = MASS_KG * SPEED_M_S**2 / LENGTH_M

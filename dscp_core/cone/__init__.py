"""Cone programs: data, residuals, solvers, and the derivative of a solution."""

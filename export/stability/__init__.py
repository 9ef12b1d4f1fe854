"""Numerical stability of all computations: stiff and extreme cases, their errors, and the limits."""

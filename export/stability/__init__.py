"""Numerical stability of all that computes: stiff and extreme cases, how much is off, and where it ends."""

"""Corrections of the simulated pad by what the infinite layer leaves out."""

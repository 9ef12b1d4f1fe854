"""Baselines of free pads, and their drift."""

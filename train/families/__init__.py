"""Families of shapes that a gripper's pad presses on, each drawn at random."""

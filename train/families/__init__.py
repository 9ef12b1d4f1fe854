"""Families of shapes that a gripper's pad meets, each drawn at random."""

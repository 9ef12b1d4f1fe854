"""Poses of a pad in the object's plane, and their course over time."""

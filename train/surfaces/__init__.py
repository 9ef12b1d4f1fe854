"""Surfaces to tap, and the poses of the taps."""

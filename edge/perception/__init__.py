"""Scans to taps, taps to patterns: all that is computed, without I/O."""

"""Scans to taps and taps to patterns: the computation, without I/O."""

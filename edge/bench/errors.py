"""Errors of the bench."""

from edge.errors import EdgeError


class BenchError(EdgeError, RuntimeError):
    """Error of a measurement that could not be made, or of an earlier bench that cannot be used."""

"""Errors of the bench."""

from edge.errors import EdgeError


class BenchError(EdgeError, RuntimeError):
    """A measurement that could not be made, or one of an earlier bench that cannot be used."""

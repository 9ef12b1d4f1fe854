"""Recordings, read from disk."""

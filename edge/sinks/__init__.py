"""Sinks of records, one file each."""

"""Frames to taxel readings, readings to scans. No I/O, no clock."""

"""Stages from frames to taxel readings, and from readings to scans. No I/O, no clock."""

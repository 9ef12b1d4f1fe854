"""Emulated controllers and servers, with faults."""

"""Protocols of the CAN adapters, and the errors on the bus. No I/O."""

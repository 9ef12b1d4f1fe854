"""The sensor file."""

"""The command line `edge-sr`."""

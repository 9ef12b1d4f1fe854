"""The shipped models and the simulated sensor, held against other pads and real recordings."""

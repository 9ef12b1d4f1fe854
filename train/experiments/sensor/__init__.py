"""The shipped models and the simulated sensor, evaluated on other pads and real recordings."""

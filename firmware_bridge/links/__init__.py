"""Links to sensors, one file each; the only I/O of the bridge."""

"""One file per link to a sensor; the only I/O of the bridge."""

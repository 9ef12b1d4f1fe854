"""Error against run time of every model and of methods without a network, and the cost of the whole program."""

"""Choice of the model that fits into a budget of run time."""

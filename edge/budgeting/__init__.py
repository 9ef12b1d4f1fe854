"""The model that fits into a budget of run time, and steps between models while running."""

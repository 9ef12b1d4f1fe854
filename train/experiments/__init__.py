"""The experiments: each one command that writes a table and a plot into reports/."""

"""The experiments: each one command that writes a page with tables into reports/."""

"""Datasets to learn from, and the batches drawn from them."""

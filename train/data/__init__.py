"""Datasets to train on, and the batches drawn from them."""

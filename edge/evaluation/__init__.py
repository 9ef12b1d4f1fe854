"""Evaluation: errors of patterns against their truth, and the methods that a model has to beat."""

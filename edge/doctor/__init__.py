"""Commissioning of a sensor: its health, its orientation, and the remedies."""

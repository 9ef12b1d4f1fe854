"""Surfaces to tap, and where they are tapped."""

"""Commissioning: is this sensor well, how does it sit, and what is to be done."""

"""Sensor file: its model, its reader and its writer."""

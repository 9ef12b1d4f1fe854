"""The simulated sensor, its truth, and the networks trained on both."""

from firmware_bridge.errors import need

need("train", "torch", "scipy", "trimesh", "shapely")

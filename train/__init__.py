"""The simulated sensor, its truth, and the networks trained on both. This package imports no ONNX."""

from firmware_bridge.extras import need

need("train", "torch", "scipy", "trimesh", "shapely", "joblib")

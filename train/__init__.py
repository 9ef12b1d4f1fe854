"""The simulated sensor, its truth, and the networks that learn from both. Knows no ONNX."""

from firmware_bridge.extras import need

need("train", "torch", "scipy", "trimesh", "shapely", "joblib", "magpylib")

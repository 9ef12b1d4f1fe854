"""The simulated sensor, its truth, and the networks that learn from both. Knows no ONNX."""

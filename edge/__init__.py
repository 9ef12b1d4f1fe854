"""The runtime: scans to taps, taps to patterns, with numpy and onnxruntime alone."""

"""Models: their contract, and how onnxruntime is kept to it."""

"""Models: their contract, and its enforcement on onnxruntime."""

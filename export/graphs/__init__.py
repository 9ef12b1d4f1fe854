"""ONNX graphs of networks: traced, compared with their networks, written with their contract."""

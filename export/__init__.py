"""Checkpoints to single-file ONNX models with a contract: the only place that knows torch and ONNX."""

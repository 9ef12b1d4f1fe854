"""Checkpoints to single-file ONNX models with a contract: the only package that imports both torch and ONNX."""

import edge  # noqa: F401  before onnxruntime, whose telemetry it switches off
from firmware_bridge.errors import need

need("export", "torch", "onnx", "onnxscript")

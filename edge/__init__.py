"""The runtime: scans to taps, taps to patterns, with numpy and onnxruntime alone."""

import os

# From 1.29 on onnxruntime sends telemetry from Linux, beginning with its import: an identifier and an upload queue in
# ~/.cache, two threads. Only then it asks for this variable. A robot's controller sends nothing unless its owner wants.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

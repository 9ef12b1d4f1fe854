"""The runtime: scans to taps, taps to patterns, with numpy and onnxruntime alone."""

import os

__version__ = "0.2.0"

# From 1.29 on onnxruntime sends telemetry from Linux as soon as it is imported: it keeps an identifier and an upload
# queue in ~/.cache and starts two threads. It reads this variable only then. A robot's controller sends nothing unless
# its owner wants it to.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

"""Machine that a bench ran on."""

import os
import platform
from pathlib import Path

import numpy as np
import onnxruntime

from edge.bench.processes import usable_cores


def this_machine() -> str:
    """Return what run times depend on: processor, cores and versions."""
    return (
        f"{_cpu()}, {platform.machine()}, {len(usable_cores())} of {os.cpu_count() or 1} cores, "
        f"Python {platform.python_version()}, numpy {np.__version__}, onnxruntime {onnxruntime.__version__}"
    )


def _cpu() -> str:
    """Return the model name of the processor; on ARM, where /proc/cpuinfo has none, the board's name."""
    for path, prefix in (("/proc/cpuinfo", "model name"), ("/proc/device-tree/model", "")):
        try:
            lines = Path(path).read_text(errors="replace").replace("\0", "").splitlines()
        except OSError:
            continue
        for line in lines:
            if line.startswith(prefix) and line:
                return line.partition(":")[2].strip() if prefix else line
    return platform.processor() or "unknown CPU"

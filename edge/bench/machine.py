"""Machine that a bench ran on."""

import os
import platform
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnxruntime

from edge.bench.processes import usable_cores


@dataclass(frozen=True, slots=True)
class Machine:
    """Facts on a machine that run times depend on.

    Attributes:
        cpu: model name.
        architecture: as the system calls it.
        cores: number of cores.
        usable_cores: number of cores that the bench may use.
        system: name and release.
        python: version.
        numpy: version.
        onnxruntime: version.
    """

    cpu: str
    architecture: str
    cores: int
    usable_cores: int
    system: str
    python: str
    numpy: str
    onnxruntime: str

    def __str__(self) -> str:
        return (
            f"{self.cpu}, {self.architecture}, {self.usable_cores} of {self.cores} cores, Python {self.python}, "
            f"numpy {self.numpy}, onnxruntime {self.onnxruntime}"
        )


def this_machine() -> Machine:
    """Return the machine that this process runs on."""
    return Machine(
        cpu=_cpu(),
        architecture=platform.machine(),
        cores=os.cpu_count() or 1,
        usable_cores=len(usable_cores()),
        system=f"{platform.system()} {platform.release()}",
        python=platform.python_version(),
        numpy=np.__version__,
        onnxruntime=onnxruntime.__version__,
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

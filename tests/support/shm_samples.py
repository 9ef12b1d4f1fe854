"""Writers of shared memory, and what is read from it."""

import math
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from edge_samples import BASELINE, ROOT, FakeModel, ended, make_contract, make_scan

from edge.perception.runtime import Runtime
from edge.sinks.shm import HEARTBEAT_AT, MEMBERS, Layout, SharedMemorySink, struct_of

sys.path.append(str(ROOT / "examples"))
import shm_read

CONTRACT = make_contract(interval_factor=1.6)
WRITE = """
import sys, time
from dataclasses import replace
import numpy as np
from edge.sinks.shm import SharedMemorySink
from shm_samples import CONTRACT, make_result
result = make_result(press_counts=3000)
sink = SharedMemorySink(sys.argv[1], CONTRACT)
number = 0
while True:
    for sensor in ("left/4", "right/4"):
        counts, now_ns = np.full((3, 4, 4), number % 60_000), time.monotonic_ns()
        scan = replace(result.scan, sensor=sensor, number=number, counts=counts, time_ns=now_ns)
        pattern = np.full((40, 40), number % 60_000, np.float32)
        sink.write(replace(result, scan=scan, pattern=pattern, deviation=pattern, force_counts=number), {})
    number == 0 and print("writes", flush=True)
    number += 1
"""


def make_result(number=0, *, press_counts=0, **of_the_scan):
    runtime = Runtime(FakeModel(CONTRACT), source="emulated", baselines={"4": BASELINE}, unix_time_s=lambda: 1012.34)
    return runtime.push(make_scan(number, press_counts=press_counts, **of_the_scan))


def latest(memory: memoryview, sensor: str) -> bytes | None:
    """Return the newest half, of any source and age, since the tests make both up."""
    return shm_read.latest(memory, sensor, oldest_s=math.inf, pretend=True)


def heartbeat_ns(memory: memoryview) -> int:
    return memory.cast("Q")[HEARTBEAT_AT // 8]


def writing(memory: memoryview, within_s: float = 0.5) -> bool:
    """Return True while the writer lives."""
    return time.monotonic_ns() - heartbeat_ns(memory) < within_s * 1e9


def fields(half: bytes) -> dict:
    names = [name for name, _ in MEMBERS]
    return dict(zip(names, struct_of(MEMBERS).unpack_from(half), strict=True))


def values(half: bytes, name: str) -> np.ndarray:
    kind, shape, at = Layout(4, 4, 40, 40).maps[name]
    return np.frombuffer(half, kind, int(np.prod(shape)), at).reshape(shape)


@pytest.fixture
def name():
    name = f"test-{os.getpid()}-{time.monotonic_ns()}"
    yield name
    Path("/dev/shm", name).unlink(missing_ok=True)


@pytest.fixture
def sink(name):
    sink = SharedMemorySink(name, CONTRACT)
    yield sink
    sink.close()


@pytest.fixture
def writer(name):
    """A process that writes the memory without end."""
    with ended(subprocess.Popen([sys.executable, "-c", WRITE, name], cwd=ROOT, stdout=subprocess.PIPE)) as writer:
        assert writer.stdout is not None and writer.stdout.readline() == b"writes\n"
        yield writer

"""Results for the ROS 2 sink, and the environment that keeps its tests to this machine."""

import os
import time
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="of the extra `ros2`")

import ros2_messages
from edge_samples import make_scan

from edge.perception.result import Result
from edge.sinks.ros2.sink import Ros2Sink
from firmware_bridge.links.base import SourceKind

TAG = f"<CycloneDDS><Domain><Discovery><Tag>{os.getpid()}</Tag></Discovery></Domain></CycloneDDS>"
"""Tag that keeps other test runs on this machine apart."""
ENVIRONMENT = {
    "ROS_DOMAIN_ID": str(1 + os.getpid() % 90),
    "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    "CYCLONEDDS_URI": TAG,
}


def contact(number, *, sensor="4", source: SourceKind = "device", **changes):
    random = np.random.default_rng(number)
    pattern, deviation = random.random((2, 40, 40), dtype=np.float32)
    scan = make_scan(number, sensor=sensor, time_ns=time.monotonic_ns())
    made = Result(scan, source, "m", "contact", contact=True, pattern_unit="mm", force_counts=3000.0)
    return replace(made, pattern=pattern, deviation=deviation, **changes)


def without_pattern(result, **changes):
    scan = replace(result.scan, time_ns=time.monotonic_ns())
    return replace(result, scan=scan, pattern=None, deviation=None, **changes)


def keep_published(sink, kept, *names):
    """Keep the messages of a sink, or those of some types, as decoded by the rules, in place of publishing them."""

    def keep(writer, data):
        package, _, kind = writer.data_type.__idl_typename__.split(".", 2)
        name = f"{package}/msg/{kind.removeprefix('dds_.').removesuffix('_')}"
        if not names or name in names:
            kept.append(ros2_messages.decode(name, data))

    sink._publish = keep


@pytest.fixture
def sink():
    made = Ros2Sink("/skin", ENVIRONMENT)
    yield made
    if hasattr(made, "_domain"):
        made.close()

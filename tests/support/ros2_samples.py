"""Results for the ROS 2 sink, nodes that listen and speak, and the environment that keeps them to this machine."""

import json
import os
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="of the extra `ros2`")

import ros2_messages
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.topic import Topic
from edge_samples import ROOT, fake_source, make_contract, make_scan, wait_for

from edge.perception.result import Result
from edge.sinks.ros2 import dds_domain as ros2_domain
from edge.sinks.ros2.sink import Ros2Sink
from firmware_bridge.links.base import SourceKind

TAG = f"<CycloneDDS><Domain><Discovery><Tag>{os.getpid()}</Tag></Discovery></Domain></CycloneDDS>"
"""Tag that keeps other test runs on this machine apart."""
ENVIRONMENT = {
    "ROS_DOMAIN_ID": str(1 + os.getpid() % 90),
    "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    "CYCLONEDDS_URI": TAG,
}

LISTENERS_CONFIGURATION = (
    '<CycloneDDS><Domain><General><Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>'
    "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    '<MaxAutoParticipantIndex>32</MaxAutoParticipantIndex><Peers><Peer address="localhost"/></Peers></Discovery>'
    f"</Domain></CycloneDDS>,{TAG}"
)
CDR = Qos(Policy.Reliability.Reliable(0), Policy.DataRepresentation(use_cdrv0_representation=True))


def contact(number, *, sensor="4", source: SourceKind = "device", **changes):
    random = np.random.default_rng(number)
    pattern, deviation = random.random((2, 40, 40), dtype=np.float32)
    scan = make_scan(number, sensor=sensor, time_ns=time.monotonic_ns())
    made = Result(scan, source, "m", "contact", contact=True, pattern_unit="mm", force_counts=3000.0)
    return replace(made, pattern=pattern, deviation=deviation, **changes)


def without_pattern(result, **changes):
    scan = replace(result.scan, time_ns=time.monotonic_ns())
    return replace(result, scan=scan, pattern=None, deviation=None, **changes)


def keep_published(sink, *names):
    """Return the messages of a sink, or those of some types, decoded by the rules in place of being published."""
    kept = []

    def keep(writer, data):
        package, _, kind = writer.data_type.__idl_typename__.split(".", 2)
        name = f"{package}/msg/{kind.removeprefix('dds_.').removesuffix('_')}"
        if not names or name in names:
            kept.append(ros2_messages.decode(name, data))

    sink.publish, sink.is_read = keep, lambda writer: True
    return kept


class Listener:
    """A subscriber; its lines are kept as they come."""

    def __init__(self, topics, *words, more=""):
        environment = os.environ | {"CYCLONEDDS_URI": LISTENERS_CONFIGURATION + more}
        command = [sys.executable, str(ROOT / "tests/support/ros2_messages.py"), ENVIRONMENT["ROS_DOMAIN_ID"]]
        command += [json.dumps(topics), *words]
        self.process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
        self.heard = []
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self):
        for line in self.process.stdout or ():
            self.heard.append(json.loads(line))

    def of(self, topic):
        return [line["message"] for line in self.heard if line["topic"] == topic]

    def until(self, satisfied, act=lambda: None):
        """Go on acting until the messages that were received suffice."""

        def enough():
            assert self.process.poll() is None
            return satisfied() or act()

        wait_for(enough)

    def __enter__(self):
        self.until(lambda: self.heard)
        return self

    def __exit__(self, *exc_info):
        with self.process:
            self.process.kill()


@contextmanager
def speaker(*topics):
    """Yield a function that publishes on topics, given by name and type, with types made of ROS's definitions."""
    domain, participant = ros2_domain.join(ENVIRONMENT)
    writers = {}
    for topic, name in topics:
        kind: Any = ros2_messages.dds_type(name)
        writers[topic, name] = DataWriter(participant, Topic(participant, f"rt/{topic}", kind), CDR)
    yield lambda topic, name, message: writers[topic, name].write(ros2_messages.built(name, message))
    writers.clear()
    del participant, domain


@pytest.fixture
def sink():
    made = Ros2Sink("/skin", make_contract(), fake_source("device"), environment=ENVIRONMENT)
    yield made
    if hasattr(made, "_domain"):
        made.close()

"""Results for the ROS 2 sink, nodes that listen and speak, and the environment that keeps them to this machine."""

import json
import os
import queue
import subprocess
import sys
import threading
import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="of the extra `ros2`")

import ros2_messages
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.topic import Topic
from edge_samples import ROOT, fake_source, make_contract, make_scan

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
PATIENCE_S = 20
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


def keep_published(sink, kept, *names):
    """Keep the messages of a sink, or those of some types, as decoded by the rules, in place of publishing them."""

    def keep(writer, data):
        package, _, kind = writer.data_type.__idl_typename__.split(".", 2)
        name = f"{package}/msg/{kind.removeprefix('dds_.').removesuffix('_')}"
        if not names or name in names:
            kept.append(ros2_messages.decode(name, data))

    sink.publish, sink.is_read = keep, lambda writer: True


class Listener:
    """A subscriber; its lines are kept as they come."""

    def __init__(self, topics, *words, more=""):
        environment = os.environ | {"CYCLONEDDS_URI": LISTENERS_CONFIGURATION + more}
        command = [sys.executable, str(ROOT / "tests/support/ros2_messages.py"), ENVIRONMENT["ROS_DOMAIN_ID"]]
        self.process = subprocess.Popen(
            [*command, json.dumps(topics), *words], env=environment, stdout=subprocess.PIPE, text=True
        )
        self.heard = []
        self._lines = queue.SimpleQueue()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self):
        for line in self.process.stdout or ():
            self._lines.put(json.loads(line))

    def of(self, topic):
        self._keep()
        return [line["message"] for line in self.heard if line["topic"] == topic]

    def _keep(self):
        while not self._lines.empty():
            self.heard.append(self._lines.get())

    def until(self, satisfied, act=lambda: None):
        """Go on acting until the messages that were received suffice."""
        end_s = time.monotonic() + PATIENCE_S
        while not satisfied():
            assert time.monotonic() < end_s, f"heard only {[line['topic'] for line in self.heard]}"
            assert self.process.poll() is None
            act()
            time.sleep(0.01)

    def __enter__(self):
        self.until(lambda: self._keep() or self.heard)
        return self

    def __exit__(self, *exc_info):
        self.process.kill()
        self.process.wait()
        if self.process.stdout is not None:
            self.process.stdout.close()


class Speaker:
    """A node that publishes on topics, given by their names and types, with types made of ROS's definitions."""

    def __init__(self, *topics):
        self._domain, self._participant = ros2_domain.join(ENVIRONMENT)
        self._writers = {}
        for topic, name in topics:
            kind: Any = ros2_messages.dds_type(name)
            writer = DataWriter(self._participant, Topic(self._participant, f"rt/{topic}", kind), CDR)
            self._writers[topic, name] = writer

    def say(self, topic, name, message):
        self._writers[topic, name].write(ros2_messages.built(name, message))

    def __enter__(self):
        return self

    def __exit__(self, *exc_info):
        del self._writers, self._participant, self._domain


@pytest.fixture
def sink():
    made = Ros2Sink("/skin", make_contract(), fake_source("device"), environment=ENVIRONMENT)
    yield made
    if hasattr(made, "_domain"):
        made.close()

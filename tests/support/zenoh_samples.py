"""Results over zenoh, and consumers of them in processes of their own."""

import json
import queue
import socket
import subprocess
import sys
import threading
from functools import partial
from types import SimpleNamespace

import pytest
from edge_samples import BASELINE, FakeModel, make_pad_contract, make_scan

from edge.perception.runtime import Runtime

zenoh = pytest.importorskip("zenoh")

CONTRACT = make_pad_contract(interval_factor=1.6)
# Prints each message as it comes: who came and went, or key, encoding, writer and payload; all from one thread.
CONSUME = """
import json, sys, time, zenoh
from zenoh_samples import listening
def tell(*words):
    print(json.dumps(words), flush=True)
def take(sample):
    writer, payload = str(sample.timestamp.get_id()), sample.payload.to_bytes().hex()
    tell("got", str(sample.key_expr), str(sample.encoding), writer, payload)
def follow(token):
    tell("came" if token.kind == zenoh.SampleKind.PUT else "went", str(token.key_expr))
here = lambda callback: zenoh.handlers.Callback(callback, indirect=False)
with listening(sys.argv[1]) as session:
    session.liveliness().declare_subscriber("grip/alive/*", here(follow), history=True)
    session.declare_subscriber("grip/**", here(take))
    tell("listens")
    time.sleep(100)
"""


def free_endpoint():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{one.getsockname()[1]}"


@pytest.fixture
def endpoint():
    return free_endpoint()


def listening(endpoint, *connect):
    """Open a session of zenoh's own that listens there."""
    config = zenoh.Config()
    config.insert_json5("listen/endpoints", json.dumps([endpoint]))
    config.insert_json5("connect/endpoints", json.dumps(connect))
    config.insert_json5("scouting/multicast/enabled", "false")
    return zenoh.open(config)


@pytest.fixture
def consumer(endpoint):
    """A consumer's process, and `next`, which returns the words of its next message."""
    lines = queue.SimpleQueue()
    with subprocess.Popen([sys.executable, "-c", CONSUME, endpoint], stdout=subprocess.PIPE) as process:

        def read():
            for line in process.stdout or ():
                lines.put(json.loads(line))

        reader = threading.Thread(target=read)  # at once: a full pipe would hold up the consumer
        reader.start()
        assert lines.get(timeout=60) == ["listens"]
        yield SimpleNamespace(process=process, next=partial(lines.get, timeout=60))
        process.kill()
        reader.join()


def make_results(count):
    """Return results in contact from the second on; every other of those as the one before it."""
    runtime = Runtime(FakeModel(CONTRACT), source="emulated", baselines={"4": BASELINE})
    presses = [0, *(3000 + 200 * (number // 2) for number in range(count - 1))]
    return [runtime.push(make_scan(n, press_counts=press)) for n, press in enumerate(presses)]

"""Samples for the live page's tests: a run to look at, and viewers over loopback."""

import http.client
import socket
import threading
from contextlib import contextmanager
from dataclasses import replace

import pytest
from edge_samples import FakeModel, fake_source, make_contract, unpack
from map_samples import result_of
from runtime_samples import Pushed, make_runtime
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from edge.mapping.object_map import ObjectMap
from edge.mapping.sink import MapSink
from edge.perception.event import Event
from edge.perception.run_options import RuntimeOptions
from edge.pipeline.commands import Commands
from edge.view.server import LiveView
from firmware_bridge.poses import PadPose

CONTRACT = make_contract(interval_factor=1.6)
TIMEOUT_S = 60.0
HANDSHAKE = (
    b"GET /ws HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)
LONG_PING = b"\x89\xfd" + bytes(4 + 125)


class Press(Pushed):
    """Results of scans, of an emulated sensor, pressed five times in eight."""

    def __init__(self, contract=CONTRACT, **settings):
        options = RuntimeOptions(every_scan=True)
        super().__init__(make_runtime(FakeModel(contract), source="emulated", options=options, **settings))

    def next(self, press_counts=None):
        return self.push((3000 if self.number % 8 < 5 else 0) if press_counts is None else press_counts)

    def take(self, count, press_counts=None):
        return [self.next(press_counts) for _ in range(count)]


class Page:
    """Live page over loopback, and its viewers."""

    def __init__(self, view, commands):
        self.view = view
        self.port = int(view.url.partition("//")[2].partition("/")[0].rpartition(":")[2])
        self.asked = commands
        self.messages = []
        self.press = Press()

    def viewer(self, query="", **settings):
        # A viewer that has not read everything does not notice that the server closes.
        settings = {"compression": None, "close_timeout": 0.2} | settings
        return connect(f"ws://127.0.0.1:{self.port}/ws{query}", **settings)

    def stranger(self, data=b""):
        """Open a plain connection, and send this data on it."""
        connection = socket.create_connection(("127.0.0.1", self.port), TIMEOUT_S)
        connection.sendall(data)
        return connection

    def play(self, count=1, press_counts=None):
        for result in self.press.take(count, press_counts):
            for sink in self.view.sinks:
                sink.write(result, {"dropped": 0})

    @contextmanager
    def playing(self, shows=None):
        """Play a hundred results a second, from a thread of its own as the loop's.

        With `shows`, what it returns is shown as of ever later scans; a sensor would not believe one taxel for so long.
        """
        stop = threading.Event()

        def loop():
            while not stop.wait(0.01):
                result = self.press.next()
                if shows is not None:
                    now, result = result.scan, shows()
                    scan = replace(result.scan, number=now.number, time_ns=now.time_ns)
                    result = replace(result, scan=scan)
                for sink in self.view.sinks:
                    sink.write(result, {"dropped": 0})

        thread = threading.Thread(target=loop, name="loop")
        thread.start()
        try:
            yield
        finally:
            stop.set()
            thread.join()


class Mapped:
    """Map of a figure, on a page; each touch is one scan later and is shown at once."""

    def __init__(self, page, figure):
        self.sink = MapSink(ObjectMap(), show=page.view.show_map, clock_ns=lambda: self.number * 10**9)
        self.figure = figure
        self.number = 0

    def touch(self, x_mm, y_mm, turn_deg=0.0, *, posed=True, **changes):
        pose = PadPose(x_mm, y_mm, turn_deg)
        result = result_of(self.figure, pose, number=self.number, posed=posed, **changes)
        self.number += 1
        self.sink.write(result, {})


@contextmanager
def live_page(host="127.0.0.1", token=None, contract=CONTRACT):
    commands = Commands()
    with LiveView(host, 0, token, contract, commands) as view:
        page = Page(view, commands)
        source = fake_source("emulated")
        source.name, source.length_s = "pretended", None
        view.begin(source, "fake", page.messages.append)
        yield page


def tell(page, kind, sensor, detail):
    for sink in page.view.sinks:
        sink.tell(Event(1, kind, sensor, detail), {})


def frame(viewer, kind=None):
    """Return header and maps of the next frame, or of the next of a kind."""
    while True:
        header, maps = unpack(viewer.recv(TIMEOUT_S))
        if kind in (None, header["kind"]):
            return header, maps


@pytest.fixture
def page():
    with live_page() as page:
        yield page


def get(page, path="/"):
    connection = http.client.HTTPConnection("127.0.0.1", page.port, timeout=TIMEOUT_S)
    try:
        connection.request("GET", path)
        response = connection.getresponse()
        return response.status, dict(response.getheaders()), response.read()
    finally:
        connection.close()


def refused_with(page, query=""):
    with pytest.raises(InvalidStatus) as caught, page.viewer(query):
        pass
    return caught.value.response.status_code

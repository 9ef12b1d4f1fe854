"""The link to the vendor's server: its sensors, its losses, and others that listen at its address."""

import contextlib
import math
import socket
import threading

import pytest
from bridge_samples import make_recording, read_scans, read_until_lost, stacked
from edge_samples import wait_for
from xela_server_emulator import ServerEmulator, looping, lose, read_notices

from firmware_bridge.errors import DeviceError, LinkLostError, SourceError
from firmware_bridge.links import xela_server
from firmware_bridge.links.base import LinkReader
from firmware_bridge.links.registry import open_sources
from firmware_bridge.links.xela_server import XelaServerLink
from firmware_bridge.scans.xela_server_messages import LONGEST_MESSAGE_BYTES


def test_every_scan_comes_once_and_in_order():
    recordings = [make_recording(30, seed=1), make_recording(30, seed=2)]
    with ServerEmulator(recordings) as server, XelaServerLink(server.url) as link:
        scans = read_until_lost(link)
    for sensor, recording in zip(("1", "2"), recordings, strict=True):
        mine = [scan for scan in scans if scan.sensor == sensor]
        assert [scan.number for scan in mine] == list(range(30))
        assert (stacked(scans, sensor) == recording.tracks[0].counts).all()
        assert all(scan.vendor_force_n is not None for scan in mine)
        assert all(scan.vendor is not None and scan.vendor.temperature_k is not None for scan in mine)
    counters = {name: count for name, count in link.counters().items() if count and name != "received_bytes"}
    assert counters == {"messages": 31, "welcomes": 1, "scans": 60}


def test_sensors_of_other_shapes_are_left_out_and_one_must_fit():
    with looping(others=[("uSPa46", 24)]) as server, XelaServerLink(server.url) as link:
        assert {scan.sensor for scan in read_scans(link, 5)} == {"1"}
        assert link.trouble == "sensor 2 is left out: 'uSPa46' with 24 taxels, expected 16"
    with ServerEmulator([], others=[("uSPa46", 24)], loop=True) as server:
        words = "no sensor that can be used: sensor 1 is left out: 'uSPa46'"
        with pytest.raises(DeviceError, match=words) as refused, XelaServerLink(server.url) as link:
            read_scans(link, 1)
        assert not isinstance(refused.value, LinkLostError), "another try would not help"
        wait_for(lambda: not server.clients)


def test_it_is_told_why_a_server_closes_or_is_left():
    with looping() as server:
        link = XelaServerLink(server.url)
        with link:
            server.say(server.message(7, 0.5, 1e9).encode())  # a binary message is one, too
            assert read_scans(link, 1)
            server.close_all(1012, "service restart")
            assert "service restart" in lose(link)
        with link:
            server.say("x" * (LONGEST_MESSAGE_BYTES + 1))
            assert "too big" in lose(link)


@contextlib.contextmanager
def listening(answer):
    """Yield the address of a socket that gives `answer` (None: nothing) to who connects, and is no server."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        stop = threading.Event()

        def serve():
            with listener.accept()[0] as connection:
                connection.recv(4096)
                stop.wait(60) if answer is None else connection.sendall(answer)

        thread = threading.Thread(target=serve)
        thread.start()
        yield f"ws://127.0.0.1:{listener.getsockname()[1]}"
        stop.set()
        thread.join()


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n", "HTTP 404"),
        (b"\x15\x03\x01\x00\x02\x02\x46", "expects TLS"),
        (None, "timed out"),
    ],
)
def test_others_that_listen_there(answer, words, limits):
    if answer is None:
        limits(xela_server, OPENING_S=0.2)
    with listening(answer) as url, pytest.raises(DeviceError, match=f"is no xela_server, .*{words}") as refused:
        XelaServerLink(url).__enter__()
    assert str(refused.value).startswith(url) and "\n" not in str(refused.value)


def test_one_that_hangs_is_lost_and_used_again_once_it_answers(limits):
    with looping() as server, LinkReader(XelaServerLink(server.url), math.inf) as link:
        read_scans(link, 3)
        limits(xela_server, OPENING_S=0.2)
        server.freeze()
        silent, lost = read_notices(link, 2)
        assert (silent.kind, lost.kind) == ("silent", "lost")
        assert "timed out" in lost.text
        server.thaw()
        assert read_scans(link, 3)


def test_hosts_that_cannot_be_reached(monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with pytest.raises(DeviceError, match=rf"^ws://\S+:{port}: .*refused: .*start xela_server.*1\.7\.6.*hostname -I"):
        XelaServerLink(f"ws://127.0.0.1:{port}").__enter__()
    with pytest.raises(DeviceError, match=r"^ws://\S+:5000: .*no such host: name it by its IP address"):
        XelaServerLink("ws://.x").__enter__()

    def refuse(*args, **kwargs):
        raise OSError(113, "No route to host")

    monkeypatch.setattr(socket, "create_connection", refuse)
    with pytest.raises(DeviceError, match="No route to host: is the machine on"):
        XelaServerLink("ws://robot").__enter__()


def test_addresses():
    for url, known in {
        "ws://10.0.0.7:5001/": "ws://10.0.0.7:5001",
        "ws://[::1]": "ws://[::1]:5000",
        "WS://Robot:80": "ws://robot:80",
    }.items():
        (link,) = open_sources([f"xela-server:{url}"])
        assert isinstance(link, XelaServerLink)
        assert (link.name, link.url, link.kind) == (f"xela-server:{url}", known, "device")
    no_port = ["ws://robot:0", "ws://robot:70000", "ws://robot:x"]
    for url in ["robot:5000", "http://robot", "wss://robot", *no_port, "ws://user:secret@robot", "ws://robot/path"]:
        with pytest.raises(SourceError, match=r"expected ws://HOST or ws://HOST:PORT"):
            open_sources([f"xela-server:{url}"])

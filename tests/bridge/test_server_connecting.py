"""Connecting to a server: others that listen there, handshakes that hang, and addresses."""

import contextlib
import socket
import threading

import pytest
from bridge_samples import (
    read_scans,
)
from server_samples import looping, read_notices
from xela_server_emulator import ServerEmulator

from firmware_bridge.errors import DeviceError, SourceError
from firmware_bridge.links import xela_server
from firmware_bridge.links.registry import open_source, open_sources
from firmware_bridge.links.xela_server import XelaServerLink, server_address


@contextlib.contextmanager
def listening(answer):
    """Yield the port of a socket that gives `answer` (None: nothing) to all who connect, and is no server."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        stop = threading.Event()

        def serve():
            with contextlib.suppress(OSError):
                connection, _ = listener.accept()
                with connection:
                    connection.recv(4096)
                    if answer is not None:
                        connection.sendall(answer)
                    else:
                        stop.wait(20)

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield f"ws://127.0.0.1:{listener.getsockname()[1]}"
        finally:
            stop.set()
            with contextlib.suppress(OSError):
                socket.create_connection(listener.getsockname(), 0.2).close()
            thread.join()


HTTP = b"HTTP/1.1 %s\r\nContent-Length: 0\r\n%s\r\n"


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (HTTP % (b"404 Not Found", b""), "HTTP status 404"),
        (HTTP % (b"200 OK", b""), "HTTP status 200"),
        (HTTP % (b"302 Found", b"Location: ws://elsewhere/\r\n"), "broke while it was opened|HTTP status 302"),
        (b"SSH-2.0-OpenSSH_9.6\r\n", "another program"),
        (b"\x15\x03\x01\x00\x02\x02\x46", "expects TLS"),
        (b"", "another program"),
        (HTTP % (b"101 Switching Protocols", b""), "is not an xela_server"),
    ],
)
def test_others_that_listen_there(answer, words):
    with listening(answer) as url, pytest.raises(DeviceError, match=words) as refused:
        XelaServerLink(url).__enter__()
    assert str(refused.value).startswith(url) and "\n" not in str(refused.value)


def test_a_handshake_that_hangs(monkeypatch):
    monkeypatch.setattr(xela_server, "OPENING_S", 0.2)
    with listening(None) as url, pytest.raises(DeviceError, match=r"has not answered for 0\.2 s"):
        XelaServerLink(url).__enter__()
    with ServerEmulator(looping()) as server:
        server.freeze()
        with pytest.raises(DeviceError, match="has not answered"):
            XelaServerLink(server.url).__enter__()


def test_a_server_that_was_met_and_hangs_holds_up_its_reader_for_less(monkeypatch):
    monkeypatch.setattr(xela_server, "OPENING_S", 20.0)
    monkeypatch.setattr(xela_server, "REOPENING_S", 0.2)
    with ServerEmulator(looping()) as server, open_sources([f"xela-server:{server.url}"])[0] as link:
        read_scans(link, 3)
        server.freeze()
        silent, lost = read_notices(link, 2)
        assert (silent.kind, lost.kind) == ("silent", "lost")
        assert "has not answered for 0.2 s: it hangs" in lost.text
        server.thaw()
        assert read_scans(link, 3)


def test_nobody_listens():
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with pytest.raises(DeviceError, match=r"connection refused: .*start xela_server.*1\.7\.6.*hostname -I"):
        XelaServerLink(f"ws://127.0.0.1:{port}").__enter__()


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (socket.gaierror(-2, "Name or service not known"), "no such host"),
        (TimeoutError("timed out"), "no answer within 3 s"),
        (OSError(113, "No route to host"), "No route to host"),
        (ConnectionRefusedError(111, "Connection refused"), r"refused: start xela_server there, or name its port$"),
    ],
)
def test_hosts_that_cannot_be_reached(monkeypatch, error, words):
    def refuse(*args, **kwargs):
        raise error

    monkeypatch.setattr(socket, "create_connection", refuse)
    with pytest.raises(DeviceError, match=words):
        XelaServerLink("ws://robot").__enter__()


@pytest.mark.parametrize("host", ["192.168.0..21", ".x", "x" * 64])
def test_hosts_that_cannot_be(host):
    with pytest.raises(DeviceError, match=r"^ws://\S+:5000: no such host: name it by its IP address"):
        XelaServerLink(f"ws://{host}").__enter__()


@pytest.mark.parametrize(
    ("url", "known"),
    [
        ("ws://robot", ("robot", 5000, "ws://robot:5000")),
        ("ws://10.0.0.7:5001/", ("10.0.0.7", 5001, "ws://10.0.0.7:5001")),
        ("ws://[::1]", ("::1", 5000, "ws://[::1]:5000")),
        ("WS://Robot:80", ("robot", 80, "ws://robot:80")),
    ],
)
def test_addresses(url, known):
    assert server_address(url) == known
    link = open_source(f"xela-server:{url}")
    assert isinstance(link, XelaServerLink) and link.name == f"xela-server:{url}"


@pytest.mark.parametrize(
    "url",
    ["robot", "robot:5000", "http://robot", "wss://robot", "ws://", "ws://:5000", "ws://robot:0", "ws://robot:70000",
     "ws://robot:x", "ws://user:secret@robot", "ws://robot/path", "ws://robot?x=1", "ws://robot#x", "ws://[::1",
     "ws://ro bot", "ws://robot\n"],
)  # fmt: skip
def test_addresses_that_are_none(url):
    with pytest.raises(SourceError, match=r"expected ws://HOST or ws://HOST:PORT"):
        open_source(f"xela-server:{url}")

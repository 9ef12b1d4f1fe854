"""Memory of the whole program before and after many clients of the live page, kind by kind.

    python tests/system/page_clients.py [--count 100000] [--kinds connect get ...]

Nobody watches meanwhile. Every scan is in contact and new. Clients come one after the other, four at a time;
those that are cut off for what they send come again, until as much was sent.
"""

import argparse
import contextlib
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final

import numpy as np
from page_cost import free_port

from edge.bench.live_report import head, line
from edge.bench.program import Play, Program, edge_sr
from edge.terminal.argument_types import whole

WARM_UP_S: Final = 20.0
SETTLE_S: Final = 12.0
"""Time that the server may take to tidy up."""
TOGETHER: Final = 4
TIMEOUT_S: Final = 60.0
PLAY: Final = Play(pressed=500, moving=True)
_GET: Final = b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n"
_SOCKET: Final = (
    b"GET /ws HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)
_REFUSED: Final = (
    b"\x16\x03\x01\x02\x00\r\n\r\n",
    b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 2\r\n\r\n{}",
    _SOCKET.replace(b"localhost", b"stranger"),
    _SOCKET.replace(b"13", b"12"),
)
_AT_ONCE: Final = 100
"""Frames in one piece."""


def _connect(connection: socket.socket, left: int) -> int:
    """Send nothing, and go when the server has noticed it."""
    connection.shutdown(socket.SHUT_WR)
    connection.recv(1)
    return 1


def _get(connection: socket.socket, left: int) -> int:
    """Fetch the page."""
    connection.sendall(_GET)
    while connection.recv(1 << 16):
        pass
    return 1


def _handshake(connection: socket.socket, left: int) -> int:
    """Ask for handshakes of all kinds that are refused."""
    with contextlib.suppress(ConnectionError):
        connection.sendall(_REFUSED[left % len(_REFUSED)])
        while connection.recv(1 << 16):
            pass
    return 1


def _flood(frame: bytes) -> "Callable[[socket.socket, int], int]":
    def flood(connection: socket.socket, left: int) -> int:
        """Look without reading, and send until it is cut off."""
        sent = 0
        with contextlib.suppress(OSError):
            connection.sendall(_SOCKET)
            while sent < left:
                connection.sendall(frame * min(left - sent, _AT_ONCE))
                sent += min(left - sent, _AT_ONCE)
        return sent

    return flood


KINDS: Final[dict[str, Callable[[socket.socket, int], int]]] = {
    "connect": _connect,
    "get": _get,
    "handshake": _handshake,
    "ping": _flood(b"\x89\x80mask"),
    "pong": _flood(b"\x8a\x80mask"),
    "text": _flood(b"\x81\x82\0\0\0\0{}"),
}


def _crowd(port: int, kind: str, count: int) -> None:
    """Send clients until `count` is reached."""
    done = number = 0
    while done < count:
        number += 1
        # From many addresses, or all ports would soon wait for stray packets.
        source = (f"127.0.{number % 16}.{1 + number // 16 % 250}", 0)
        with socket.create_connection(("127.0.0.1", port), TIMEOUT_S, source) as connection:
            done += KINDS[kind](connection, count - done)


def _measured(program: Program, port: int, kind: str, count: int) -> tuple[str, ...]:
    """Return a row: the memory that one kind of client leaves."""
    before_mb, begun_s = program.resident_mb(), time.monotonic()
    with ThreadPoolExecutor(TOGETHER) as executor:
        crowds = [executor.submit(_crowd, port, kind, count // TOGETHER) for _ in range(TOGETHER)]
        latencies_us: list[float] = []
        while not all(crowd.done() for crowd in crowds):
            latencies_us += [record.record["latency_us"] or 0 for record in program.lines(0.5)]
        for crowd in crowds:
            crowd.result()
    took_s = time.monotonic() - begun_s
    program.lines(SETTLE_S)
    p99_us = f"{np.quantile(latencies_us, 0.99):.0f}"
    return kind, str(count), f"{took_s:.0f}", f"{before_mb:.1f}", f"{program.resident_mb():.1f}", p99_us


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; returns an exit code."""
    parser = argparse.ArgumentParser(
        prog="python tests/system/page_clients.py", description="What clients of the page leave."
    )
    parser.add_argument("--count", metavar="N", type=whole(1), default=100_000, help="of each kind (default 100000)")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS), help="of clients (default all)")
    options = parser.parse_args(arguments)
    port = free_port()
    with (
        tempfile.TemporaryDirectory() as folder,
        edge_sr(Path(folder), PLAY, "--every-scan", "--view", str(port)) as program,
    ):
        program.lines(WARM_UP_S)
        sys.stdout.write(head(("client", "how many", "seconds", "MB before", "MB after", "latency p99 us")) + "\n")
        for kind in options.kinds:
            sys.stdout.write(line(_measured(program, port, kind, options.count)) + "\n")
            sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())

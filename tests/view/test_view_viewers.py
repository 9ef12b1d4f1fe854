"""Viewers of the live page that are many, slow, silent or gone."""

import gc
import threading
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest
from edge_samples import wait_for
from view_samples import HANDSHAKE, frame, get, live_page, page
from websockets.exceptions import ConnectionClosed

from edge.pipeline.result_stream import uncollected
from edge.view import frames, server
from edge.view.frames import MOST_VIEWERS
from edge.view.server import TIDY_CONNECTIONS, Connection

__all__ = ["page"]

GOODBYE = b"\x88\x80\x00\x00\x00\x00"
CLIENTS = {
    "connect": b"",
    "get": b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n",
    "post": b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 2\r\n\r\n{}",
    "garbage": b"\x16\x03\x01\x02\x00\r\n\r\n",
    "stranger": HANDSHAKE.replace(b"localhost", b"stranger"),
    "version": HANDSHAKE.replace(b"13", b"12"),
    "viewer": HANDSHAKE,
}


def seen_by(viewer):
    """Return the number of viewers that a viewer is told of next."""
    return frame(viewer, "state")[0]["viewers"]


def answer(stranger):
    return stranger.recv(12)[9:].decode()


def test_who_never_reads_costs_little_and_harms_nobody(page, limits):
    limits(frames, LATE_S=0.1)
    with page.viewer() as other, page.stranger(HANDSHAKE) as blocked:
        with page.playing():
            shown = [frame(other, "result") for _ in range(30)]
        sent = b""
        blocked.settimeout(0.5)
        with suppress(TimeoutError):
            while data := blocked.recv(1 << 16):
                sent += data
    assert b'"hello"' in sent and len(sent) < 15 * sum(one.nbytes for one in shown[0][1].values())


def test_the_place_of_who_takes_nothing_is_free_again(page, limits):
    """As of who never reads, and of whose network vanished: both look alike from here."""
    limits(server, GONE_S=1.5)
    with page.viewer() as other, page.playing(), page.stranger(HANDSHAKE):
        wait_for(lambda: seen_by(other) == 2)
        wait_for(lambda: seen_by(other) == 1)


def test_as_many_are_admitted_as_there_is_room_for(page):
    with ExitStack() as viewers:
        many = [viewers.enter_context(page.viewer()) for _ in range(2 * MOST_VIEWERS)]
        refused = 0
        for viewer in many:
            try:
                assert frame(viewer)[0]["kind"] == "hello"
            except ConnectionClosed as closed:
                assert (closed.rcvd.code, closed.rcvd.reason) == (1013, f"too many viewers ({MOST_VIEWERS}): close one")
                refused += 1
        assert refused == MOST_VIEWERS
        wait_for(lambda: seen_by(many[0]) == MOST_VIEWERS)


def test_behind_a_pause_in_reading_comes_the_newest(page, limits):
    limits(frames, LATE_S=0.05)
    with page.viewer(max_queue=2) as viewer, page.playing():
        headers = [frame(viewer, "result")[0]]
        end = page.press.number + 100
        wait_for(lambda: page.press.number >= end)  # not read meanwhile

        def jumped():
            headers.append(frame(viewer, "result")[0])
            return headers[-1]["scan"] - headers[-2]["scan"] > 30

        wait_for(jumped)  # what would be old by now was never sent
        traced = [point[0] for header in headers for point in header["trace"]]
        assert traced == sorted(set(traced))


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_what_ends_the_server_is_told_and_the_run_goes_on(limits):
    def broken(*given):
        raise NameError

    with live_page() as page:
        limits(server, Frames=broken)
        with suppress(Exception), page.viewer():
            wait_for(lambda: page.messages)
        wait_for(lambda: page.messages)
        page.play(5)
    [event] = page.messages
    assert event.kind == "trouble" and "the live page has ended: NameError" in event.text


@pytest.mark.parametrize("client", CLIENTS)
def test_clients_leave_nothing_behind(page, client):
    """Garbage collection is off, as while the loop runs."""

    def come_and_go(count):
        for number in range(count):
            heard = b""
            with page.stranger(CLIENTS[client]) as stranger, suppress(ConnectionError):
                while client != "connect" and b'"hello"' not in heard:
                    if not (data := stranger.recv(1 << 16)):
                        break
                    heard += data
                if client == "viewer" and number % 2:  # as a browser that is closed; every other is killed
                    stranger.sendall(GOODBYE)

    def left():
        return len(list(Path("/proc/self/fd").iterdir())), threading.active_count()

    def lost():
        return sum(type(one) is Connection for one in gc.get_objects())

    gc.collect()
    with uncollected():
        at_rest = left()
        come_and_go(3 * TIDY_CONNECTIONS)
        wait_for(lambda: left() == at_rest)
        assert lost() < 1.5 * TIDY_CONNECTIONS, "some were still closing when the others were collected"
        assert get(page)[0] == 200

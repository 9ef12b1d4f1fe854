"""The live page over loopback, with real sockets; and viewers that are many, slow, silent or gone."""

import gc
import json
import socket
import threading
import time
from contextlib import ExitStack, suppress
from ipaddress import ip_address
from pathlib import Path
from urllib.request import urlopen

import pytest
from edge_samples import wait_for
from view_samples import HANDSHAKE, TIMEOUT_S, frame, get, live_page, page, refused_with
from websockets.exceptions import ConnectionClosed

from edge.pipeline.result_stream import uncollected
from edge.view import frames, server
from edge.view.server import SCRIPTS, TIDY_CONNECTIONS, Connection, load_page

__all__ = ["page"]


class TestPage:
    def test_it_is_one_file_without_outside_assets(self, page):
        status, headers, body = get(page)
        assert (status, body) == (200, load_page().body)
        assert headers["Content-Type"].startswith("text/html")
        assert b"page.css" not in body and not any(name.encode() in body for name in SCRIPTS)
        policy = headers["Content-Security-Policy"]
        assert "default-src 'none'" in policy and "frame-ancestors 'none'" in policy and "connect-src 'self'" in policy
        assert "script-src 'sha256-" in policy  # whatever else finds its way into the page does not run
        assert headers["Referrer-Policy"] == "no-referrer" and headers["Cache-Control"] == "no-store"
        assert get(page, "/favicon.ico")[0] == 404
        assert get(page, "/ws")[0] == 426  # asked for like a page

    def test_on_other_addresses_a_token_is_made(self):
        with live_page(host="0.0.0.0") as page:
            query = page.view.url.partition("?")[2]
            assert query.startswith("token=") and refused_with(page) == refused_with(page, "?token=another-one") == 403
            assert get(page)[0] == 200, "the page is opened again without"
            with page.viewer(f"?{query}"):
                pass
            urls = [page.view.url, *page.view.other_urls]
            assert urls[-1] == f"http://{socket.gethostname()}:{page.port}/?{query}"
            for url in urls[:-1]:  # each is opened as a person on another machine does, if there is a network
                host = url.partition("//")[2].partition(":")[0]
                assert not ip_address(host).is_loopback and urlopen(url, timeout=TIMEOUT_S).status == 200

    def test_who_says_nothing_is_not_waited_for(self, limits):
        limits(server, OPEN_S=0.1)
        with live_page() as page, page.stranger(b"GET / HTTP/1.1\r\n") as stranger:
            assert stranger.recv(1000) == b""
            assert get(page)[0] == 200


class TestFrames:
    def test_results_are_sampled_and_none_waits_to_be_acknowledged(self, page):
        with page.viewer() as viewer, page.playing():
            began_s = time.monotonic()
            seen = [frame(viewer, "result")[0] for _ in range(15)]
            assert len(seen) <= (time.monotonic() - began_s) * 25 + 2
            sockets = [one for one in gc.get_objects() if type(one) is socket.socket and one.fileno() >= 0]
            ours = [one for one in sockets if one.getsockname()[1:] == (page.port,)]
            assert len(ours) == 2 and all(one.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY) for one in ours)
        assert sum(len(header["trace"]) for header in seen) == seen[-1]["scan"] + 1

    def test_viewers_are_told_when_the_run_ends(self, limits):
        """A client that says nothing does not delay the end."""
        limits(server, OPEN_S=600.0)
        threads = threading.active_count()
        with ExitStack() as run:
            page = run.enter_context(live_page())
            with page.stranger(), page.stranger(HANDSHAKE), page.viewer() as viewer:
                wait_for(lambda: frame(viewer, "state")[0]["viewers"] == 2)
                run.close()
                with pytest.raises(ConnectionClosed) as caught:
                    while True:
                        viewer.recv(TIMEOUT_S)
        assert (caught.value.rcvd.code, caught.value.rcvd.reason) == (1001, "the run has ended")
        assert threading.active_count() <= threads


def test_who_asks_too_much_or_too_long_harms_nobody():
    with ExitStack() as run:
        page = run.enter_context(live_page())
        with page.viewer() as long, page.viewer() as viewer, page.viewer() as other:
            long.send("x" * 5000)
            with pytest.raises(ConnectionClosed) as caught:
                while True:
                    long.recv(TIMEOUT_S)
            assert caught.value.rcvd is not None and caught.value.rcvd.code == 1009
            for _ in range(500):
                viewer.send(json.dumps({}))
            page.play()
            assert frame(other, "result")
            run.close()
        assert page.asked.refused < 250  # heard at a person's pace, and what waits is not read to its end


GOODBYE = b"\x88\x80\x00\x00\x00\x00"
CLIENTS = {
    "connect": b"",
    "get": b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n",
    "garbage": b"\x16\x03\x01\x02\x00\r\n\r\n",
    "viewer": HANDSHAKE,
}


def seen_by(viewer):
    """Return the number of viewers that a viewer is told of next."""
    return frame(viewer, "state")[0]["viewers"]


def test_the_place_of_who_takes_nothing_is_free_again(page, limits):
    """As of who never reads, and of whose network vanished: both look alike from here."""
    limits(server, GONE_S=1.5)
    with page.viewer() as other, page.playing(), page.stranger(HANDSHAKE):
        wait_for(lambda: seen_by(other) == 2)
        wait_for(lambda: seen_by(other) == 1)


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
                assert client == "get" or b" 200 " not in heard
                if client == "viewer" and number % 2:  # as a browser that is closed; every other is killed
                    stranger.sendall(GOODBYE)

    def left():
        return len(list(Path("/proc/self/fd").iterdir())), threading.active_count()

    def lost():
        return sum(type(one) is Connection for one in gc.get_objects())

    gc.collect()
    with uncollected():
        at_rest = left()
        come_and_go(2 * TIDY_CONNECTIONS)
        wait_for(lambda: left() == at_rest)
        assert lost() < 1.5 * TIDY_CONNECTIONS, "some were still closing when the others were collected"
        assert get(page)[0] == 200

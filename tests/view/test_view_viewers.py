"""Viewers of the live page that are many, slow, silent or gone."""

import gc
import threading
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest
from edge_samples import wait_for
from view_samples import HANDSHAKE, LONG_PING, Swallowing, frame, get, live_page, page, refused_with
from websockets.sync.client import connect

from edge.pipeline.result_stream import uncollected
from edge.view import server
from edge.view import viewers as attended
from edge.view.viewers import MOST_CONNECTIONS, MOST_VIEWERS

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
    limits(attended, LATE_S=0.1)
    with page.viewer() as other, page.stranger(HANDSHAKE) as blocked:
        with page.playing():
            shown = [frame(other, "result") for _ in range(30)]
        sent = b""
        blocked.settimeout(0.5)
        with suppress(TimeoutError):
            while data := blocked.recv(1 << 16):
                sent += data
    assert b'"hello"' in sent and len(sent) < 15 * sum(one.nbytes for one in shown[0][1].values())


@pytest.mark.parametrize("how", ["never reads", "network vanishes"])
def test_the_place_of_who_takes_nothing_is_free_again(page, limits, how):
    limits(attended, GONE_S=1.5)
    with page.viewer() as other, page.playing(), ExitStack() as gone:
        network = None
        if how == "never reads":
            gone.enter_context(page.stranger(HANDSHAKE))
        else:
            network = gone.enter_context(Swallowing(page.port))
            settings = {"compression": None, "close_timeout": 0, "max_queue": 1000}
            viewer = gone.enter_context(connect(f"ws://127.0.0.1:{network.port}/ws", **settings))
            frame(viewer, "result")
        wait_for(lambda: seen_by(other) == 2)
        if network is not None:
            network.swallow()
        wait_for(lambda: seen_by(other) == 1)


def test_the_place_of_who_takes_no_first_frame_is_free_again(tmp_path, limits):
    limits(server, OPEN_S=0.2)
    with live_page(tmp_path, name="x" * 5_000_000) as page, ExitStack() as strangers:
        for _ in range(MOST_VIEWERS):
            strangers.enter_context(page.stranger(HANDSHAKE))

        def admitted():
            with page.stranger(HANDSHAKE) as another:
                return answer(another) == "101"

        wait_for(admitted)


def test_as_many_are_admitted_as_there_is_room_for(page):
    """A place is taken before anything is sent, so that no more come in at once."""
    with ExitStack() as strangers:
        many = [strangers.enter_context(page.stranger(HANDSHAKE)) for _ in range(2 * MOST_VIEWERS)]
        assert sorted(map(answer, many)) == ["101"] * MOST_VIEWERS + ["503"] * MOST_VIEWERS
        assert refused_with(page) == 503


@pytest.mark.parametrize("frame_", [LONG_PING, b"\x8a\x80mask", b"\x81\x82mask{}"], ids=["ping", "pong", "text"])
def test_who_sends_more_than_a_person_asks_for_is_cut_off(page, frame_, limits):
    limits(attended, GONE_S=600.0)  # not because it reads nothing
    with page.viewer(ping_interval=None) as other, page.stranger(HANDSHAKE) as flood:  # one process for all
        much = (200_000 // len(frame_)) * frame_  # at once: a few hundred commands are answered one by one
        with pytest.raises(ConnectionError):
            for _ in range(1500):
                flood.sendall(much)
        wait_for(lambda: seen_by(other) == 1)
        page.play()
        assert frame(other, "result")


def test_behind_a_pause_in_reading_comes_the_newest(page, limits):
    limits(attended, LATE_S=0.05)
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


def test_who_says_nothing_makes_room_for_the_next(tmp_path, limits):
    """Idle connections lock nobody out; those of viewers are not theirs to take."""
    limits(server, OPEN_S=600.0)  # they make room, and not because they were silent for so long
    with live_page(tmp_path) as page, page.viewer() as viewer, ExitStack() as strangers:
        idle = [strangers.enter_context(page.stranger()) for _ in range(MOST_CONNECTIONS + 6)]
        assert get(page)[0] == 200
        for evicted in idle[:7]:
            assert evicted.recv(1) == b""
        with page.viewer() as another:
            assert frame(another)[0]["kind"] == frame(viewer)[0]["kind"] == "hello"


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_what_ends_the_server_is_told_and_the_run_goes_on(tmp_path):
    class Broken:
        """Player whose state nobody had thought of."""

        def begin(self):
            pass

        @property
        def state(self):
            raise NameError

    with live_page(tmp_path, player=Broken()) as page:
        with suppress(Exception), page.viewer():
            wait_for(lambda: page.messages)
        wait_for(lambda: page.messages)
        page.play(5)
    [event] = page.messages
    assert event.kind == "trouble" and "the live page has ended: NameError" in event.text


@pytest.mark.parametrize("client", CLIENTS)
def test_clients_leave_nothing_behind(page, client, limits):
    """Garbage collection is off, as while the loop runs."""
    limits(attended, TIDY_S=0.05)

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

    with uncollected():
        at_rest = left()
        come_and_go(20)
        wait_for(lambda: left() == at_rest)
        gc.collect()
        before = len(gc.get_objects())
        come_and_go(100)
        wait_for(lambda: left() == at_rest and len(gc.get_objects()) - before < 1000)
        assert get(page)[0] == 200

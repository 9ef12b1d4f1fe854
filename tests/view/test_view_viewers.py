"""Viewers of the live page that are many, slow, silent or gone."""

import asyncio
import gc
import socket
import threading
import time
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest
from view_samples import (
    HANDSHAKE,
    LONG_PING,
    Swallowing,
    frame,
    get,
    live_page,
    page,
    refused_with,
    viewers,
    wait_for,
)
from websockets.sync.client import connect

from edge.pipeline.pump import uncollected
from edge.view import connection_limits as connections
from edge.view import server
from edge.view import viewer_connection as attended

__all__ = ["page"]

GOODBYE = b"\x88\x80\x00\x00\x00\x00"


class TestMany:
    def test_several_at_different_speeds_see_the_newest(self, page):
        with page.viewer() as quick, page.viewer() as slow, page.playing():
            for _ in range(3):
                time.sleep(0.3)
                header = frame(slow, "result")[0]
            newest = [frame(quick, "result")[0] for _ in range(10)][-1]
            assert newest["scan"] > 10 and header["scan"] >= 1

    def test_who_never_reads_costs_little_and_harms_nobody(self, page, monkeypatch):
        monkeypatch.setattr(attended, "LATE_S", 0.1)
        blocked = page.stranger(HANDSHAKE)
        wait_for(lambda: viewers(page) == 1)
        (watching,) = page.view._server._viewers
        transport = watching.transport
        with blocked, page.viewer() as other, page.playing():
            most_bytes = 0
            for _ in range(30):  # the loop goes on for the other
                frame(other, "result")
                most_bytes = max(most_bytes, transport.get_write_buffer_size())
            assert viewers(page) == 2
        assert most_bytes < 200_000

    def test_who_never_reads_is_closed(self, page, monkeypatch):
        monkeypatch.setattr(attended, "GONE_S", 0.2)
        with page.stranger(HANDSHAKE):
            wait_for(lambda: viewers(page) == 1)
            wait_for(lambda: viewers(page) == 0)

    def test_the_place_of_a_viewer_whose_network_vanishes_is_free_again(self, page, monkeypatch):
        monkeypatch.setattr(attended, "GONE_S", 0.5)
        page.view._server._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)  # the network takes little
        with Swallowing(page.port) as network, page.playing():
            settings = {"compression": None, "close_timeout": 0, "max_queue": 1000}
            with connect(f"ws://127.0.0.1:{network.port}/ws", **settings) as viewer:
                frame(viewer, "result")
                (watching,) = page.view._server._viewers
                network.swallow()
                wait_for(lambda: watching.transport.get_write_buffer_size() > 40_000)
                wait_for(lambda: page.view._server._connections.granted == 0)

    def test_the_place_of_one_that_does_not_take_its_first_frame_is_free_again(self, page, monkeypatch):
        monkeypatch.setattr(server, "OPEN_S", 0.2)
        monkeypatch.setattr(server, "hello", lambda run, recording: b"x" * 50_000_000)
        with page.stranger(HANDSHAKE):
            wait_for(lambda: page.view._server._connections.granted == 1)
            wait_for(lambda: page.view._server._connections.granted == 0)

    @pytest.mark.parametrize("frame_", [LONG_PING, b"\x8a\x80mask", b"\x81\x82mask{}"], ids=["ping", "pong", "text"])
    def test_who_sends_more_than_a_person_asks_for_is_cut_off(self, page, frame_, monkeypatch):
        monkeypatch.setattr(attended, "GONE_S", 600.0)  # not because it reads nothing
        with page.viewer(ping_interval=None) as other, page.stranger(HANDSHAKE) as flood:  # one process for all
            much = (200_000 // len(frame_)) * frame_  # at once: a few hundred commands are answered one by one
            with pytest.raises(ConnectionError):
                for _ in range(1500):
                    flood.sendall(much)
            wait_for(lambda: viewers(page) == 1)
            page.play()
            assert frame(other, "result")

    def test_behind_a_pause_in_reading_comes_the_newest(self, page, monkeypatch):
        monkeypatch.setattr(attended, "LATE_S", 0.05)
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

    def test_more_than_there_is_room_for_are_told(self, page, monkeypatch):
        monkeypatch.setattr(connections, "MOST_VIEWERS", 2)
        with page.viewer(), page.viewer():
            wait_for(lambda: viewers(page) == 2)
            assert refused_with(page) == 503

    def test_who_was_granted_a_place_has_it_before_anything_is_sent(self, page, monkeypatch):
        monkeypatch.setattr(connections, "MOST_VIEWERS", 2)
        monkeypatch.setattr(server, "hello", lambda run, recording: b"x" * 50_000_000)  # nobody reads it to its end
        with page.stranger(HANDSHAKE), page.stranger(HANDSHAKE):
            wait_for(lambda: page.view._server._connections.granted == 2)
            assert viewers(page) == 0 and refused_with(page) == 503

    def test_who_says_nothing_makes_room_for_the_next(self, tmp_path, monkeypatch):
        """Idle connections lock nobody out; those of viewers are not theirs to take."""
        monkeypatch.setattr(connections, "MOST_CONNECTIONS", 4)
        monkeypatch.setattr(server, "OPEN_S", 600.0)  # they make room, and not because they were silent for so long
        with live_page(tmp_path) as page:
            with page.viewer() as viewer, ExitStack() as strangers:
                idle = [strangers.enter_context(page.stranger()) for _ in range(10)]
                assert get(page)[0] == 200
                for evicted in idle[:6]:
                    assert evicted.recv(1) == b""
                wait_for(lambda: len(page.view._server._connections) <= 4)
                with page.viewer() as another:
                    assert frame(another)[0]["kind"] == frame(viewer)[0]["kind"] == "hello"
            wait_for(lambda: not page.view._server._connections)
            assert get(page)[0] == 200

    @pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
    def test_what_ends_the_server_is_told_and_the_run_goes_on(self, page, monkeypatch):
        monkeypatch.setattr(server, "state", lambda *given: unthought_of)  # noqa: F821
        with page.viewer():
            wait_for(lambda: page.messages)
        page.play(5)
        assert not page.view._server.watched
        [event] = page.messages
        assert event.kind == "trouble" and "the live page has ended: NameError" in event.text

    def test_two_hundred_reconnects_leak_nothing(self, page, monkeypatch):
        """Garbage collection is off, as while the loop runs."""

        def come_and_go(number):
            with page.stranger(HANDSHAKE) as viewer:
                heard = b""
                while b'"hello"' not in heard:
                    heard += viewer.recv(10_000)
                if number % 2:  # as a browser that is closed; every other is killed
                    viewer.sendall(GOODBYE)
            if number % 20 == 0:
                assert get(page)[0] == 200

        def descriptors():
            return len(list(Path("/proc/self/fd").iterdir()))

        def tasks():
            return len(asyncio.all_tasks(page.view._server._loop))

        monkeypatch.setattr(server, "TIDY_S", 0.2)
        with uncollected(), page.playing():
            for number in range(20):
                come_and_go(number)
            wait_for(lambda: tasks() == 1)  # the server's own
            before = (threading.active_count(), descriptors())
            gc.collect()
            objects = len(gc.get_objects())
            for number in range(200):
                come_and_go(number)
            wait_for(lambda: tasks() == 1)
            assert (threading.active_count(), descriptors(), viewers(page)) == (*before, 0)
            with page.viewer() as viewer:
                wait_for(lambda: frame(viewer, "state") and len(gc.get_objects()) - objects < 2000)

    @pytest.mark.parametrize(
        "said",
        [
            b"",
            b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n",
            b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 2\r\n\r\n{}",
            b"\x16\x03\x01\x02\x00\r\n\r\n",
            HANDSHAKE.replace(b"localhost", b"stranger"),
            HANDSHAKE.replace(b"13", b"12"),
        ],
        ids=["connect", "get", "post", "garbage", "stranger", "version"],
    )
    def test_clients_leave_nothing_behind_where_nobody_watches(self, page, said, monkeypatch):
        """Garbage collection is off, as while the loop runs."""
        monkeypatch.setattr(server, "TIDY_S", 0.05)

        def come_and_go(count):
            for _ in range(count):
                with page.stranger(said) as stranger, suppress(ConnectionError):
                    while said and stranger.recv(1 << 16):
                        pass

        def objects():
            return len(gc.get_objects())

        with uncollected():
            come_and_go(20)
            wait_for(lambda: not page.view._server._connections)
            gc.collect()
            before = objects()
            come_and_go(300)
            wait_for(lambda: objects() - before < 1000)

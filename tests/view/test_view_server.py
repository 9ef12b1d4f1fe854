"""The live page over loopback, with real sockets."""

import asyncio
import gc
import http.client
import json
import socket
import threading
import time
from contextlib import ExitStack, suppress
from pathlib import Path

import numpy as np
import pytest
from view_samples import CONTRACT, HANDSHAKE, LONG_PING, TIMEOUT_S, Press, Swallowing, frame, live_page, wait_for
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from edge.errors import SinkError
from edge.perception.event import Event
from edge.pipeline.commands import Command, Commands
from edge.pipeline.pump import uncollected
from edge.view import connection_limits as connections
from edge.view import server
from edge.view import viewer_connection as attended
from edge.view.live_view import LiveView
from edge.view.static_page import SCRIPTS, load_page
from firmware_bridge.recording.formats import load_recording

GOODBYE = b"\x88\x80\x00\x00\x00\x00"
TOKEN = "correct-horse-battery"


@pytest.fixture
def page(tmp_path):
    with live_page(tmp_path) as page:
        yield page


def get(page, path="/", **headers):
    connection = http.client.HTTPConnection("127.0.0.1", page.port, timeout=TIMEOUT_S)
    try:
        connection.request("GET", path, headers=headers)
        response = connection.getresponse()
        return response.status, dict(response.getheaders()), response.read()
    finally:
        connection.close()


def refused_with(page, *arguments, **settings):
    with pytest.raises(InvalidStatus) as caught, page.viewer(*arguments, **settings):
        pass
    return caught.value.response.status_code


def viewers(page):
    return page.view._server.viewers


class TestPage:
    def test_one_file_without_outside_assets_and_nothing_else(self, page):
        status, headers, body = get(page)
        assert status == 200 and body == load_page().body and headers["Content-Type"].startswith("text/html")
        assert b"page.css" not in body and not any(name.encode() in body for name in SCRIPTS)
        policy = headers["Content-Security-Policy"]
        assert "default-src 'none'" in policy and "frame-ancestors 'none'" in policy and "connect-src 'self'" in policy
        assert "script-src 'sha256-" in policy  # whatever else finds its way into the page does not run
        assert headers["Referrer-Policy"] == "no-referrer" and headers["Cache-Control"] == "no-store"
        assert get(page, "/favicon.ico")[0] == 404
        assert get(page, "/ws")[0] == 426  # asked for like a page

    def test_strangers_names_and_pages_are_refused(self, page):
        ours = f"http://127.0.0.1:{page.port}"
        assert get(page, Host="evil.example")[0] == 403
        assert get(page, Origin="http://evil.example")[0] == 403
        assert refused_with(page, origin="http://evil.example") == 403
        assert refused_with(page, origin=f"http://127.0.0.1:{page.port + 1}") == 403
        with page.viewer(origin=ours) as viewer:
            assert frame(viewer)[0]["kind"] == "hello"

    def test_a_token_is_asked_of_the_socket(self, tmp_path):
        with live_page(tmp_path, token=TOKEN) as page:
            assert page.view.url == f"http://127.0.0.1:{page.port}/?token={TOKEN}"
            assert get(page)[0] == get(page, "/?token=" + TOKEN)[0] == 200, "the page is opened again without"
            assert refused_with(page) == 403 and refused_with(page, "?token=wrong-wrong-wrong") == 403
            with page.viewer(f"?token={TOKEN}") as viewer:
                assert frame(viewer)[0]["kind"] == "hello"

    def test_on_other_addresses_one_is_made(self, tmp_path):
        with live_page(tmp_path, host="0.0.0.0") as page:
            query = page.view.url.partition("?")[2]
            assert query.startswith("token=") and refused_with(page) == 403
            with page.viewer(f"?{query}"):
                pass

    @pytest.mark.parametrize(
        "request_",
        [
            b"\x16\x03\x01\x02\x00\r\n\r\n",
            b"POST / HTTP/1.1\r\nHost: localhost\r\n\r\n",
            b"GET / HTTP/1.1\r\n\r\n",
            b"GET / HTTP/1.1\r\nHost: localhost\r\nHost: localhost\r\n\r\n",
            b"GET /" + b"x" * 20_000,
        ],
    )
    def test_what_is_no_request_for_the_page_gets_none(self, page, request_):
        with page.stranger(request_) as stranger, suppress(ConnectionResetError):
            assert b" 200 " not in stranger.recv(1000)
        assert get(page)[0] == 200

    @pytest.mark.parametrize("method", ["POST", "PUT", "HEAD", "G", "GETS"])
    def test_another_method_is_answered_whatever_comes_behind_it(self, page, method):
        connection = http.client.HTTPConnection("127.0.0.1", page.port, timeout=TIMEOUT_S)
        connection.request(method, "/", body="x" * 5000)
        response = connection.getresponse()
        assert response.status == 405 and (method == "HEAD" or response.read() == b"only GET\n")
        connection.close()

    def test_a_request_byte_by_byte_is_one(self, page):
        with page.stranger() as stranger:
            stranger.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            for byte in b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n":
                stranger.sendall(bytes([byte]))
                time.sleep(0.001)
            assert stranger.recv(100).startswith(b"HTTP/1.1 200")

    def test_who_says_nothing_is_not_waited_for(self, tmp_path, monkeypatch):
        monkeypatch.setattr(server, "OPEN_S", 0.1)
        with live_page(tmp_path) as page, page.stranger(b"GET / HTTP/1.1\r\n") as stranger:
            assert stranger.recv(1000) == b""
            assert get(page)[0] == 200

    def test_a_port_in_use_is_one_line(self, page, tmp_path):
        words = (
            rf"no live page: port {page.port} of 127.0.0.1 is in use; name another with --view, or 0 for any free one"
        )
        with pytest.raises(SinkError, match=words):
            LiveView("127.0.0.1", page.port, None, tmp_path, CONTRACT, Commands())

    @pytest.mark.parametrize("host", ["192.0.2.1", "no-such-host.invalid"])
    def test_an_address_that_is_not_ours_is_one_line(self, tmp_path, host):
        with pytest.raises(SinkError, match=rf"no live page: {host} is no address of this machine; name one with"):
            LiveView(host, 0, None, tmp_path, CONTRACT, Commands())


class TestFrames:
    def test_hello_comes_first_and_says_that_it_is_emulated(self, page):
        page.play(3)
        with page.viewer() as viewer:
            header, _ = frame(viewer)
            assert header["kind"] == "hello" and (header["name"], header["source"]) == ("pretended", "emulated")
            assert frame(viewer, "result")[0]["source"] == "emulated"

    def test_results_are_sampled_and_the_pattern_is_the_loops(self, page):
        with page.viewer() as viewer, page.playing():
            began_s = time.monotonic()
            seen = [frame(viewer, "result") for _ in range(15)]
            took_s = time.monotonic() - began_s
        scans = [header["scan"] for header, _ in seen]
        assert sum(len(header["trace"]) for header, _ in seen) == scans[-1] + 1
        assert scans == sorted(set(scans))
        assert len(scans) <= took_s * 25 + 2
        shown = {header["scan"]: maps for header, maps in seen if "pattern" in maps}
        again = [result for result in Press().take(scans[-1] + 1) if result.scan.number in shown]
        assert len(again) > 3
        for result in again:
            np.testing.assert_array_equal(shown[result.scan.number]["pattern"], result.pattern)

    def test_a_frame_does_not_wait_for_the_one_before(self, page):
        with page.viewer() as viewer:
            frame(viewer, "state")
            (connection,) = page.view._server._viewers
            accepted = connection.transport.get_extra_info("socket")
            assert accepted.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)

    def test_state_comes_when_something_changes_and_every_second(self, page, monkeypatch):
        monkeypatch.setattr(server, "STATE_S", 0.05)
        with page.viewer() as first:
            assert frame(first, "state")[0] | {"maps": []} == {
                "kind": "state",
                "recording": None,
                "viewers": 1,
                "silent": {},
                "maps": [],
            }
            with page.viewer():
                wait_for(lambda: frame(first, "state")[0]["viewers"] == 2)
            wait_for(lambda: frame(first, "state")[0]["viewers"] == 1)
            page.play()
            wait_for(lambda: frame(first, "state")[0]["silent"].get("4", 0) >= 0.5)

    def test_events_reach_all_and_also_who_comes_later(self, page):
        with page.viewer() as first:
            for sink in page.view.sinks:
                sink.tell(Event(1, "lost", None, "gone"), {"outages": 1})
            assert frame(first, "event")[0]["note"] == "gone"
            with page.viewer() as second:
                assert frame(second, "event")[0]["note"] == "gone"

    def test_viewers_are_told_when_the_run_ends(self, tmp_path):
        with ExitStack() as run:
            page = run.enter_context(live_page(tmp_path))
            with page.viewer() as viewer:
                frame(viewer)
                run.close()
                with pytest.raises(ConnectionClosed) as caught:
                    while True:
                        viewer.recv(TIMEOUT_S)
        assert caught.value.rcvd is not None
        assert (caught.value.rcvd.code, caught.value.rcvd.reason) == (1001, "the run has ended")
        assert not any(thread.name == "live-view" for thread in threading.enumerate())

    def test_who_reads_nothing_and_who_says_nothing_hold_up_no_end(self, tmp_path, monkeypatch):
        monkeypatch.setattr(server, "OPEN_S", 60.0)
        with live_page(tmp_path) as page, page.stranger(), page.stranger(HANDSHAKE):
            wait_for(lambda: viewers(page) == 1)
            (watching,) = page.view._server._viewers
            page.view._server._loop.call_soon_threadsafe(watching.transport.write, bytes(50_000_000))
            closing = threading.Thread(target=page.view._server.close)
            closing.start()
            closing.join(20)  # it is over in one second, or in a minute at the earliest
            assert not closing.is_alive()


class TestCommands:
    def test_they_reach_the_loop(self, page):
        with page.viewer() as viewer:
            for command in ({"cmd": "zero", "sensor": "4"}, {"cmd": "reset"}):
                viewer.send(json.dumps(command))
            assert page.polled(2) == [Command("zero", "4"), Command("reset")]

    def test_what_is_none_is_answered_to_who_asked_alone(self, page):
        with page.viewer() as viewer, page.viewer() as other:
            viewer.send('{"cmd": "jump"}')
            answer = frame(viewer, "event")[0]
            assert answer["event"] == "refused" and "is no command: expected" in answer["note"]
            for sink in page.view.sinks:
                sink.tell(Event(1, "lost", None, "gone"), {})
            assert frame(other, "event")[0]["event"] == "lost"
        assert page.asked.refused == 1

    def test_one_that_is_too_long_ends_its_own_connection_alone(self, page):
        with page.viewer() as viewer, page.viewer() as other:
            viewer.send("x" * 5000)
            with pytest.raises(ConnectionClosed) as caught:
                while True:
                    viewer.recv(TIMEOUT_S)
            assert caught.value.rcvd is not None and caught.value.rcvd.code == 1009
            page.play()
            assert frame(other, "result")

    def test_who_never_stops_asking_is_heard_at_a_persons_pace(self, tmp_path):
        with ExitStack() as run:
            page = run.enter_context(live_page(tmp_path))
            with page.viewer() as viewer, page.viewer() as other:
                for _ in range(500):
                    viewer.send("{}")
                page.play()
                assert frame(other, "result")
                run.close()
            assert page.asked.refused < 250  # what waits is not heard to its end, either

    def test_pause_is_the_viewers_own(self, page):
        with page.viewer() as viewer, page.viewer() as other:
            viewer.send('{"cmd": "pause", "on": true}')
            viewer.send("is it so?")  # answered behind it
            frame(viewer, "event")
            with page.playing():
                frame(other, "result")
                viewer.send("and now?")
                while (header := frame(viewer)[0])["kind"] != "event":
                    assert header["kind"] == "state"
                viewer.send('{"cmd": "pause", "on": false}')
                header = frame(viewer, "result")[0]
            assert len(header["trace"]) > 1

    def test_record_is_told_to_all_and_makes_a_recording(self, page, tmp_path):
        with page.viewer() as viewer, page.viewer() as other:
            viewer.send('{"cmd": "record", "on": true}')
            wait_for(lambda: (page.asked.poll() == [] and page.wait()) or page.messages)
            path = frame(other, "event")[0]["note"].removeprefix("recording into ")
            wait_for(lambda: frame(other, "state")[0]["recording"] == path)
            page.play(5)
            viewer.send('{"cmd": "record", "on": false}')
            wait_for(
                lambda: (page.asked.poll(), page.wait()) and [e.text[:8] for e in page.messages][1:] == ["recorded"]
            )
            wait_for(lambda: frame(viewer, "state")[0]["recording"] is None)
        assert [len(track.counts) for track in load_recording(path).tracks] == [5]


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
        with page.viewer() as other, page.stranger(HANDSHAKE) as flood:
            with pytest.raises(ConnectionError):
                for _ in range(300_000_000 // 1000 // len(frame_)):
                    flood.sendall(1000 * frame_)
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
        monkeypatch.setattr(server, "OPEN_S", 600.0)  # they make room, and not because they said nothing for so long
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
        """Without garbage collection, as while the loop runs."""

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
        """Without garbage collection, as while the loop runs."""
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

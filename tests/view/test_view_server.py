"""The live page over loopback, with real sockets."""

import http.client
import json
import re
import socket
import threading
import time
from contextlib import ExitStack, suppress
from ipaddress import ip_address
from urllib.request import urlopen

import numpy as np
import pytest
from view_samples import (
    CONTRACT,
    HANDSHAKE,
    TIMEOUT_S,
    Press,
    frame,
    get,
    live_page,
    page,
    refused_with,
    viewers,
    wait_for,
)
from websockets.exceptions import ConnectionClosed

from edge.errors import SinkError
from edge.perception.event import Event
from edge.pipeline.commands import Command, Commands
from edge.view import server
from edge.view.live_view import LiveView
from edge.view.static_page import SCRIPTS, load_page
from firmware_bridge.recording.formats import load_recording

__all__ = ["page"]
TOKEN = "correct-horse-battery"


class TestPage:
    def test_one_file_without_outside_assets_and_nothing_else(self, page):
        status, headers, body = get(page)
        key = re.search(rb'name="edge-sr-key" content="([\w-]{22})"', body)
        assert (
            status == 200
            and body == load_page(key[1].decode()).body
            and headers["Content-Type"].startswith("text/html")
        )
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
            urls = [page.view.url, *page.view.other_urls]
            assert urls[-1] == f"http://{socket.gethostname()}:{page.port}/?{query}"
            for url in urls[:-1]:  # each is opened as a person on another machine does, if there is a network
                host = url.partition("//")[2].partition(":")[0]
                assert not ip_address(host).is_loopback and urlopen(url, timeout=5).status == 200

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
            rf"no live page: cannot listen on 127.0.0.1:{page.port}: address in use; "
            "name another port with --view, or 0 for any free one"
        )
        with pytest.raises(SinkError, match=words):
            LiveView("127.0.0.1", page.port, None, tmp_path, CONTRACT, Commands())

    @pytest.mark.parametrize("host", ["192.0.2.1", "no-such-host.invalid"])
    def test_an_address_that_is_not_ours_is_one_line(self, tmp_path, host):
        with pytest.raises(SinkError, match=rf"no live page: {host} is not an address of this machine; name one with"):
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
                "replay": None,
                "recorded_s": None,
                "recorded_bytes": None,
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
            assert answer["event"] == "refused" and "is not a command: expected" in answer["note"]
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
            assert page.asked.refused < 250  # what waits is not read to its end, either

    def test_pause_is_the_viewers_own(self, page):
        with page.viewer() as viewer, page.viewer() as other:
            viewer.send('{"cmd": "pause", "on": true}')
            viewer.send("is it so?")  # answered after it
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

"""The live page over loopback, with real sockets."""

import gc
import json
import socket
import threading
import time
from contextlib import ExitStack, suppress
from ipaddress import ip_address
from urllib.request import urlopen

import numpy as np
import pytest
from bridge_samples import make_counts, write_recording
from edge_samples import wait_for
from map_samples import letter, pixels_mm
from view_samples import HANDSHAKE, TIMEOUT_S, Mapped, Press, frame, get, live_page, page, refused_with, tell
from websockets.exceptions import ConnectionClosed

from edge.cli.main import main
from edge.view import server
from edge.view.server import SCRIPTS, load_page

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

    def test_strangers_names_and_pages_are_refused(self, page):
        ours = f"http://127.0.0.1:{page.port}"
        assert get(page, Host="evil.example")[0] == 403
        assert get(page, Origin="http://evil.example")[0] == 403
        assert refused_with(page, origin="http://evil.example") == 403
        assert refused_with(page, origin=f"http://127.0.0.1:{page.port + 1}") == 403
        with page.viewer(origin=ours) as viewer:
            assert frame(viewer)[0]["kind"] == "hello"

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

    @pytest.mark.parametrize(
        "request_",
        [
            b"\x16\x03\x01\x02\x00\r\n\r\n",
            b"GET / HTTP/1.1\r\n\r\n",
            b"GET / HTTP/1.1\r\nHost: localhost\r\nHost: localhost\r\n\r\n",
            b"GET /" + b"x" * 20_000,
            b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 2\r\n\r\n{}",
        ],
    )
    def test_what_is_no_request_for_the_page_gets_none(self, page, request_):
        with page.stranger(request_) as stranger, suppress(ConnectionResetError):
            assert b" 200 " not in stranger.recv(1000)
        assert get(page)[0] == 200

    def test_who_says_nothing_is_not_waited_for(self, limits):
        limits(server, OPEN_S=0.1)
        with live_page() as page, page.stranger(b"GET / HTTP/1.1\r\n") as stranger:
            assert stranger.recv(1000) == b""
            assert get(page)[0] == 200


class TestFrames:
    def test_results_are_sampled_and_the_pattern_is_the_loops(self, page):
        with page.viewer() as viewer, page.playing():
            began_s = time.monotonic()
            seen = [frame(viewer, "result") for _ in range(15)]
            took_s = time.monotonic() - began_s
            sockets = [one for one in gc.get_objects() if type(one) is socket.socket and one.fileno() >= 0]
            ours = [one for one in sockets if one.getsockname()[1:] == (page.port,)]
            # No frame waits for the one before it to be acknowledged.
            assert len(ours) == 2 and all(one.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY) for one in ours)
        scans = [header["scan"] for header, _ in seen]
        assert sum(len(header["trace"]) for header, _ in seen) == scans[-1] + 1
        assert scans == sorted(set(scans)) and seen[-1][0]["rate_hz"] == 100.0
        assert len(scans) <= took_s * 25 + 2
        shown = {header["scan"]: maps for header, maps in seen if "pattern" in maps}
        again = [result for result in Press().take(scans[-1] + 1) if result.scan.number in shown]
        assert len(again) > 3
        for result in again:
            np.testing.assert_array_equal(shown[result.scan.number]["pattern"], result.pattern)

    def test_state_comes_with_every_change_and_every_second(self, page, limits):
        limits(server, STATE_S=0.05)
        with page.viewer() as first:
            assert frame(first, "state")[0] == {"kind": "state", "viewers": 1, "silent": {}, "maps": []}
            with page.viewer():
                wait_for(lambda: frame(first, "state")[0]["viewers"] == 2)
            wait_for(lambda: frame(first, "state")[0]["viewers"] == 1)
            page.play()
            wait_for(lambda: frame(first, "state")[0]["silent"].get("4", 0) >= 0.5)

    def test_a_map_is_sent_whole_whenever_it_changes(self, page):
        mapped = Mapped(page, letter)
        page.play()
        with page.viewer() as viewer:
            for place, x_mm in enumerate((-12.0, -11.0, 0.0)):
                mapped.touch(x_mm, 0.0)
                header, maps = frame(viewer, "map")
                whole = maps["contact"]
                assert np.array_equal(whole, mapped.sink.whole.layers().contact, equal_nan=True)
                assert (header["size_mm"], header["pads"]) == (60.0, {"4": [x_mm, 0.0, 0.0]})
                assert header["counts"]["fused"] == place
            mapped.touch(0.0, 0.0, pattern=None, contact=False)  # the end of the press, at the same place
            mapped.touch(0.0, 0.0, pattern=None, contact=False)
            assert wait_for(lambda: frame(viewer, "map"))[0]["counts"]["fused"] == 3
        x_mm, y_mm = pixels_mm(mapped.sink.whole.grid)
        assert (whole[(letter(x_mm, y_mm) == 0) & (np.abs(y_mm) < 8) & (np.abs(x_mm + 12) < 3)] > 0.9).all()

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
        assert threading.active_count() == threads


class TestAsked:
    def test_events_reach_all_and_a_refusal_who_asked_alone(self, page):
        with page.viewer() as first, page.viewer() as other:
            first.send('{"cmd": "jump"}')
            answer = frame(first, "event")[0]
            assert answer["event"] == "refused" and "is not a command: expected" in answer["note"]
            tell(page, "lost", None, "gone")
            assert frame(first, "event")[0]["note"] == frame(other, "event")[0]["note"] == "gone"
            with page.viewer() as late:
                assert frame(late, "event")[0]["note"] == "gone"
        assert page.asked.refused == 1

    def test_a_message_that_is_too_long_ends_its_own_connection_alone(self, page):
        with page.viewer() as viewer, page.viewer() as other:
            viewer.send("x" * 5000)
            with pytest.raises(ConnectionClosed) as caught:
                while True:
                    viewer.recv(TIMEOUT_S)
            assert caught.value.rcvd is not None and caught.value.rcvd.code == 1009
            page.play()
            assert frame(other, "result")

    def test_who_never_stops_asking_is_heard_at_a_persons_pace(self):
        with ExitStack() as run:
            page = run.enter_context(live_page())
            with page.viewer() as viewer, page.viewer() as other:
                for _ in range(500):
                    viewer.send(json.dumps({}))
                page.play()
                assert frame(other, "result")
                run.close()
            assert page.asked.refused < 250  # what waits is not read to its end, either


def test_a_port_in_use_is_one_line_and_5(capsys):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert main(["--source", "slcan:/dev/no-such-port", "--view", str(port)]) == 5
    assert capsys.readouterr().err == (
        f"edge-sr: no live page: cannot listen on 127.0.0.1:{port}: address in use; "
        "name another port with --view, or 0 for any free one\n"
    )


def test_a_recording_with_a_page_is_played_as_if_live(tmp_path):
    path = write_recording(tmp_path / "press.csv", make_counts(20), rate_hz=1000)
    for number, (options, live) in enumerate((([], False), (["--paced"], True), (["--view", "0"], True))):
        records, begun_ns = tmp_path / f"{number}.jsonl", time.monotonic_ns()
        assert main(["replay", str(path), "--sink", f"jsonl:{records}", *options]) == 0
        first = json.loads(records.read_text().splitlines()[0])
        assert (first["time_ns"] >= begun_ns) == live, options

import contextlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from bridge_samples import (
    REST_COUNTS,
    make_counts,
    make_recording,
    read_scans,
    read_until_lost,
    stacked,
    write_recording,
)
from edge_samples import ROOT
from websockets.protocol import State

from edge.cli import main as cli
from firmware_bridge.emulation import xela_server_main as server_emulator
from firmware_bridge.emulation.xela_server_emulator import ServerEmulator
from firmware_bridge.emulation.xela_server_model import GARBAGE, VERSIONS, VendorServer, sim_recording
from firmware_bridge.errors import DeviceError, LinkLostError, SourceError
from firmware_bridge.links import xela_server
from firmware_bridge.links.parse import open_source, open_sources
from firmware_bridge.links.xela_server import XelaServerLink, server_address
from firmware_bridge.scans.xela_server_messages import LONGEST_MESSAGE_BYTES


def looping(**options) -> VendorServer:
    return VendorServer([make_recording(50)], loop=True, **options)


@pytest.mark.parametrize("version", VERSIONS)
def test_every_scan_comes_once_and_in_order(version):
    recordings = [make_recording(30, seed=1), make_recording(30, seed=2)]
    with ServerEmulator(VendorServer(recordings, version=version)) as server, XelaServerLink(server.url) as link:
        scans = read_until_lost(link)
        assert server.lost_messages == 0 and link.version == f"{version}_emulated"
    for sensor, recording in zip(("1", "2"), recordings, strict=True):
        mine = [scan for scan in scans if scan.sensor == sensor]
        assert [scan.number for scan in mine] == list(range(30))
        assert (stacked(scans, sensor) == recording.tracks[0].counts).all()
        times = [scan.time_ns for scan in mine]
        assert times == sorted(times)
        assert all(scan.device_ns is not None and scan.device_ns <= scan.time_ns for scan in mine)
        assert all(scan.vendor_force_n is not None for scan in mine)
        has_temperature = [scan.vendor is not None and scan.vendor.temperature_k is not None for scan in mine]
        assert has_temperature == [version == "1.8.0"] * 30
    counters = {name: count for name, count in link.counters().items() if count and name != "received_bytes"}
    assert counters == {"messages": 31, "welcomes": 1, "scans": 60}


def test_what_it_says_about_itself():
    link = XelaServerLink("ws://robot")
    assert (link.name, link.kind, link.ended, link.url) == (
        "xela-server:ws://robot",
        "device",
        False,
        "ws://robot:5000",
    )
    with pytest.raises(ValueError, match="with statement"):
        link.read(0)
    with ServerEmulator(looping()) as server:
        link = XelaServerLink(server.url)
        with link as entered:
            assert entered is link and link.kind == "emulated"  # a server of ours does not pass for the vendor's


def test_garbage_costs_itself_alone():
    recording = make_recording(40)
    with ServerEmulator(VendorServer([recording]), garbage_every=2) as server, XelaServerLink(server.url) as link:
        scans = read_until_lost(link)
        counters = link.counters()
    assert (stacked(scans, "1") == recording.tracks[0].counts).all()
    assert counters["bad_json"] >= 5 and counters["bad_sequence"] >= 2 and counters["duplicate_keys"] >= 1
    assert counters["messages"] == 1 + 40 + 20 and len(GARBAGE) <= 20


def test_a_client_that_does_not_read_gets_what_is_old_and_is_told():
    with ServerEmulator(looping()) as server, XelaServerLink(server.url) as link:
        read_scans(link, 1)
        sent = server.sent_messages
        wait_for(lambda: server.sent_messages > sent + 30)
        while not server.lost_messages:
            server.say(" " * 200_000)  # fills what the kernel and the server keep
        wait_for(lambda: server.lost_messages > 30)
        end_s = time.monotonic() + 60
        while not link.counters()["missed_messages"]:
            link.read(0.1)
            assert time.monotonic() < end_s
        assert link.counters()["stale_scans"] > 0


def wait_for(condition, timeout_s=60.0):
    end_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.01)


def test_what_fails_while_it_is_opened_leaves_nothing_open(monkeypatch):
    def fail(link, timeout_s):
        raise LinkLostError("gone")

    monkeypatch.setattr(XelaServerLink, "_take", fail)
    with ServerEmulator(looping()) as server:
        with pytest.raises(LinkLostError):
            XelaServerLink(server.url).__enter__()
        wait_for(lambda: not server._server._clients)


# The server goes, hangs, comes back.


def lose(link):
    """What the link says when it is lost."""
    end_s = time.monotonic() + 60
    while time.monotonic() < end_s:
        try:
            link.read(0.05)
        except LinkLostError as lost:
            return str(lost)
    raise AssertionError("the link was never lost")


def test_a_server_killed_and_restarted():
    """As often as it likes; scans go on being numbered, messages are counted from 0."""
    with ServerEmulator(looping()) as server:
        link = XelaServerLink(server.url)
        numbers = []
        for _ in range(3):
            with link:
                numbers += [scan.number for scan in read_scans(link, 5)]
                server.kill()
                assert lose(link) == f"{server.url}: link lost: the server is gone"
            with pytest.raises(DeviceError, match="connection refused"):
                link.__enter__()
            server.start_again()
        assert numbers == sorted(set(numbers)) and len(numbers) >= 15
        counters = link.counters()
        assert counters["reordered_messages"] == counters["server_restarts"] == counters["missed_messages"] == 0


def read_notices(link, count):
    """The first notices, at least `count`."""
    notices = []
    end_s = time.monotonic() + 60
    while len(notices) < count:
        assert time.monotonic() < end_s, notices
        link.read(0.05)
        notices += link.notices()
    return notices


def test_it_is_opened_again_until_the_server_is_back():
    with ServerEmulator(looping()) as server, open_sources([f"finger=xela-server:{server.url}"])[0] as link:
        assert read_scans(link, 3)[0].vendor_force_n is not None
        server.kill()
        notices = read_notices(link, 1)
        server.start_again()
        scans = read_scans(link, 3)
        assert {scan.sensor for scan in scans} == {"finger/1"} and scans[0].complete
        assert [notice.kind for notice in notices + link.notices()] == ["lost", "back"]


def test_a_dead_sensor_is_told_of_once_and_not_taken_for_back():
    vendor = looping()
    with ServerEmulator(vendor) as server, open_sources([f"xela-server:{server.url}"])[0] as link:
        read_scans(link, 3)
        vendor.silent = frozenset(range(16))
        notices = read_notices(link, 2)
        wait_for(lambda: not link.read(0.05) and link.counters()["reopenings"] >= 2)
        assert [notice.kind for notice in notices + link.notices()] == ["silent", "trouble"]
        assert "nothing comes of sensor 1" in notices[1].text


def test_a_server_that_counts_anew_without_closing():
    with ServerEmulator(looping()) as server, XelaServerLink(server.url) as link:
        read_scans(link, 2)
        server.count_from(1000)
        wait_for(lambda: link.read(0.05) and link.counters()["missed_messages"] > 900)
        server.count_from(0)
        server.say('{"message": "Welcome"}')
        wait_for(lambda: link.read(0.05) and link.counters()["server_restarts"] == 1)


def test_a_server_that_closes_says_why():
    with ServerEmulator(looping()) as server, XelaServerLink(server.url) as link:
        server.close_all(1012, "service restart")
        assert "the server closed it (code 1012, 'service restart')" in lose(link)


def test_a_half_open_connection_is_seen(monkeypatch):
    monkeypatch.setattr(xela_server, "SERVER_QUIET_S", 0.1)
    monkeypatch.setattr(xela_server, "ANSWER_S", 0.2)
    with ServerEmulator(looping()) as server:
        link = XelaServerLink(server.url)
        with link:
            read_scans(link, 5)
            server.freeze()
            assert "silent, and no answer within 0.2 s" in lose(link)
        server.thaw()
        with link:
            assert read_scans(link, 5)


def test_a_connection_that_closes_just_before_it_is_asked_is_a_lost_link(monkeypatch):
    monkeypatch.setattr(xela_server, "SERVER_QUIET_S", 0.0)
    with ServerEmulator(looping()) as server, XelaServerLink(server.url) as link:
        read_scans(link, 1)
        server.kill()
        connection = link._connection
        assert connection is not None
        wait_for(lambda: connection.protocol.state is State.CLOSED)

        def hear_nothing(*args, **kwargs):
            raise TimeoutError

        monkeypatch.setattr(connection, "recv", hear_nothing)
        assert lose(link) == f"{server.url}: link lost: the server is gone"


def test_a_server_with_nothing_to_say_is_no_lost_link(monkeypatch):
    """It answers when it is asked, and is not asked while it talks."""
    monkeypatch.setattr(xela_server, "ANSWER_S", 0.2)
    with ServerEmulator(looping(), message_hz=0.2) as server, XelaServerLink(server.url) as link:
        link.read(0.1)
        asked = []
        ping = link._connection.ping
        monkeypatch.setattr(link._connection, "ping", lambda: asked.append(None))
        monkeypatch.setattr(xela_server, "SERVER_QUIET_S", 60.0)
        assert not any(link.read(0.01) for _ in range(3)) and not asked
        monkeypatch.setattr(xela_server, "SERVER_QUIET_S", 0.05)
        monkeypatch.setattr(link._connection, "ping", lambda: asked.append(ping()) or asked[-1])
        wait_for(lambda: link.read(0.02) is not None and len(asked) >= 4)
        assert all(pong.wait(1) for pong in asked[:-1])


def test_a_server_that_talks_but_answers_no_ping_is_kept(monkeypatch):
    monkeypatch.setattr(xela_server, "SERVER_QUIET_S", 0.0)
    now_ns = [0]
    with ServerEmulator(looping()) as server, XelaServerLink(server.url, clock_ns=lambda: now_ns[0]) as link:
        asked = []
        monkeypatch.setattr(link._connection, "ping", lambda: asked.append(threading.Event()) or asked[-1])
        for _ in range(10):
            assert link.read(20.0) is not None
            now_ns[0] += round(2 * xela_server.ANSWER_S * 1e9)
        assert len(asked) >= 9


def test_a_message_too_long_ends_the_link():
    with ServerEmulator(looping()) as server, XelaServerLink(server.url) as link:
        server.say("x" * (LONGEST_MESSAGE_BYTES + 1))
        assert "what no xela_server sends: " in lose(link)


def test_binary_messages_are_messages():
    with ServerEmulator(looping(), message_hz=0.1) as server, XelaServerLink(server.url) as link:
        server.say(looping().message(7, 0.5, 1e9).encode())
        assert read_scans(link, 1)


# Sensors.


def test_sensors_of_other_shapes_are_left_out():
    with ServerEmulator(looping(others=[("uSPa46", 24)])) as server, XelaServerLink(server.url) as link:
        assert {scan.sensor for scan in read_scans(link, 5)} == {"1"}
        assert link.trouble == "sensor 2 is left out: 'uSPa46' with 24 taxels, expected 16"


def test_a_server_with_none_that_fits_is_an_error_not_silence():
    server = VendorServer([], others=[("uSPa46", 24)], loop=True)
    words = r"no sensor that can be used: sensor 1 is left out: 'uSPa46'"
    with (
        ServerEmulator(server) as emulator,
        pytest.raises(DeviceError, match=words) as refused,
        XelaServerLink(emulator.url) as link,
    ):
        read_scans(link, 1)
    assert not isinstance(refused.value, LinkLostError)  # another try would not help


def test_taxels_that_fall_silent_are_absent():
    vendor = looping()
    with ServerEmulator(vendor) as server, XelaServerLink(server.url) as link:
        read_scans(link, 3)
        vendor.silent = frozenset({2, 3})
        wait_for(lambda: any(not scan.complete for scan in link.read(0.05)))
        assert all(np.flatnonzero(~scan.fresh).tolist() == [2, 3] for scan in read_scans(link, 5))
        vendor.silent = frozenset(range(16))
        wait_for(lambda: not link.read(0.05) and not link.read(0.05))
        assert link.counters()["messages"] > 0 and link.trouble is None
        wait_for(lambda: not link.read(0.05) and link.trouble)
        assert link.trouble == "nothing comes of sensor 1: see to its cable and its power"
        vendor.silent = frozenset()
        wait_for(lambda: any(scan.whole for scan in link.read(0.05)))


# What goes wrong before anything is open.


@contextlib.contextmanager
def listening(answer):
    """A server that is none: gives `answer` (None: nothing) to whoever connects."""
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
        (HTTP % (b"101 Switching Protocols", b""), "is no xela_server"),
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


# The whole program.


def test_edge_sr_reads_a_server(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(sys, "stdin", None)
    records = tmp_path / "records.jsonl"
    still = make_recording(130, rate_hz=200.0)
    still.tracks[0].counts[:] = REST_COUNTS + np.random.default_rng(1).integers(0, 5, still.tracks[0].counts.shape)
    with ServerEmulator(VendorServer([still], loop=True), message_hz=200) as server:
        code = cli.main(["--source", f"xela-server:{server.url}", "--sink", f"jsonl:{records}", "--duration-s", "2"])
    assert code == 0, capsys.readouterr().err
    lines = [json.loads(line) for line in records.read_text().splitlines()]
    assert {line["source"] for line in lines} == {"emulated"}
    # A machine that stands still for a moment tells of a silent server: an event, of no sensor.
    assert {line["sensor"] for line in lines if line["state"] != "event"} == {"1"}
    idle = [line for line in lines if line["state"] == "idle"]
    assert idle and all(line["force_n"] == line["vendor_force_n"][2] for line in idle)
    assert {line["temperature_k"] for line in idle} == {302.5}
    assert "missed_messages" in idle[-1]["counters"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "nothing to serve: name a recording, or --sim"),
        (["--sim", "--other", "uSPa46"], "'uSPa46' is no MODEL:TAXELS, such as uSPa46:24"),
        (["--sim", "--spread", "2"], "spread is 2.0"),
        (["--sim", "--message-hz", "0"], "messages a second are 0.0"),
        (["--sim", "--host", "0.0.0.0"], "unrecognized arguments: --host"),
        (["--sim", "--port", "99999"], "'99999' is no port, expected 0..65535"),
        (["--sim", "--port", "-1"], "'-1' is no port"),
        (["--sim", "--down-s", "-1"], "'-1' is no time, expected 0..1e+06 s"),
        (["--sim", "--kill-after-s", "nan"], "'nan' is no time"),
        (["--sim", "--freeze-after-s", "soon"], "'soon' is no time"),
        (["--sim", "--garbage-every", "-2"], "'-2' is no number of messages"),
        (["gone.csv"], "gone.csv: cannot be read"),
    ],
)
def test_the_emulator_refuses_in_one_line(arguments, words, capsys):
    with pytest.raises(SystemExit):
        server_emulator.main(arguments)
    assert words in capsys.readouterr().err.splitlines()[-1]


def test_ctrl_c_ends_the_emulator_quietly(monkeypatch, capsys):
    def interrupt(emulator, timeout_s):
        raise KeyboardInterrupt

    monkeypatch.setattr(ServerEmulator, "wait", interrupt)
    assert server_emulator.main(["--sim"]) == 130
    told = capsys.readouterr()
    assert told.out.startswith("ws://127.0.0.1:") and not told.err


def test_simulation_mode_looks_like_a_sensor():
    """Nothing in its messages says what it is; of ours, only the version does."""
    with ServerEmulator(VendorServer([sim_recording()], loop=True)) as server, XelaServerLink(server.url) as link:
        assert read_scans(link, 5)[-1].complete and link.trouble is None


def test_the_emulator_by_hand(tmp_path):
    path = write_recording(tmp_path / "made.csv", make_counts(20), rate_hz=100.0)
    command = [
        sys.executable,
        "-m",
        "firmware_bridge.emulation.xela_server_main",
        str(path),
        "--loop",
        "--until-stdin-closes",
    ]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        command, cwd=ROOT, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None and process.stdin is not None
        assert select.select([process.stdout], [], [], 20)[0]
        link = XelaServerLink(process.stdout.readline().strip())
        with link:
            assert read_scans(link, 5)
            process.send_signal(signal.SIGKILL)
            assert "the server is gone" in lose(link)
        process.stdin.close()

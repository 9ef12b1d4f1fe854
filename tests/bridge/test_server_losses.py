"""Losses of a server: it goes, hangs and comes back."""

import threading

import pytest
from bridge_samples import (
    read_scans,
)
from server_samples import looping, lose, read_notices, wait_for
from websockets.protocol import State
from xela_server_emulator import ServerEmulator

from firmware_bridge.errors import DeviceError
from firmware_bridge.links import xela_server
from firmware_bridge.links.registry import open_sources
from firmware_bridge.links.xela_server import XelaServerLink
from firmware_bridge.scans.xela_server_messages import LONGEST_MESSAGE_BYTES


def test_a_server_killed_and_restarted():
    """Restarts may come any number of times; scan numbers go on, messages are counted from 0."""
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
        assert "nothing arrives from sensor 1" in notices[1].text


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
        assert lose(link).startswith(f"{server.url}: link lost: ")


def test_a_server_with_nothing_to_say_is_no_lost_link(monkeypatch):
    """The server answers pings, and is not asked while it sends."""
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
        assert "a message that no xela_server sends: " in lose(link)


def test_binary_messages_are_messages():
    with ServerEmulator(looping(), message_hz=0.1) as server, XelaServerLink(server.url) as link:
        server.say(looping().message(7, 0.5, 1e9).encode())
        assert read_scans(link, 1)

"""Advice for a port that gives no scan: real ports on which something else speaks, or nothing."""

import os
import pty
import re
import threading
import tty

import pytest

from edge.pipeline.silence_hint import silence_hint
from firmware_bridge.links.slcan_serial import SlcanSerialLink

ELSE = "bytes came, and no CAN frame in them: "
CAN = (b"t1238AABBCCDDEEFF0011\r", b"t4008AABBCCDDEEFF0011\r")


def gps(port, over):
    while not over.wait(0.01):
        os.write(port, b"$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\r\n")


def another_speed(port, over):
    while not over.wait(0.01):
        os.write(port, bytes(range(0, 256, 5)) + b"\r")


def line_feeds(port, over):
    while not over.wait(0.01):
        os.write(port, b"12.25\t-3.25\t41.25\t0.25\t-17.25\n")


def motors(port, over):
    while not over.wait(0.01):
        os.write(port, CAN[0])


@pytest.mark.parametrize(
    ("speaks", "words"),
    [
        (gps, f"{ELSE}text of another device"),
        (line_feeds, f"{ELSE}no line that ends as an adapter's: another device, such as one whose lines end with LF"),
        (another_speed, f"{ELSE}no text: another line speed"),
        (motors, "CAN frames came, and "),
    ],
)
def test_what_is_wrong_is_read_from_what_came(speaks, words):
    leader, follower = pty.openpty()
    tty.setraw(follower)
    over, name = threading.Event(), os.ttyname(follower)
    speaker = threading.Thread(target=speaks, args=(leader, over))
    speaker.start()
    try:
        link = SlcanSerialLink(name)
        for _ in range(2):  # as a run does while no scan comes
            with link:
                for _ in range(4):
                    assert link.read(0.01) == []
        hint = silence_hint([f"slcan:{name}"], link.counters)
    finally:
        over.set()
        os.write(follower, b"\r")
        speaker.join()
        os.close(leader), os.close(follower)
    assert words in hint
    assert f"edge-sr doctor --source slcan:{name}" in hint or "edge-sr devices" in hint


@pytest.mark.parametrize(
    ("counters", "words"),
    [
        (
            {"messages": 30, "without_readings": 29, "welcomes": 1},
            "30 messages came from the server, and no reading in them: they name no sensor",
        ),
        ({"messages": 30, "foreign_sensor": 30}, "no reading in them: their sensors are of another pad: --id-map"),
        ({"messages": 9, "bad_json": 9, "received_bytes": 99}, "they are no JSON: another server"),
        ({"messages": 1, "welcomes": 1}, "the server only greets"),
        ({"messages": 5}, "no whole scan in them"),
        ({"received_bytes": 12, "replies": 4}, "12 bytes came, the adapter's answers alone: is the sensor powered"),
        ({"received_bytes": 12, "refusals": 3}, "the adapter refused 3 commands"),
        ({"frames": 0, "error_frames": 7}, "7 error frames .* another bitrate"),
        ({"frames": 90, "foreign": 90}, "90 CAN frames came, and none of a taxel"),
    ],
)
def test_what_came_goes_before_advice(counters, words):
    hint = silence_hint(["xela-server:robot"], lambda: counters)
    assert re.search(words, hint) and "edge-sr doctor --source xela-server:robot" in hint

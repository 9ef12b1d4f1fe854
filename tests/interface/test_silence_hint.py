"""Advice for a port that gives no scan: real ports on which something else speaks, or nothing."""

import os
import pty
import threading
import tty

import pytest

from edge.cli.silence_hint import silence_hint
from firmware_bridge.links.slcan_serial import SlcanSerialLink

ELSE = "no CAN frame in them: this port is of another device"
CAN = (b"t1238AABBCCDDEEFF0011\r", b"t4008AABBCCDDEEFF0011\r")


def gps(port, over):
    while not over.wait(0.01):
        os.write(port, b"$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\r\n")


def modem(port, over):
    while not over.is_set():
        os.write(port, os.read(port, 100) + b"\r\nERROR\r\n")


def another_speed(port, over):
    while not over.wait(0.01):
        os.write(port, bytes(range(0, 256, 5)) + b"\r")


def motors(port, over):
    while not over.wait(0.01):
        os.write(port, CAN[0])


def nothing(port, over):
    over.wait()


@pytest.mark.parametrize(
    ("speaks", "words"),
    [
        (gps, ELSE),
        (modem, ELSE),
        (another_speed, ELSE),
        (motors, "CAN frames came, and "),
        (nothing, "is the sensor powered and its cable in?"),
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

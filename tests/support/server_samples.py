"""Messages of a server made by hand, and helpers for the tests of its link."""

import json
import time

import numpy as np
from bridge_samples import REST_COUNTS, make_recording
from xela_server_emulator import VendorServer

from firmware_bridge.errors import LinkLostError

UNIX_S = 1_768_365_606.25
MS = 1_000_000


def sensor_entry(counts: np.ndarray = REST_COUNTS, *, ups=100.0, time_s=UNIX_S, **changes) -> dict:
    """Return the entry of a server 1.8.0 about one sensor; a change to None leaves the key out."""
    values = np.asarray(counts).reshape(3, 16).T.ravel().tolist()
    entry = {
        "time": time_s,
        "sensor": "1",
        "data": ",".join(f"{value:04X}" for value in values),
        "model": "uSPa44",
        "taxels": 16,
        "calibrated": [0.125] * 48,
        "integer": values,
        "temp": [301.5] * 16,
        "ups": [ups] * 16 if isinstance(ups, float) else ups,
        "extradots": [["1.0", "1.42", "21.62"]],
    }
    return {key: value for key, value in (entry | changes).items() if value is not None}


def message(sequence: object, *entries: dict, time_s: object = UNIX_S, **more) -> str:
    """Return a message about sensors 1, 2, ..."""
    sensors = {str(number): entry for number, entry in enumerate(entries, 1)}
    return json.dumps({"message": sequence, "time": time_s, "version": "1.8.0b_208601", **sensors, **more})


def looping(**options) -> VendorServer:
    return VendorServer([make_recording(50)], loop=True, **options)


def lose(link):
    """Read until the link is lost, and return its error's text."""
    end_s = time.monotonic() + 60
    while time.monotonic() < end_s:
        try:
            link.read(0.05)
        except LinkLostError as lost:
            return str(lost)
    raise AssertionError("the link was never lost")


def read_notices(link, count):
    """Return the first notices, at least `count`."""
    notices = []
    end_s = time.monotonic() + 60
    while len(notices) < count:
        assert time.monotonic() < end_s, notices
        link.read(0.05)
        notices += link.notices()
    return notices

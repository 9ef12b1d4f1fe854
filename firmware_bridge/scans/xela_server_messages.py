"""Decoder from messages of the vendor's server to readings. No I/O, no clock.

A message is a JSON object: `message`, a number that counts up, or "Welcome"; `time` of sending, in [s] of the server's
clock; and under "1", "2", ... the last reading of each sensor, new or not: `data`, the counts x, y, z of one taxel
after the other, row by row from the top left. Versions differ:

    1.7.6   data "8197,829A,..."       hexadecimal
    1.7.7   data [33175, 33434, ...]   and "welcome" as `type` of every message, so that `type` has no use
    1.8.0   data hexadecimal, and the same as `integer`, which is not read

`ups`, the updates a second of a taxel, is the sign of life, together with a `time` of the sensor that moves on.
`calibrated` (in newtons), `temp` (in kelvin) and `ups` are absent, null or zeros where the server has no value.

No content is trusted: a message that cannot be used is counted by its error, and nothing is raised.
"""

import json
import math
import re
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.pad_geometry import USPA44, SensorGeometry
from firmware_bridge.scans.scan import HIGHEST_COUNT

LONGEST_MESSAGE_BYTES: Final = 1 << 18  # most bytes of a message: sixteen sensors with every field take a third of it
MOST_SENSORS: Final = 16
HIGHEST_UPS_HZ: Final = 10_000.0
HIGHEST_NEWTONS: Final = 1000.0
KELVIN: Final = (200.0, 500.0)
WELCOME: Final = "Welcome"
# Messages without a valid sequence number are "bad_json"; sensors without valid counts "bad_sensor", those of another
# geometry "foreign_sensor"; forces, temperatures, rates and times that are left out "bad_values".
_COUNTED: Final = (
    *("messages", "welcomes", "without_readings", "bad_json"),
    *("bad_sensor", "foreign_sensor", "bad_values"),
)


class ServerReading(NamedTuple):
    """Last reading of one sensor in the server."""

    sensor: str  # number of the sensor in the server, such as "1"
    counts: NDArray[np.int32]  # (3, taxels) int32, axes x, y, z
    ups_hz: Sequence[float] | None  # rate at which each taxel is renewed, in [Hz]
    newtons: NDArray[np.float32] | None  # (3, rows, cols), by the vendor's calibration, in [N]
    temperature_k: NDArray[np.float32] | None  # (rows, cols), in [K], NaN where not reported
    acquired_s: float | None  # time at which it was read from the sensor, in [s] of the server's clock


class ServerMessage(NamedTuple):
    """One message. `sequence` is None for a welcome and a bad message; `sent_s` is by the server's clock."""

    sequence: int | None = None
    sent_s: float | None = None
    readings: tuple[ServerReading, ...] = ()


class ServerDecoder:
    """Decoder of single messages, of any version of the server."""

    def __init__(self, geometry: SensorGeometry = USPA44) -> None:
        self.foreign: dict[str, str] = {}  # what the server calls sensors of another geometry, by name
        self._geometry = geometry
        self._counted: dict[str, int] = dict.fromkeys(_COUNTED, 0)

    def decode(self, text: str | bytes) -> ServerMessage:
        """Decode one message, as text or in UTF-8."""
        self._counted["messages"] += 1
        try:
            content = json.loads(text)
        except (ValueError, RecursionError):  # no JSON, no UTF-8, a number too long for int(), or brackets in brackets
            content = None
        content = content if isinstance(content, dict) else {}
        sequence = content.get("message")
        if sequence == WELCOME:
            self._counted["welcomes"] += 1
            return ServerMessage()
        if type(sequence) is not int or not 0 <= sequence < 1 << 63:
            self._counted["bad_json"] += 1
            return ServerMessage()
        named = [name for name, value in content.items() if _is_name(name) and isinstance(value, dict)]
        self._counted["without_readings"] += not named
        self._counted["bad_sensor"] += max(0, len(named) - MOST_SENSORS)
        readings = [self._reading(name, content[name]) for name in named[:MOST_SENSORS]]
        usable = tuple(reading for reading in readings if reading is not None)
        return ServerMessage(sequence, self._time_s(content.get("time")), usable)

    def counters(self) -> dict[str, int]:
        """Return the counts of messages and of their errors."""
        return dict(self._counted)

    def _reading(self, name: str, content: dict[str, Any]) -> ServerReading | None:
        shape, count = self._geometry.scan_shape, self._geometry.taxel_count
        taxels, data = content.get("taxels"), content.get("data")
        if type(taxels) is int and 0 < taxels != count:
            model = content.get("model")
            model = repr(model[:20]) if isinstance(model, str) else "a model without a name"
            self.foreign[name] = f"{model} with {min(taxels, 9999)} taxels"
            self._counted["foreign_sensor"] += 1
            return None
        counts = _from_hex(data) if isinstance(data, str) else data
        right = type(taxels) is int and taxels == count and _are_numbers(counts, 3 * count, (0, HIGHEST_COUNT), {int})
        if not right:
            self._counted["bad_sensor"] += 1
            return None
        self.foreign.pop(name, None)
        newtons = self._in_range(content.get("calibrated"), 3 * count, (-HIGHEST_NEWTONS, HIGHEST_NEWTONS))
        by_axis = None if newtons is None else np.array(newtons, dtype=np.float32).reshape(-1, 3).T
        return ServerReading(
            name,
            np.ascontiguousarray(np.array(counts, dtype=np.int32).reshape(-1, 3).T),
            self._in_range(content.get("ups"), count, (0, HIGHEST_UPS_HZ)),
            None if by_axis is None else np.ascontiguousarray(by_axis).reshape(shape),
            self._temperature_k(content.get("temp")),
            self._time_s(content.get("time")),
        )

    def _temperature_k(self, content: object) -> NDArray[np.float32] | None:
        kelvin = self._in_range(content, self._geometry.taxel_count, (0, KELVIN[1]))
        if kelvin is None or not any(kelvin):  # zeros: the sensor has no thermometer
            return None
        if min(taxel_k for taxel_k in kelvin if taxel_k) < KELVIN[0]:
            self._counted["bad_values"] += 1
            return None
        measured = np.array([taxel_k or math.nan for taxel_k in kelvin], dtype=np.float32)
        return measured.reshape(self._geometry.rows, self._geometry.cols)

    def _in_range(self, content: Any, size: int, ends: tuple[float, float]) -> Sequence[float] | None:
        """Return a list of `size` numbers in a range; None, and count it, if it is another thing than None."""
        if _are_numbers(content, size, ends, {int, float}):
            return content
        self._counted["bad_values"] += content is not None
        return None

    def _time_s(self, content: object) -> float | None:
        if isinstance(content, bool) or not isinstance(content, (int, float)) or not 0 < content < 1e11:  # since 1970
            self._counted["bad_values"] += content is not None
            return None
        return float(content)


def _is_name(key: str) -> bool:
    return 0 < len(key) <= 3 and key.isascii() and key.isdigit()


def _from_hex(text: str) -> list[int] | None:
    # Not int() alone: it takes signs, spaces, underscores and 0x as well.
    if not re.fullmatch("[0-9A-Fa-f]{1,4}(?:,[0-9A-Fa-f]{1,4})*,?", text):
        return None
    return [int(word, 16) for word in text.removesuffix(",").split(",")]


def _are_numbers(content: object, size: int, ends: tuple[float, float], kinds: set[type]) -> bool:
    """Return True for a list of so many numbers in a range; True is no number here, unlike in Python."""
    if not isinstance(content, list) or len(content) != size or not set(map(type, content)) <= kinds:
        return False
    return all(ends[0] <= number <= ends[1] for number in content)  # False of NaN

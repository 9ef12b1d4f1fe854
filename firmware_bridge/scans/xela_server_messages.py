"""Decoder from messages of the vendor's server to readings. No I/O, no clock.

A message is a JSON object: `message`, a number that counts up, or "Welcome"; `time` of sending, in [s] of the server's
clock; and under "1", "2", ... the last reading of each sensor, new or not: `data`, the counts x, y, z of one taxel
after the other, row by row from the top left. Versions differ:

    1.7.6   data "8197,829A,..."       hexadecimal
    1.7.7   data [33175, 33434, ...]   and "welcome" as `type` of every message, so that `type` has no use
    1.8.0   data hexadecimal, and the same as `integer`

`ups`, the updates a second of a taxel, is the sign of life, together with a `time` of the sensor that moves on.
`calibrated` (in newtons), `temp` (in kelvin) and `ups` are absent, null or zeros where the server has no value.

No content is trusted: a message that cannot be used is counted by its error, and nothing is raised.
"""

import json
import math
import re
from collections.abc import Sequence
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.pad_geometry import USPA44, SensorGeometry

HIGHEST_COUNT: Final = 0xFFFF
LONGEST_MESSAGE_BYTES: Final = 1 << 18  # most bytes of a message: sixteen sensors with every field take a third of it
MOST_SENSORS: Final = 16
HIGHEST_UPS_HZ: Final = 10_000.0
HIGHEST_NEWTONS: Final = 1000.0
KELVIN: Final = (200.0, 500.0)
WELCOME: Final = "Welcome"
PRETENDED_VERSION: Final = "_emulated"  # suffix of an emulated server's version, which separates it from the vendor's
_COUNTED: Final = [
    "messages",
    "welcomes",
    "without_readings",
    "too_long",
    "bad_json",
    "duplicate_keys",
    "bad_sequence",
    "bad_sensor",
    "foreign_sensor",
    "disagreeing",
    "bad_ups",
    "bad_calibrated",
    "bad_temperature",
    "bad_time",
]


class ServerReading(NamedTuple):
    """Last reading of one sensor in the server.

    Attributes:
        sensor: number of the sensor in the server, such as "1".
        counts: (3, taxels) int32, axes x, y, z.
        ups_hz: rate at which each taxel is renewed, in [Hz]; None if not reported.
        newtons: (3, rows, cols) float32, by the vendor's calibration, in [N]; None if not reported.
        temperature_k: (rows, cols) float32, in [K], NaN where not reported; None if not reported for any taxel.
        acquired_s: time at which it was read from the sensor, in [s] of the server's clock; None if not reported.
    """

    sensor: str
    counts: NDArray[np.int32]
    ups_hz: tuple[float, ...] | None
    newtons: NDArray[np.float32] | None
    temperature_k: NDArray[np.float32] | None
    acquired_s: float | None


class ServerMessage(NamedTuple):
    """One message. `sequence` is None only for a welcome and a bad message; `sent_s` is by the server's clock."""

    kind: Literal["welcome", "readings", "bad"]
    sequence: int | None = None
    sent_s: float | None = None
    version: str = ""
    readings: tuple[ServerReading, ...] = ()


class ServerDecoder:
    """Decoder of single messages, of any version of the server.

    Attributes:
        foreign: descriptions by the server of sensors that are not of this geometry, by name.
    """

    def __init__(self, geometry: SensorGeometry = USPA44) -> None:
        self.foreign: dict[str, str] = {}
        self._geometry = geometry
        self._counted: dict[str, int] = dict.fromkeys(_COUNTED, 0)

    def decode(self, text: str | bytes) -> ServerMessage:
        """Decode one message, as text or in UTF-8."""
        self._counted["messages"] += 1
        content = self._content(text)
        if isinstance(content, str):
            return self._bad(content)
        version = content.get("version")
        version = version[:40] if isinstance(version, str) else ""
        if content.get("message") == WELCOME:
            self._counted["welcomes"] += 1
            return ServerMessage("welcome", version=version)
        sequence = content.get("message")
        if type(sequence) is not int or not 0 <= sequence < 1 << 63:
            return self._bad("bad_sequence")
        named = [name for name, value in content.items() if _is_name(name) and isinstance(value, dict)]
        if not named:
            self._counted["without_readings"] += 1
        self._counted["bad_sensor"] += max(0, len(named) - MOST_SENSORS)
        readings = [self._reading(name, content[name]) for name in named[:MOST_SENSORS]]
        found = tuple(reading for reading in readings if reading is not None)
        return ServerMessage("readings", sequence, self._time_s(content.get("time")), version, found)

    def counters(self) -> dict[str, int]:
        """Return the counts of messages and of their errors.

        messages; welcomes; without_readings: no sensor named; too_long; bad_json; duplicate_keys; bad_sequence: no
        valid sequence number. For sensors: bad_sensor: no valid counts; foreign_sensor: of another geometry;
        disagreeing: `integer` differs from `data`, which wins; bad_ups, bad_calibrated, bad_temperature, bad_time:
        left out.
        """
        return dict(self._counted)

    def _content(self, text: str | bytes) -> dict[str, Any] | str:
        """Return the object in a message, or what is wrong."""
        if len(text) > LONGEST_MESSAGE_BYTES:
            return "too_long"
        try:
            content = json.loads(text, object_pairs_hook=_without_duplicates)
        except _DuplicateError:
            return "duplicate_keys"
        except (ValueError, RecursionError):  # no JSON, no UTF-8, a number too long for int(), or brackets in brackets
            return "bad_json"
        return content if isinstance(content, dict) else "bad_json"

    def _bad(self, kind: str) -> ServerMessage:
        self._counted[kind] += 1
        return ServerMessage("bad")

    def _reading(self, name: str, content: dict[str, Any]) -> ServerReading | None:
        taxels = content.get("taxels")
        if type(taxels) is int and 0 < taxels != self._geometry.taxel_count:
            model = content.get("model")
            model = repr(model[:20]) if isinstance(model, str) else "a model without a name"
            self.foreign[name] = f"{model} with {min(taxels, 9999)} taxels"
            self._counted["foreign_sensor"] += 1
            return None
        known = type(taxels) is int and taxels == self._geometry.taxel_count
        counts = self._counts(content.get("data"), content.get("integer")) if known else None
        if counts is None:
            self._counted["bad_sensor"] += 1
            return None
        self.foreign.pop(name, None)
        ups_hz = self._in_range(content.get("ups"), self._geometry.taxel_count, (0, HIGHEST_UPS_HZ), "bad_ups")
        return ServerReading(
            name,
            np.ascontiguousarray(np.array(counts, dtype=np.int32).reshape(-1, 3).T),
            None if ups_hz is None else tuple(ups_hz),
            self._newtons(content.get("calibrated")),
            self._temperature_k(content.get("temp")),
            self._time_s(content.get("time")),
        )

    def _counts(self, data: object, integer: object) -> list[int] | None:
        """Decode the counts from `data`, which every version has, or from `integer` where `data` cannot be used."""
        size = 3 * self._geometry.taxel_count
        of_data = _from_hex(data, size) if isinstance(data, str) else _whole_numbers(data, size)
        if integer is None and of_data is not None:
            return of_data
        of_integer = _whole_numbers(integer, size)
        self._counted["disagreeing"] += of_data != of_integer
        return of_integer if of_data is None else of_data

    def _newtons(self, content: object) -> NDArray[np.float32] | None:
        size, range_n = 3 * self._geometry.taxel_count, (-HIGHEST_NEWTONS, HIGHEST_NEWTONS)
        newtons = self._in_range(content, size, range_n, "bad_calibrated")
        if newtons is None:
            return None
        by_axis = np.array(newtons, dtype=np.float32).reshape(-1, 3).T
        return np.ascontiguousarray(by_axis).reshape(self._geometry.scan_shape)

    def _temperature_k(self, content: object) -> NDArray[np.float32] | None:
        kelvin = self._in_range(content, self._geometry.taxel_count, (0, KELVIN[1]), "bad_temperature")
        if kelvin is None or not any(kelvin):  # zeros: the sensor has no thermometer
            return None
        if min(one for one in kelvin if one) < KELVIN[0]:
            self._counted["bad_temperature"] += 1
            return None
        known = np.array([one or math.nan for one in kelvin], dtype=np.float32)
        return known.reshape(self._geometry.rows, self._geometry.cols)

    def _in_range(
        self, content: object, size: int, ends: tuple[float, float], counted_as: str
    ) -> Sequence[float] | None:
        """Return a list of `size` numbers in a range; None, and count it, if it is another thing than None."""
        numbers = _numbers(content, size)
        if numbers is not None and ends[0] <= min(numbers) <= max(numbers) <= ends[1]:
            return numbers
        self._counted[counted_as] += content is not None
        return None

    def _time_s(self, content: object) -> float | None:
        if isinstance(content, bool) or not isinstance(content, (int, float)) or not 0 < content < 1e11:  # since 1970
            self._counted["bad_time"] += content is not None
            return None
        return float(content)


class _DuplicateError(ValueError):
    """A key is there twice, so its value is ambiguous."""


def _without_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) != len(pairs):
        raise _DuplicateError
    return content


def _is_name(key: str) -> bool:
    return 0 < len(key) <= 3 and key.isascii() and key.isdigit()


def _from_hex(text: str, size: int) -> list[int] | None:
    # Not int() alone: it takes signs, spaces, underscores and 0x as well.
    if not re.fullmatch("[0-9A-Fa-f]{1,4}(?:,[0-9A-Fa-f]{1,4})*,?", text):
        return None
    words = text.removesuffix(",").split(",")
    return [int(word, 16) for word in words] if len(words) == size else None


def _whole_numbers(content: object, size: int) -> list[int] | None:
    if not isinstance(content, list) or len(content) != size:
        return None
    if set(map(type, content)) != {int} or not 0 <= min(content) <= max(content) <= HIGHEST_COUNT:
        return None
    return content


def _numbers(content: object, size: int) -> Sequence[float] | None:
    """Return a list of `size` finite numbers, None if it is not one; True is no number here, unlike in Python."""
    if not isinstance(content, list) or len(content) != size or not set(map(type, content)) <= {int, float}:
        return None
    try:
        return content if all(map(math.isfinite, content)) else None
    except OverflowError:  # a whole number that no float can hold
        return None

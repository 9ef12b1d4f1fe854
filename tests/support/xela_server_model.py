"""Emulated xela_server: its messages, and the readings in them at any time. No I/O, no clock."""

import json
import math
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.emulation.xela_controller import playing_rate_hz
from firmware_bridge.errors import RecordingError
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.recording.tracks import Recording, Track
from firmware_bridge.scans.scan import ABSENT
from firmware_bridge.scans.xela_server_messages import PRETENDED_VERSION, WELCOME

VERSIONS: Final = ("1.7.6", "1.7.7", "1.8.0")
NEWTONS_PER_COUNT: Final = np.array([0.0007, 0.0007, 0.00085])[:, None, None]
"""Newtons per count of x, y, z, about those of real sensors."""
TEMPERATURE_K: Final = 302.5
_ROUNDED: Final = 1e-6
"""Tolerance, in cycles: a message sent at the time of a cycle holds it, however that time was rounded."""
GARBAGE: Final[tuple[str | bytes, ...]] = (
    "",
    '{"message": 12, "time": 17',
    '{"message": 1e3}',
    '{"message": -1, "1": {"taxels": 16}}',
    '{"message": 7, "message": 8}',
    '{"message": 7, "1": {"taxels": 16, "data": "8197,829A"}}',
    '{"message": NaN}',
    "[" * 5000,
    b"\xff\xfe not text",
    '{"message": ' + "9" * 6000 + "}",
    "null",
    "x" * 50_000,
)
"""Invalid messages, sent one after the other; a client must survive each of them."""


class _Player(NamedTuple):
    """Sensor that plays a track: its readings without gaps, and a mask of the real ones."""

    counts: NDArray[np.int32]
    present: NDArray[np.bool_]
    rate_hz: float


class VendorServer:
    """Model of a server with some sensors: its readings at any time, in the format of its version.

    Attributes:
        silent: taxels of all sensors that are no longer renewed, row-major from the top left.
    """

    def __init__(
        self,
        recordings: Sequence[Recording],
        *,
        version: str = "1.8.0",
        rate_hz: float | None = None,
        spread: float = 0.0,
        queue_s: float = 0.0,
        loop: bool = False,
        others: Sequence[tuple[str, int]] = (),
    ) -> None:
        """Prepare to play.

        Args:
            recordings: each track is one sensor.
            version: one of VERSIONS.
            rate_hz: cycles a second of each sensor; by default as recorded.
            spread: share of a cycle over which its taxels come, 0..1; at 0 all at once.
            queue_s: age of the readings that it sends, in [s].
            loop: True to begin again after the last cycle.
            others: model and number of taxels of sensors other than 4x4 ones, after all the others.

        Raises:
            ValueError: an option is out of range.
            RecordingError: a recording that this sensor cannot have made, or one without a rate.
        """
        if version not in VERSIONS:
            raise ValueError(f"version is {version!r}, expected one of {', '.join(VERSIONS)}")
        if not (0 <= spread <= 1 and 0 <= queue_s < math.inf):
            raise ValueError(f"spread is {spread} and queue {queue_s} s, expected 0..1 and 0 or more")
        self.silent: frozenset[int] = frozenset()
        self._version = version
        self._spread = spread
        self._queue_s = queue_s
        self._loop = loop
        self._others = tuple(others)
        self._players = [_player(recording, track, rate_hz) for recording in recordings for track in recording.tracks]
        self._held: dict[int, NDArray[np.int32]] = {}

    @property
    def sensors(self) -> int:
        """Number of sensors that it plays."""
        return len(self._players)

    def ended(self, elapsed_s: float) -> bool:
        """Return True once every cycle of every sensor could be sent."""
        if self._loop:
            return False
        played_s = elapsed_s - self._queue_s
        return all(played_s * one.rate_hz - self._spread >= len(one.counts) for one in self._players)

    def cycle(self, sensor: int, elapsed_s: float) -> int:
        """Return the newest whole cycle of a sensor, counted from 0; -1 before the first."""
        player = self._players[sensor]
        last_taxel = (USPA44.taxel_count - 1) / USPA44.taxel_count
        newest = math.floor((elapsed_s - self._queue_s) * player.rate_hz + _ROUNDED - self._spread * last_taxel)
        return max(-1, newest) if self._loop else min(max(-1, newest), len(player.counts) - 1)

    def welcome(self, unix_s: float) -> str:
        """Return the greeting."""
        return json.dumps({"message": WELCOME, "time": unix_s, "version": self._version + PRETENDED_VERSION})

    def message(self, sequence: int, elapsed_s: float, unix_s: float) -> str:
        """Return the message on all sensors at a time in [s] from its start, `unix_s` [s] on its own clock."""
        message: dict[str, Any] = {
            "message": sequence,
            "time": unix_s,
            "sensors": len(self._players) + len(self._others),
            "type": "welcome" if self._version == "1.7.7" else "routine",
            "version": self._version + PRETENDED_VERSION,
        }
        for index in range(len(self._players)):
            message[str(index + 1)] = self._sensor(index, elapsed_s, unix_s)
        for index, (model, taxels) in enumerate(self._others, len(self._players) + 1):
            data = ",".join(["8000"] * 3 * taxels)
            message[str(index)] = {"sensor": str(index), "data": data, "model": model, "taxels": taxels, "ups": [58.0]}
        message["sendtime" if self._version == "1.8.0" else "complete"] = unix_s
        return json.dumps(message)

    def _sensor(self, index: int, elapsed_s: float, unix_s: float) -> dict[str, Any]:
        player = self._players[index]
        played_s = max(0.0, elapsed_s - self._queue_s)
        taxels = np.arange(USPA44.taxel_count)
        begun = played_s * player.rate_hz + _ROUNDED - self._spread * taxels / USPA44.taxel_count
        cycles = np.maximum(0, np.floor(begun)).astype(int)
        rows = cycles % len(player.counts) if self._loop else np.minimum(cycles, len(player.counts) - 1)
        counts = player.counts[rows, :, taxels]
        silent = np.isin(taxels, list(self.silent))
        held = self._held[index] = np.where(silent[:, None], self._held.get(index, counts), counts)
        ups_hz = np.where(player.present[rows, taxels] & ~silent, player.rate_hz, 0.0)
        values = held.ravel().tolist()
        by_hex = ",".join(f"{value:04X}" for value in values)
        rest = player.counts[0].T
        scale = NEWTONS_PER_COUNT.ravel()
        message: dict[str, Any] = {
            "time": unix_s - min(elapsed_s, self._queue_s) - (played_s % (1 / player.rate_hz)),
            "sensor": str(index + 1),
            "data": values if self._version == "1.7.7" else by_hex,
            "model": "uSPa44",
            "taxels": USPA44.taxel_count,
            "calibrated": np.round((held - rest) * scale, 6).ravel().tolist(),
            "temp": [TEMPERATURE_K if self._version == "1.8.0" else 0.0] * USPA44.taxel_count,
            "ups": np.round(ups_hz, 2).tolist(),
        }
        if self._version == "1.8.0":
            message["integer"] = values
        return message


def _player(recording: Recording, track: Track, rate_hz: float | None) -> _Player:
    if track.counts.shape[1:] != USPA44.scan_shape:
        raise RecordingError(f"{recording.path}: scans of shape {track.counts.shape[1:]}, expected {USPA44.scan_shape}")
    counts = track.counts.reshape(len(track.counts), 3, -1).copy()
    present = counts[:, 0] != ABSENT
    # The server repeats the last reading of an absent taxel; before its first reading it sends 0.
    counts[0][:, ~present[0]] = 0
    for scan in range(1, len(counts)):
        counts[scan][:, ~present[scan]] = counts[scan - 1][:, ~present[scan]]
    return _Player(counts, present, playing_rate_hz(recording, track, rate_hz))

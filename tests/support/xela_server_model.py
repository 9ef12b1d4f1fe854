"""Emulated xela_server: its messages, and the readings in them at any time. No I/O, no clock."""

import json
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.emulation.xela_controller import playing_rate_hz
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
        spread: float = 0.0,
        loop: bool = False,
        others: Sequence[tuple[str, int]] = (),
    ) -> None:
        """Prepare to play.

        Args:
            recordings: each track is one sensor.
            version: one of VERSIONS.
            spread: share of a cycle over which its taxels come, 0..1; at 0 all at once.
            loop: True to begin again after the last cycle.
            others: model and number of taxels of sensors other than 4x4 ones, after all the others.
        """
        self.silent: frozenset[int] = frozenset()
        self._version = version
        self._spread = spread
        self._loop = loop
        self._others = tuple(others)
        self._players = [_player(recording, track) for recording in recordings for track in recording.tracks]
        self._held: dict[int, NDArray[np.int32]] = {}

    def ended(self, elapsed_s: float) -> bool:
        """Return True once every cycle of every sensor could be sent."""
        return not self._loop and all(
            elapsed_s * one.rate_hz - self._spread >= len(one.counts) for one in self._players
        )

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
        taxels = np.arange(USPA44.taxel_count)
        begun = elapsed_s * player.rate_hz + _ROUNDED - self._spread * taxels / USPA44.taxel_count
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
            "time": unix_s - elapsed_s % (1 / player.rate_hz),
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


def _player(recording: Recording, track: Track) -> _Player:
    counts = track.counts.reshape(len(track.counts), 3, -1).copy()
    present = counts[:, 0] != ABSENT
    # The server repeats the last reading of an absent taxel; before its first reading it sends 0.
    counts[0][:, ~present[0]] = 0
    for scan in range(1, len(counts)):
        counts[scan][:, ~present[scan]] = counts[scan - 1][:, ~present[scan]]
    return _Player(counts, present, playing_rate_hz(recording, track, None))

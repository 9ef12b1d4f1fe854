"""Rehearsal of the doctor without a sensor: an emulated pad that is pressed as each request asks, a second later."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.doctor.guided_press import ASK_WEIGHT, CORNERS
from edge.perception.result import NOISE_COUNTS
from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.recording.tracks import Recording, Track

WATCHED_S: Final = 5.0  # for which the free pad is watched
ANSWER_S: Final = 1.0  # from a request until a person does what it says
_WEIGHT_G: Final = 200.0


class Rehearsal(Emulator):
    """Emulated adapter on `port`, with a pad that does what is asked: no reading of it is taken for a device's."""

    def __init__(self) -> None:
        """Prepare the free pad."""
        self._typed: str | None = None
        self._load = self._next = np.zeros(USPA44.scan_shape)
        self._next_s = 0.0
        rest = np.array([32_700, 32_800, 37_400])[:, None, None] + 37 * np.arange(16).reshape(4, 4)
        free = Recording(Path("rehearsal"), (Track("4", rest[None].astype(np.int32), None),), rate_hz=100.0)
        super().__init__([free], played=self._scans)

    def answer(self, request: str) -> None:
        """Do what a request of the guided press asks of a person."""
        if request.endswith(ASK_WEIGHT):
            self._typed = f"{_WEIGHT_G:g}"
        self._next_s, self._next = time.monotonic() + ANSWER_S, load_asked(request, self._next)

    def typed_line(self) -> str | None:
        """Return what is typed since the last call, or None."""
        line, self._typed = self._typed, None
        return line

    def _scans(self, track: Track) -> Iterator[NDArray[np.int32]]:
        noise = np.random.default_rng(0)
        while True:
            self._load = self._next if time.monotonic() >= self._next_s else self._load
            reading = track.counts[0] + self._load + noise.normal(0, NOISE_COUNTS, USPA44.scan_shape)
            yield np.rint(reading).astype(np.int32)


def load_asked(request: str, load: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return counts (3, 4, 4) of what a person does at a request, after bearing `load` on the pad before."""
    corner = next((name for name in CORNERS if f"the {name} corner" in request), None)
    asked, z = np.zeros_like(load), load[2]
    if corner is not None:  # a finger is wider than a taxel, and its middle a little inside
        row, col = (0.3 if side in corner else 2.7 for side in ("top", "left"))
        rows, cols = np.indices(z.shape)
        press = np.exp(-((rows - row) ** 2 + (cols - col) ** 2) / 1.5)
        asked[2] = 5000 * press / press.sum()
    elif "push towards" in request:
        row, col = np.unravel_index(z.argmax(), z.shape)
        asked[:] = 0.2 * z * (1 if col < 2 else -1), 0.2 * z * (1 if row < 2 else -1), z
    elif "Lay " in request:
        asked[2] = _WEIGHT_G / 1000 * 9.80665 * 1176 / USPA44.taxel_count  # by counts per newton of the average sensor
    elif "et go." not in request and "Take it off" not in request:
        return load
    return asked

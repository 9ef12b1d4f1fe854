"""Emulated XELA controller and its slcan adapter: their output and its times. No I/O, no clock."""

import heapq
import math
import random
from collections.abc import Callable, Iterable, Iterator, Sequence
from operator import attrgetter
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.can.slcan import LAST_TIMESTAMP_MS, CanFrame, encode_frame
from firmware_bridge.errors import RecordingError
from firmware_bridge.recording.tracks import Recording, Track
from firmware_bridge.scans.can_id_maps import ID_MAPS, USPA44_MAP, ModelMap
from firmware_bridge.scans.scan import ABSENT

FRAME_S: Final = 0.000_13  # duration of a frame of eight bytes on a 1 Mbit/s bus, with stuffed bits, in [s]

CR: Final = b"\r"
BEL: Final = b"\a"
Played = Callable[[Track], Iterable[NDArray[np.int32]]]
"""Function from a track to the scans that are played of it, in order."""


def scan_frames(
    counts: NDArray[np.int32], controller: int, noise: random.Random, model: ModelMap = USPA44_MAP
) -> list[CanFrame]:
    """Encode one scan (3, rows, cols) as a controller does: a frame per taxel, by SDA, then by taxel on it.

    Absent taxels have no frame. The bytes that carry no reading are filled from `noise`, never zero.
    """
    frames: list[CanFrame] = []
    by_taxel = counts.reshape(3, -1).T.tolist()
    for can_id, taxel in model.wire_order(str(controller)):
        x, y, z = by_taxel[taxel]
        if x != ABSENT:
            words = b"".join(value.to_bytes(2, "big") for value in (x, y, z))
            frames.append(CanFrame(can_id, bytes([noise.randint(1, 255)]) + words + bytes([noise.randint(1, 255)])))
    return frames


class Controller(NamedTuple):
    """One sensor on the bus: its track, its id 0..15, its scans a second, and the id map of its pad."""

    track: Track
    can_id: int
    rate_hz: float
    model: ModelMap = USPA44_MAP


def controllers_of(recordings: Sequence[Recording], rate_hz: float | None) -> list[Controller]:
    """Create the controllers 4, 6, 8, ... that play these recordings on one bus: each track is one.

    Their rates are by default as recorded.

    Raises:
        ValueError: the rate is invalid, or there are more than six.
        RecordingError: a recording that this sensor cannot have made, or one without a rate.
    """
    tracks = [(recording, track) for recording in recordings for track in recording.tracks]
    if len(tracks) > 6:
        raise ValueError(f"{len(tracks)} sensors on one bus, expected at most 6")
    controllers: list[Controller] = []
    for number, (recording, track) in enumerate(tracks):
        model = ID_MAPS.get(track.geometry.name)
        if model is None:
            known = ", ".join(dict.fromkeys(str(model.geometry.scan_shape) for model in ID_MAPS.values()))
            raise RecordingError(f"{recording.path}: scans of shape {track.counts.shape[1:]}, expected one of {known}")
        controllers.append(Controller(track, 4 + 2 * number, playing_rate_hz(recording, track, rate_hz), model))
    return controllers


def playing_rate_hz(recording: Recording, track: Track, rate_hz: float | None) -> float:
    """Return the scans a second at which a track is played: the requested ones, else as recorded.

    It raises ValueError unless that is positive, and RecordingError where none is recorded.
    """
    known_hz = [one for one in (rate_hz, recording.rate_hz, track.mean_rate_hz) if one is not None]
    if not known_hz:
        raise RecordingError(f"{recording.path} does not state its rate: pass --rate-hz")
    if not 0 < known_hz[0] < math.inf:
        raise ValueError(f"rate is {known_hz[0]} Hz, expected a positive number")
    return known_hz[0]


def bus_timeline(
    controllers: Sequence[Controller],
    *,
    jitter_s: float,
    seed: int,
    loop: bool,
    frame_s: float = FRAME_S,
    played: Played = attrgetter("counts"),
) -> Iterator[tuple[float, CanFrame]]:
    """Yield all frames on the bus in order, `frame_s` [s] long each, with their time in [s] from the first scan."""
    lanes = [_lane(controller, jitter_s, seed, loop, frame_s, played) for controller in controllers]
    return heapq.merge(*lanes, key=lambda timed: timed[0])


def _lane(
    controller: Controller, jitter_s: float, seed: int, loop: bool, frame_s: float, played: Played
) -> Iterator[tuple[float, CanFrame]]:
    noise = random.Random(f"{seed} {controller.can_id}")
    number, free_s = 0, 0.0
    while True:
        for counts in played(controller.track):
            # Jitter of single scans does not move the grid; a scan waits for the one before.
            time_s = max(free_s, number / controller.rate_hz + noise.uniform(-jitter_s, jitter_s))
            for frame in scan_frames(counts, controller.can_id, noise, controller.model):
                yield time_s, frame
                time_s += frame_s
            number, free_s = number + 1, time_s
        if not loop:
            return


class SlcanAdapter:
    """Emulated adapter that obeys slcan commands as strictly as a real one.

    Attributes:
        channel_open: True while it passes on the frames of the bus.
        flags: flags that `F` reports, Lawicel's bits; the report clears them.
        bus_off: True where it has left the bus, and receives no frame.
    """

    def __init__(self) -> None:
        """Switch the adapter on."""
        self.flags = 0
        self.bus_off = False
        self.channel_open = False
        self._bitrate: int | None = None
        self._timestamps = False
        self._pending = b""

    @property
    def hears_the_bus(self) -> bool:
        """True if the channel is open at the bitrate of the sensor, and not bus-off."""
        return self.channel_open and self._bitrate == 8 and not self.bus_off

    def begin_anew(self) -> None:
        """Start up again, as after a reset: closed, and at another bitrate than the sensor's."""
        self.channel_open = False
        self._bitrate = 6
        self._timestamps = False
        self._pending = b""

    def feed(self, data: bytes) -> bytes:
        """Process bytes from the client and return the answer."""
        *commands, pending = (self._pending + data).split(CR)
        self._pending = pending[-32:]
        return b"".join(map(self._obey, commands))

    def encode(self, frame: CanFrame, time_s: float) -> bytes:
        """Encode a frame from the bus as the client receives it."""
        if self._timestamps:
            frame = frame._replace(timestamp_ms=int(time_s * 1000) % (LAST_TIMESTAMP_MS + 1))
        return encode_frame(frame)

    def _obey(self, command: bytes) -> bytes:
        name, value = command[:1], command[1:]
        if name == b"t" and self.channel_open:
            return b"z" + CR
        if name == b"V" and not value:
            return b"V1013" + CR
        if self.channel_open:
            if command == b"F":
                flags, self.flags = self.flags, 0
                return b"F%02X" % flags + CR
            if command != b"C":
                return BEL
            self.channel_open = False
        elif name == b"S" and len(value) == 1 and value in b"012345678":
            self._bitrate = int(value)
        elif command == b"O" and self._bitrate is not None:
            self.channel_open = True
        elif command in (b"Z0", b"Z1"):
            self._timestamps = command == b"Z1"
        else:
            return BEL
        return CR

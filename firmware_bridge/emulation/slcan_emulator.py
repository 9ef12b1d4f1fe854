"""Emulator of XELA controllers with an slcan adapter, on a pseudo-terminal, as strict as the devices.

Controllers and adapter have no I/O and no clock; the `Emulator` plays them.
"""

import heapq
import math
import struct
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.can.slcan import LAST_TIMESTAMP_MS, CanFrame, encode_frame
from firmware_bridge.emulation.pty_port import EmulatorThread, PseudoPort
from firmware_bridge.errors import RecordingError
from firmware_bridge.recording.tracks import Recording, Track
from firmware_bridge.scans.can_id_maps import ID_MAPS, USPA44_MAP, ModelMap
from firmware_bridge.scans.scan import ABSENT

FRAME_S: Final = 0.000_13  # duration of a frame of eight bytes on a 1 Mbit/s bus, with stuffed bits, in [s]

CR: Final = b"\r"
BEL: Final = b"\a"
Played = Callable[[Track], Iterable[NDArray[np.int32]]]  # from a track to the scans that are played of it


def scan_frames(counts: NDArray[np.int32], controller: int, model: ModelMap = USPA44_MAP) -> list[CanFrame]:
    """Encode one scan (3, rows, cols) as a controller does: a frame per taxel that is not absent, in wire order."""
    frames: list[CanFrame] = []
    by_taxel = counts.reshape(3, -1).T.tolist()
    for can_id, taxel in model.wire_order(str(controller)):
        x, y, z = by_taxel[taxel]
        if x != ABSENT:
            frames.append(CanFrame(can_id, struct.pack(">B3HB", 0x93, x, y, z, 0x0F)))  # unused bytes are not zero
    return frames


class Controller(NamedTuple):
    """One sensor on the bus: its track, its id 0..15, its scans a second, and the id map of its pad."""

    track: Track
    can_id: int
    rate_hz: float
    model: ModelMap = USPA44_MAP


def controllers_of(recordings: Sequence[Recording], rate_hz: float | None) -> list[Controller]:
    """Create the controllers 4, 6, 8, ..., at most six, that play these recordings on one bus: each track is one.

    Raises RecordingError for a recording that this sensor cannot have made, or one without a rate.
    """
    tracks = [(recording, track) for recording in recordings for track in recording.tracks]
    if len(tracks) > 6:
        raise ValueError(f"{len(tracks)} sensors on one bus, expected at most 6")
    controllers: list[Controller] = []
    for number, (recording, track) in enumerate(tracks):
        model = ID_MAPS.get(track.geometry.name)
        if model is None:
            shapes = ", ".join(dict.fromkeys(str(model.geometry.scan_shape) for model in ID_MAPS.values()))
            raise RecordingError(f"{recording.path}: scans of shape {track.counts.shape[1:]}, expected one of {shapes}")
        controllers.append(Controller(track, 4 + 2 * number, playing_rate_hz(recording, track, rate_hz), model))
    return controllers


def playing_rate_hz(recording: Recording, track: Track, rate_hz: float | None) -> float:
    """Return the scans a second at which a track is played: the requested ones, else as recorded."""
    rates_hz = [rate for rate in (rate_hz, recording.rate_hz, track.mean_rate_hz) if rate is not None]
    if not rates_hz:
        raise RecordingError(f"{recording.path} does not state its rate: pass --rate-hz")
    if not 0 < rates_hz[0] < math.inf:
        raise ValueError(f"rate is {rates_hz[0]} Hz, expected a positive number")
    return rates_hz[0]


def bus_timeline(
    controllers: Sequence[Controller], *, loop: bool, frame_s: float = FRAME_S, played: Played = attrgetter("counts")
) -> Iterator[tuple[float, CanFrame]]:
    """Yield all frames on the bus in order, `frame_s` [s] long each, with their time in [s] from the first scan."""
    lanes = [_lane(controller, loop, frame_s, played) for controller in controllers]
    return heapq.merge(*lanes, key=lambda timed: timed[0])


def _lane(controller: Controller, loop: bool, frame_s: float, played: Played) -> Iterator[tuple[float, CanFrame]]:
    number, free_s = 0, 0.0
    while True:
        for counts in played(controller.track):
            time_s = max(free_s, number / controller.rate_hz)  # a scan waits for the one before
            for frame in scan_frames(counts, controller.can_id, controller.model):
                yield time_s, frame
                time_s += frame_s
            number, free_s = number + 1, time_s
        if not loop:
            return


class SlcanAdapter:
    """Emulated adapter that obeys slcan commands as strictly as a real one."""

    def __init__(self) -> None:
        """Switch the adapter on."""
        self.channel_open = False  # True while it passes on the frames of the bus
        self._bitrate: int | None = None
        self._timestamps = False
        self._pending = b""

    @property
    def hears_the_bus(self) -> bool:
        """True if the channel is open at the bitrate of the sensor."""
        return self.channel_open and self._bitrate == 8

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
        if self.channel_open:
            if command == b"F":
                return b"F00" + CR  # no error flag
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


class Emulator:
    """Player of recordings on `port`, from the first opening of the channel; hangs up at the end."""

    def __init__(
        self,
        recordings: Sequence[Recording],
        *,
        rate_hz: float | None = None,
        loop: bool = False,
        adapter: SlcanAdapter | None = None,
        frame_s: float = FRAME_S,
        on_scan: Callable[[int, int], object] = lambda controller, time_ns: None,
        link: Path | None = None,
        waits: bool = False,
        played: Played = attrgetter("counts"),
    ) -> None:
        """Prepare to play each track of `recordings` as one sensor, as `controllers_of`; nothing is opened yet.

        `frame_s` is the duration of a frame on the bus, in [s]. `on_scan` is called with the controller and the
        monotonic time in [ns] of the last frame of a scan. `link` becomes a link to the pseudo-terminal. With `waits`
        no frame is lost where a client reads late, unlike on a bus. Scans that are `played` of a track are each asked
        for while the one before is sent.
        """
        bus = controllers_of(recordings, rate_hz)
        self.port = ""  # path for clients, once entered
        self.played_out = False  # True once everything was played, and the client has fetched it
        self.adapter = SlcanAdapter() if adapter is None else adapter

        self._timeline = bus_timeline(bus, loop=loop, frame_s=frame_s, played=played)
        self._frame_s = frame_s
        self._on_scan = on_scan
        self._last_frames = {sensor.model.wire_order(str(sensor.can_id))[-1][0]: sensor.can_id for sensor in bus}
        self._waits = waits
        self._still_s = 0.0
        self._unsent = b""
        self.line = PseudoPort(link)  # this end of the pseudo-terminal

        self._alone = EmulatorThread([self])

    def __enter__(self) -> Self:
        self._alone.__enter__()
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.hang_up()

    def plug(self) -> None:
        """Put the cable in; `EmulatorThread` does so when it begins."""
        self.line.plug()
        self.port = self.line.path

    def hang_up(self) -> None:
        """Pull the cable out."""
        self._alone.__exit__()

    def course(self) -> Generator[float, None, None]:
        """Play; yield the monotonic time, in [s], at which to go on, or earlier when the client has written."""
        try:
            while not self.adapter.channel_open:
                yield math.inf
            start_s, newest_s = time.monotonic(), -math.inf
            for handed_on_s, group in groupby(self._timeline, key=lambda timed: math.ceil(1000 * timed[0]) / 1000):
                due_s = start_s + self._still_s + handed_on_s
                yield from self._wait_until(due_s)
                late_s = time.monotonic() - due_s
                frames = list(group)  # now, since a scan is asked for while the one before is sent
                between_scans = frames[0][0] - newest_s > 1.5 * self._frame_s
                # It was stopped itself: it ends the scans under way, and goes on where it was, since no controller
                # sends in one burst what it has missed.
                if late_s > 0.2 and between_scans and not self._waits:
                    self._still_s += late_s
                newest_s = frames[-1][0]
                yield from self._hand_on(frames)
            yield from self._drain()
            self.played_out = True
        finally:
            self.line.unplug()

    def _hand_on(self, frames: Iterable[tuple[float, CanFrame]]) -> Iterator[float]:
        if not self.adapter.hears_the_bus:
            return
        data, ended = b"", list[int]()
        for time_s, frame in frames:
            data += self.adapter.encode(frame, time_s + self._still_s)
            if frame.can_id in self._last_frames:
                ended.append(self._last_frames[frame.can_id])
        now_ns = time.monotonic_ns()  # before the write: a reader may be done before it returns
        self._send(data)
        while self._unsent:  # at 5000 scans a second a reader empties the terminal in 2 ms
            yield from self._wait_until(time.monotonic() + 0.001)
            self._send(b"")
        for controller in ended:
            self._on_scan(controller, now_ns)

    def _wait_until(self, time_s: float) -> Iterator[float]:
        """Wait for a time on the monotonic clock, but let the client write once at least."""
        yield time_s
        while time.monotonic() < time_s:
            yield time_s

    def obey(self, received: bytes) -> None:
        """Process what the client has written, and answer."""
        self._send(self.adapter.feed(received))

    def _send(self, data: bytes) -> None:
        """Send what found no room before, and data; what finds none again is lost, but where it waits for a client."""
        self._unsent += data
        sent = self.line.write(self._unsent)
        self._unsent = self._unsent[sent:] if self._waits and self.adapter.channel_open else b""

    def _drain(self) -> Iterator[float]:
        """Let the client fetch the bytes under way, which hanging up would discard."""
        looks = 0
        while self.adapter.channel_open and looks < 3:  # while a client empties its buffer, the kernel holds more
            looks = 0 if self.line.unread_bytes() else looks + 1
            yield from self._wait_until(time.monotonic() + 0.01)

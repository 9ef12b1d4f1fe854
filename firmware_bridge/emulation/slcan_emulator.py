"""Emulator of a XELA controller with an slcan adapter, on a pseudo-terminal, as strict as the device."""

import math
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Self

from firmware_bridge.can.slcan import CanFrame
from firmware_bridge.emulation.pty_port import EmulatorThread, PseudoPort
from firmware_bridge.emulation.xela_controller import CR, FRAME_S, Played, SlcanAdapter, bus_timeline, controllers_of
from firmware_bridge.recording.tracks import Recording


class Emulator:
    """Player of recordings on `port`, from the first opening of the channel; hangs up at the end.

    Attributes:
        port: path for clients, once entered.
        adapter: the adapter, with its state and the number of refused commands.
        line: this end of the pseudo-terminal.
        played_out: True once everything was played, and the client has fetched it.
    """

    def __init__(
        self,
        recordings: Sequence[Recording],
        *,
        rate_hz: float | None = None,
        loop: bool = False,
        adapter: SlcanAdapter | None = None,
        jitter_s: float = 0.001,
        frame_s: float = FRAME_S,
        seed: int = 0,
        on_scan: Callable[[int, int], object] = lambda controller, time_ns: None,
        link: Path | None = None,
        waits: bool = False,
        played: Played = attrgetter("counts"),
    ) -> None:
        """Prepare to play; nothing is opened yet.

        Args:
            recordings: each track is one sensor on the bus.
            rate_hz: scans a second of each sensor; by default as recorded.
            loop: True to begin again after the last scan.
            adapter: the adapter, by default a good one.
            jitter_s: largest time by which a scan comes early or late, in [s].
            frame_s: duration of a frame on the bus, in [s]; a real one carries no more than 480 scans a second.
            seed: seed of jitter and unused bytes.
            on_scan: called with the controller and the monotonic time in [ns] of the last frame of a scan.
            link: link that points to the pseudo-terminal; by default clients use the terminal itself.
            waits: True to wait for a client that reads late, as no bus does, so that no frame is lost.
            played: scans that are played of a track; each is asked for while the one before is sent.

        Raises:
            ValueError: the rate is out of range.
            RecordingError: a recording that this sensor cannot have made, or one without a rate.
        """
        bus = controllers_of(recordings, rate_hz)
        self.port = ""
        self.played_out = False
        self.adapter = SlcanAdapter() if adapter is None else adapter

        self._timeline = bus_timeline(bus, jitter_s=jitter_s, seed=seed, loop=loop, frame_s=frame_s, played=played)
        self._frame_s = frame_s
        self._on_scan = on_scan
        self._last_frames = {one.model.wire_order(str(one.can_id))[-1][0]: one.can_id for one in bus}
        self._waits = waits
        self._still_s = 0.0
        self._writing = False
        self._answers = b""
        self.line = PseudoPort(link)

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
        if self._waits:
            yield from self._write_patiently(data)
        else:
            self.line.write(data)
        for controller in ended:
            self._on_scan(controller, now_ns)

    def _wait_until(self, time_s: float) -> Iterator[float]:
        """Wait for a time on the monotonic clock, but let the client write once at least."""
        yield time_s
        while time.monotonic() < time_s:
            yield time_s

    def _write_patiently(self, data: bytes) -> Iterator[float]:
        """Send frames as the client makes room for them, with answers between them."""
        sent, self._writing = 0, True
        while sent < len(data):
            amid_frame = data[:sent][-1:] not in (b"", CR)
            if self._answers and not amid_frame:
                self._answers = self._answers[self.line.write(self._answers) :]
            if amid_frame or not self._answers:
                sent += self.line.write(data[sent:])
            if sent < len(data):
                # At 5000 scans a second a reader empties the terminal in 2 ms.
                yield from self._wait_until(time.monotonic() + 0.001)
            if not self.adapter.channel_open:
                break
        self._writing = False

    def obey(self, received: bytes) -> None:
        """Process what the client has written, and answer."""
        self._answers += self.adapter.feed(received)
        if not self._writing:
            written = self.line.write(self._answers)
            self._answers = self._answers[written:] if self._waits else b""

    def _drain(self) -> Iterator[float]:
        """Let the client fetch the bytes under way, which hanging up would discard."""
        looks = 0
        while self.adapter.channel_open and looks < 3:  # while a client empties its buffer, the kernel holds more
            looks = 0 if self.line.unread_bytes() else looks + 1
            yield from self._wait_until(time.monotonic() + 0.01)

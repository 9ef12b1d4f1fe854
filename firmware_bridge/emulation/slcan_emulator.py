"""Emulator of a XELA controller with an slcan adapter, on a pseudo-terminal.

It is as strict as the device: silent until bitrate and open, deaf at the wrong line speed, and frames
that the client does not fetch in time are lost. `slcan_main` is its command line.
"""

import math
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from itertools import groupby
from pathlib import Path
from typing import Final, Self

from firmware_bridge.can.slcan import CanFrame
from firmware_bridge.emulation.faults.injector import Injector
from firmware_bridge.emulation.faults.lines import Piece
from firmware_bridge.emulation.pty_port import COUNTED_LATE_NS, PseudoPort
from firmware_bridge.emulation.xela_controller import FRAME_S, SlcanAdapter, bus_timeline, controllers_of
from firmware_bridge.recording.tracks import Recording

_STOP_POLL_S: Final = 0.05
_DRAIN_POLL_S: Final = 0.01
_LONGEST_DRAIN_S: Final = 0.5


class Emulator:
    """Player of recordings on `port`, from the first opening of the channel; hangs up at the end.

    Attributes:
        port: path for clients, once entered.
        adapter: the adapter, with its state and the number of refused commands.
        sent_frames: number of frames that went out whole.
        lost_frames: number of frames without room, because the client did not read.
    """

    def __init__(
        self,
        recordings: Sequence[Recording],
        *,
        controllers: Sequence[int] = (),
        rate_hz: float | None = None,
        loop: bool = False,
        acknowledges: bool = True,
        left_open: bool = False,
        old_canable: bool = False,
        jitter_s: float = 0.001,
        latency_s: float = 0.001,
        frame_s: float = FRAME_S,
        first_frame: int = 0,
        ignores_line_speed: bool = False,
        seed: int = 0,
        on_scan: Callable[[int, int], object] = lambda controller, time_ns: None,
        faults: Injector | None = None,
        link: Path | None = None,
        waits: bool = False,
    ) -> None:
        """Prepare to play; nothing is opened yet.

        Args:
            recordings: each track is one sensor on the bus.
            controllers: their controller ids 0..15; by default 4, 6, 8, ...
            rate_hz: scans a second of each sensor; by default as recorded.
            loop: True to begin again after the last scan.
            acknowledges: True to answer commands.
            left_open: True for a channel that is open from the start, as a killed client leaves it.
            old_canable: True for no answers, no time stamps and no flags.
            jitter_s: largest time by which a scan comes early or late, in [s].
            latency_s: period in which the adapter hands on its frames, in [s].
            frame_s: duration of a frame on the bus, in [s]; a real one carries no more than 480 scans a second.
            first_frame: frames that are over when the channel is first opened; by default a cycle begins there.
            ignores_line_speed: True to accept any speed, as USB-CDC adapters do.
            seed: seed of jitter and unused bytes.
            on_scan: called with the controller and the monotonic time in [ns] of the last frame of a scan.
            faults: faults between bus and client.
            link: link that points to the pseudo-terminal; by default clients use the terminal itself.
            waits: True to wait for a client that reads late, as no bus does, so that no frame is lost.

        Raises:
            ValueError: an option is out of range.
            RecordingError: a recording that this sensor cannot have made, or one without a rate.
        """
        for name, value in (("jitter_s", jitter_s), ("latency_s", latency_s), ("frame_s", frame_s)):
            if not 0 <= value < math.inf:
                raise ValueError(f"{name} is {value}, expected 0 or more")
        if first_frame < 0:
            raise ValueError(f"first_frame is {first_frame}, expected 0 or more")
        bus = controllers_of(recordings, controllers, rate_hz)
        self.port = ""
        self.adapter = SlcanAdapter(acknowledges=acknowledges, left_open=left_open, old_canable=old_canable)
        self.sent_frames = 0
        self.lost_frames = 0
        self._timeline = bus_timeline(
            bus, jitter_s=jitter_s, seed=seed, loop=loop, frame_s=frame_s, first_frame=first_frame
        )
        self._latency_s = latency_s
        self._on_scan = on_scan
        self._last_frames = {one.model.wire_order(str(one.can_id))[-1][0]: one.can_id for one in bus}
        self._faults = faults
        self._waits = waits
        self._resets = 0
        self._elsewhere = False
        self._line = PseudoPort(link, ignores_line_speed=ignores_line_speed, seed=seed)
        self._stop = threading.Event()
        self._through = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="emulator", daemon=True)

    def __enter__(self) -> Self:
        self._line.plug()
        self.port = self._line.path
        self._thread.start()
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.hang_up()

    def hang_up(self) -> None:
        """Pull the cable out."""
        self._stop.set()
        self._thread.join()

    def tell(self, line: bytes) -> None:
        """Send an unsolicited line, such as `adapter.state_line(...)`."""
        if self._faults is None:
            self._line.write(line)
        else:
            self._send([Piece(line, None, answer=True)], time.monotonic_ns())

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until it has hung up; return False on time-out."""
        return self._through.wait(timeout_s)

    def _serve(self) -> None:
        try:
            while not self.adapter.channel_open:
                if not self._obey_until(time.monotonic() + _STOP_POLL_S):
                    return
            start_s = time.monotonic()
            for handed_on_s, frames in groupby(self._timeline, key=self._handed_on_s):
                if not self._obey_until(start_s + handed_on_s):
                    return
                if self._faults is not None:
                    self._hand_on_spoilt(self._faults, frames)
                elif self.adapter.hears_the_bus:
                    self._hand_on(frames)
            self._drain()
        finally:
            if self._faults is not None:
                self._faults.truth.close_channel(self._line.unread_bytes())
            self._line.unplug()
            self._through.set()

    def _handed_on_s(self, timed: tuple[float, CanFrame]) -> float:
        latency_s = self._latency_s if self._faults is None else self._faults.latency_s(timed[0], self._latency_s)
        if latency_s == 0:
            return timed[0]
        return math.ceil(timed[0] / latency_s) * latency_s

    def _hand_on(self, frames: Iterable[tuple[float, CanFrame]]) -> None:
        lines: list[bytes] = []
        ended: list[int] = []
        for time_s, frame in frames:
            lines.append(self.adapter.encode(frame, time_s))
            if frame.can_id in self._last_frames:
                ended.append(self._last_frames[frame.can_id])
        now_ns = time.monotonic_ns()  # before the write: a reader may be done before it returns
        data = b"".join(lines)
        room = self._line.write(data)
        while self._waits and room < len(data) and self._obey_until(time.monotonic() + _DRAIN_POLL_S):
            if not self.adapter.channel_open:
                break
            room += self._line.write(data[room:])
        for line in lines:
            room -= len(line)
            self.sent_frames += room >= 0
            self.lost_frames += room < 0
        for controller in ended:
            self._on_scan(controller, now_ns)

    def _hand_on_spoilt(self, faults: Injector, frames: Iterable[tuple[float, CanFrame]]) -> None:
        """Hand on frames through faults, which also pull the cable and reset the adapter."""
        truth, pieces = faults.truth, list[Piece]()
        now_ns = time.monotonic_ns()
        for time_s, frame in frames:
            for sent in faults.disturb(time_s, frame):
                if sent.lost:
                    truth.lose(sent, now_ns)
                elif not (self._line.plugged and self.adapter.hears_the_bus):
                    truth.lose(sent._replace(fate="unheard"), now_ns)
                else:
                    pieces += faults.corrupt(self.adapter.encode(sent.frame, sent.time_s), sent)
        truth.settle(self._line.unread_bytes(), now_ns - COUNTED_LATE_NS)
        self._send(pieces, now_ns)
        if faults.resets > self._resets:
            self._resets = faults.resets
            self.adapter.begin_anew()
        if faults.unplugged and self._line.plugged:
            self._drain(time.monotonic() + _LONGEST_DRAIN_S)
            truth.close_channel(self._line.unread_bytes())
            self._line.unplug()
            self._elsewhere = faults.renamed
        elif not faults.unplugged and not self._line.plugged:
            self.adapter.begin_anew()
            self._line.plug(elsewhere=self._elsewhere)

    def _send(self, pieces: Sequence[Piece], now_ns: int) -> None:
        """Write pieces, and report to the truth how much of each went out."""
        room = self._line.write(b"".join(piece.data for piece in pieces))
        for piece in pieces:
            written = min(max(room, 0), len(piece.data))
            room -= len(piece.data)
            if self._faults is not None:
                self._faults.truth.hand_on(piece, written, now_ns)
            self.sent_frames += room >= 0 and piece.sent is not None
            self.lost_frames += room < 0 and piece.sent is not None

    def _obey_until(self, deadline_s: float) -> bool:
        """Serve commands until a time on the monotonic clock; return False after a request to stop."""
        while not self._stop.is_set():
            left_s = deadline_s - time.monotonic()
            heard = self._line.listen(min(max(left_s, 0.0), _STOP_POLL_S))
            if heard:
                self._obey(heard)
            elif left_s <= 0:
                return True
        return False

    def _obey(self, heard: bytes) -> None:
        if self._faults is None:
            self._line.write(self.adapter.feed(heard))
            return
        was_open = self.adapter.channel_open
        unread_bytes = self._line.left_bytes() if b"C" in heard else self._line.unread_bytes()
        answer = self.adapter.feed(heard)
        if self.adapter.channel_open != was_open:  # closing and opening drop old bytes, answers as well
            self._faults.truth.close_channel(unread_bytes)
        if not self.adapter.channel_open:
            self._line.write(answer)
            return
        if not was_open:
            self._faults.truth.open_channel()
        self._send([Piece(answer, None, answer=True)], time.monotonic_ns())

    def _drain(self, deadline_s: float = math.inf) -> None:
        """Let the client fetch the bytes under way, which hanging up would discard."""
        while self.adapter.channel_open and self._line.unread_bytes() and time.monotonic() < deadline_s:
            if not self._obey_until(time.monotonic() + _DRAIN_POLL_S):
                return

"""Emulator: a XELA controller behind an slcan adapter, on a pseudo-terminal.

No kinder than the device: silent until bitrate and open, deaf at the wrong line speed, and frames
that the client does not fetch in time are lost. To try a client by hand:

    python -m firmware_bridge.emulator FILE [FILE]

The first line it prints is the port.
"""

import argparse
import fcntl
import math
import os
import random
import select
import struct
import sys
import termios
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from itertools import groupby
from pathlib import Path
from typing import Final, Self, TextIO

from firmware_bridge.controller import FRAME_S, Controller, SlcanAdapter, bus_timeline
from firmware_bridge.errors import BridgeError, RecordingError
from firmware_bridge.geometry import USPA44
from firmware_bridge.recording import Recording, load_recording
from firmware_bridge.slcan import CanFrame
from firmware_bridge.xela import USPA44_MAP

LINE_SPEED_BAUD: Final = 3_000_000
_STOP_POLL_S: Final = 0.05
_DRAIN_POLL_S: Final = 0.01

_SPEEDS_BAUD: Final = {
    getattr(termios, name): int(name[1:]) for name in dir(termios) if name[0] == "B" and name[1:].isdigit()
}


class Emulator:
    """Plays recordings on `port`, from the moment the channel is first opened; hangs up at the end.

    Attributes:
        port: path of the pseudo-terminal, once entered.
        adapter: its state, and what it refused.
        sent_frames: frames that went out whole.
        lost_frames: frames that found no room, because the client did not read.
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
        jitter_s: float = 0.001,
        latency_s: float = 0.001,
        frame_s: float = FRAME_S,
        ignores_line_speed: bool = False,
        seed: int = 0,
        on_scan: Callable[[int, int], object] = lambda controller, time_ns: None,
    ) -> None:
        """Prepare to play; nothing is opened yet.

        Args:
            recordings: each track is one sensor on the bus.
            controllers: their controller ids 0..15; by default 4, 6, 8, ...
            rate_hz: scans a second of each sensor; by default as recorded.
            loop: begin again after the last scan.
            acknowledges: answer commands.
            left_open: the channel is open from the start, as a client leaves it that was killed.
            jitter_s: a scan comes up to so much early or late, in [s].
            latency_s: the adapter hands on what it has once in this time, in [s].
            frame_s: what a frame takes on the bus, in [s]; a real one carries no more than 480 scans a second.
            ignores_line_speed: as USB-CDC adapters do.
            seed: of jitter and unused bytes.
            on_scan: told the controller and the monotonic time in [ns] when the last frame of a scan is handed on.

        Raises:
            ValueError: an option is out of range.
            RecordingError: a recording that this sensor cannot have made, or one that tells no rate.
        """
        for name, value in (("jitter_s", jitter_s), ("latency_s", latency_s), ("frame_s", frame_s)):
            if not 0 <= value < math.inf:
                raise ValueError(f"{name} is {value}, expected 0 or more")
        bus = _controllers(recordings, controllers, rate_hz)
        self.port = ""
        self.adapter = SlcanAdapter(acknowledges=acknowledges, left_open=left_open)
        self.sent_frames = 0
        self.lost_frames = 0
        self._timeline = bus_timeline(bus, jitter_s=jitter_s, seed=seed, loop=loop, frame_s=frame_s)
        self._latency_s = latency_s
        self._ignores_line_speed = ignores_line_speed
        self._on_scan = on_scan
        self._last_frames = {USPA44_MAP.wire_order(str(one.can_id))[-1][0]: one.can_id for one in bus}
        self._garble = random.Random(f"line {seed}")
        self._stop = threading.Event()
        self._through = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="emulator", daemon=True)

    def __enter__(self) -> Self:
        # The client's side stays open here as well, so that clients may come and go.
        self._adapter_fd, self._client_fd = os.openpty()
        os.set_blocking(self._adapter_fd, False)
        self.port = os.ttyname(self._client_fd)
        self._thread.start()
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.hang_up()

    def hang_up(self) -> None:
        """Pull the cable out."""
        self._stop.set()
        self._thread.join()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until it has hung up; False if it has not in time."""
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
                if self.adapter.hears_the_bus:
                    self._hand_on(frames)
            self._drain()
        finally:
            os.close(self._adapter_fd)
            os.close(self._client_fd)
            self._through.set()

    def _handed_on_s(self, timed: tuple[float, CanFrame]) -> float:
        if self._latency_s == 0:
            return timed[0]
        return math.ceil(timed[0] / self._latency_s) * self._latency_s

    def _hand_on(self, frames: Iterable[tuple[float, CanFrame]]) -> None:
        lines: list[bytes] = []
        ended: list[int] = []
        for time_s, frame in frames:
            lines.append(self.adapter.encode(frame, time_s))
            if frame.can_id in self._last_frames:
                ended.append(self._last_frames[frame.can_id])
        now_ns = time.monotonic_ns()  # before the write: who reads may be through before it is back
        room = self._write(b"".join(lines))
        for line in lines:
            room -= len(line)
            self.sent_frames += room >= 0
            self.lost_frames += room < 0
        for controller in ended:
            self._on_scan(controller, now_ns)

    def _obey_until(self, deadline_s: float) -> bool:
        """Serve commands until a time on the monotonic clock; False when told to stop."""
        while not self._stop.is_set():
            left_s = deadline_s - time.monotonic()
            readable, _, _ = select.select([self._adapter_fd], [], [], min(max(left_s, 0.0), _STOP_POLL_S))
            if readable:
                self._write(self.adapter.feed(self._through_line(os.read(self._adapter_fd, 4096))))
            elif left_s <= 0:
                return True
        return False

    def _write(self, data: bytes) -> int:
        """Send what finds room; an adapter has nowhere to keep the rest. Returns how much went out."""
        try:
            return os.write(self._adapter_fd, self._through_line(data))
        except BlockingIOError:
            return 0

    def _through_line(self, data: bytes) -> bytes:
        """What arrives at the other end: bytes of another speed are read as fewer or more, and as noise."""
        speed_baud = _SPEEDS_BAUD.get(termios.tcgetattr(self._client_fd)[5])
        if self._ignores_line_speed or speed_baud == LINE_SPEED_BAUD:
            return data
        return self._garble.randbytes(math.ceil(len(data) * min(1.0, (speed_baud or 0) / LINE_SPEED_BAUD)))

    def _drain(self) -> None:
        """Let the client fetch what is under way: hanging up takes it away from it."""
        while self.adapter.channel_open and self._unread_bytes():
            if not self._obey_until(time.monotonic() + _DRAIN_POLL_S):
                return

    def _unread_bytes(self) -> int:
        # Asking whether its side is readable makes the kernel bring up what it still holds back, but says no while
        # there is less than the client wants at once (VMIN); asking for the number alone says none too early.
        select.select([self._client_fd], [], [], 0)
        return struct.unpack("i", fcntl.ioctl(self._client_fd, termios.FIONREAD, bytes(4)))[0]


def _controllers(recordings: Sequence[Recording], can_ids: Sequence[int], rate_hz: float | None) -> list[Controller]:
    tracks = [(recording, track) for recording in recordings for track in recording.tracks]
    can_ids = can_ids or range(4, 4 + 2 * len(tracks), 2)
    if not len(tracks) == len(can_ids) == len(set(can_ids)) or not all(0 <= can_id <= 15 for can_id in can_ids):
        raise ValueError(f"controllers are {list(can_ids)}, expected {len(tracks)} different ones of 0..15")
    controllers: list[Controller] = []
    for (recording, track), can_id in zip(tracks, can_ids, strict=True):
        if track.counts.shape[1:] != USPA44.scan_shape:
            got = track.counts.shape[1:]
            raise RecordingError(f"{recording.path}: scans of shape {got}, expected {USPA44.scan_shape}")
        known_rates_hz = (rate_hz, recording.rate_hz, track.mean_rate_hz)
        own_rate_hz = next((known_hz for known_hz in known_rates_hz if known_hz is not None), None)
        if own_rate_hz is None:
            raise RecordingError(f"{recording.path} does not tell how fast it was recorded: give --rate-hz")
        if not 0 < own_rate_hz < math.inf:
            raise ValueError(f"rate is {own_rate_hz} Hz, expected a positive number")
        controllers.append(Controller(track, can_id, own_rate_hz))
    return controllers


def main(arguments: Sequence[str] | None = None) -> int:
    """Play the recordings named on the command line."""
    parser = argparse.ArgumentParser(prog="python -m firmware_bridge.emulator", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("file", nargs="+", help="recording, .csv or .npz")
    parser.add_argument("--controller", default="", metavar="N,N", help="controller ids (default: 4,6,8,...)")
    parser.add_argument("--rate-hz", type=float, help="scans a second of each sensor (default: as recorded)")
    parser.add_argument("--loop", action="store_true", help="begin again after the last scan")
    parser.add_argument("--no-acks", action="store_true", help="answer no command, as some firmwares do")
    parser.add_argument("--left-open", action="store_true", help="the channel is open from the start")
    parser.add_argument("--ignore-line-speed", action="store_true", help="as USB-CDC adapters do")
    parser.add_argument("--jitter-ms", type=float, default=1.0, help="of scans, up to so much (default: 1)")
    parser.add_argument("--latency-ms", type=float, default=1.0, help="of the adapter (default: 1)")
    parser.add_argument("--frame-us", type=float, default=1e6 * FRAME_S, help="of the bus, a frame (default: 130)")
    parser.add_argument("--seed", type=int, default=0, help="of jitter and unused bytes (default: 0)")
    parser.add_argument("--stamps", metavar="FILE", help="of each scan controller and time of its last frame, ns")
    parser.add_argument("--until-stdin-closes", action="store_true", help="end with the process that started it")
    options = parser.parse_args(arguments)
    with ExitStack() as closing:
        stamps = closing.enter_context(Path(options.stamps).open("w")) if options.stamps else None
        return _play(parser, options, stamps)


def _play(parser: argparse.ArgumentParser, options: argparse.Namespace, stamps: TextIO | None) -> int:
    try:
        emulator = Emulator(
            [load_recording(path) for path in options.file],
            controllers=[int(text) for text in options.controller.split(",") if text],
            rate_hz=options.rate_hz,
            loop=options.loop,
            acknowledges=not options.no_acks,
            left_open=options.left_open,
            jitter_s=options.jitter_ms / 1000,
            latency_s=options.latency_ms / 1000,
            frame_s=options.frame_us / 1e6,
            ignores_line_speed=options.ignore_line_speed,
            seed=options.seed,
            on_scan=lambda controller, time_ns: stamps.write(f"{controller} {time_ns}\n") if stamps else None,
        )
    except (BridgeError, ValueError) as error:
        parser.error(str(error))
    with emulator:
        sys.stdout.write(f"{emulator.port}\n")
        sys.stdout.flush()
        while not emulator.wait(_STOP_POLL_S):
            if options.until_stdin_closes and select.select([0], [], [], 0)[0] and not os.read(0, 4096):
                break
    return 0


if __name__ == "__main__":
    sys.exit(main())

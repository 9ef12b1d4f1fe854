"""Link over an slcan adapter on a serial port."""

import errno
import os
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final, Self

import serial

try:
    import termios
except ImportError:
    termios = None

from firmware_bridge.can.slcan import BITRATE_1M, CLOSE, OPEN, STAMPS_OFF, STAMPS_ON, CanFrame, encode_frame
from firmware_bridge.can.slcan_status import STATUS_FLAGS, StatusQuestions
from firmware_bridge.errors import DeviceError, LinkLostError
from firmware_bridge.links.base import Link, SerialLine, SourceKind, Unread, not_open
from firmware_bridge.links.fd_reader import Piece, PortReader
from firmware_bridge.links.serial_ports import NO_PERMISSION, PluggedAdapter, serial_ports
from firmware_bridge.links.usb_devices import in_use
from firmware_bridge.scans.can_id_maps import USPA44_MAP, ModelMap
from firmware_bridge.scans.scan import Scan
from firmware_bridge.scans.slcan_scans import SlcanScans

DEFAULT_BAUD: Final = 3_000_000
WRITE_TIMEOUT_S: Final = 1.0
QUIET_S: Final = 0.02
"""Silence after which the line counts as quiet, in [s]: a little over the 16 ms for which an FTDI chip holds bytes."""
LONGEST_SETTLE_S: Final = 0.3

MOST_SILENT_OPENINGS: Final = 10
"""Openings in a row without a scan after which stamps are not requested: a lasting link may reopen for days."""
MOST_LATE_STAMPS: Final = 4
"""Lines lost to stamps that are no milliseconds of a minute, after which stamps of this adapter are switched off."""
LATE_STAMPS_FRAMES: Final = 1000
"""Frames within which those lines must come: an occasional flipped digit is no evidence on the adapter's clock."""

# pyserial lets termios.error through, which is no OSError; Windows has no termios.
_PORT_ERRORS: Final[tuple[type[Exception], ...]] = (OSError, termios.error) if termios else (OSError,)


class SlcanSerialLink(Link):
    """Link to a sensor on an slcan adapter.

    Opening sends close, bitrate, time stamps on and open, and waits for no acknowledgement, since some
    adapters never send one. What arrives before the line falls silent is older than the opening and dropped.
    Closing sends close and time stamps off: some adapters keep that setting, and not every program expects stamps.
    They keep it in an EEPROM, which wears, so a bus that stays silent is not asked for stamps at every opening.

    It may be opened any number of times. An adapter with a USB serial number is then recognised under any
    name of its port.

    Attributes:
        port: path of the serial port.
        baudrate: speed of the serial line, in [bit/s]; USB-CDC adapters ignore it.
    """

    def __init__(
        self,
        port: str,
        baudrate: int = DEFAULT_BAUD,
        *,
        model: ModelMap = USPA44_MAP,
        triggers: Sequence[CanFrame] = (),
    ) -> None:
        """Prepare a link; nothing is opened yet. `triggers` are frames that wake older controllers, after opening."""
        self.name = f"slcan:{port}"
        # No hardware sensor is a pseudo-terminal, so a device on one is emulated.
        self.kind: SourceKind = "emulated" if Path(port).resolve().is_relative_to("/dev/pts") else "device"
        self.port = port
        self.baudrate = baudrate
        self._triggers = tuple(triggers)
        self._plugged = PluggedAdapter(port)
        # Two sensors at 100 scans a second take 832 kbit/s with stamps, and 704 without.
        self._asks_stamps = baudrate >= 1_000_000
        self._scans = SlcanScans(model)
        self._questions = StatusQuestions(self._scans.decoder.status)
        self._stamps_on = False
        self._silent_openings = 0
        self._frames_at_opening = 0
        self._late_stamps_from = (0, 0)
        self._counting = threading.Lock()  # counters are of whole pieces, whichever thread asks
        self._received_bytes = 0
        self._dropped_bytes = 0
        self._unread = Unread()
        self._serial: serial.Serial | None = None
        self._reader: PortReader | None = None
        self.fetches = True
        self._fetched: list[Piece] = []

    def __enter__(self) -> Self:
        self._begin_anew()
        self.port = self._plugged.find(serial_ports())
        self._serial = self._open_port()
        try:
            self._start(self._serial)
        except _PORT_ERRORS as error:
            self._serial.close()
            raise DeviceError(f"{self.port}: does not take commands: {error}") from error
        self._questions.reopened()
        return self

    def __exit__(self, *exc_info: object) -> None:
        port, self._serial, self._reader = self._serial, None, None
        if port is None:
            return
        self._drop_fetched()
        with suppress(*_PORT_ERRORS):  # gone already: no adapter to stop
            _wait_until_sent(port)
            for command in (CLOSE, STAMPS_OFF) if self._stamps_on else (CLOSE,):
                port.write(command)
                _wait_until_sent(port)
            self._dropped_bytes += _take_waiting(port.fileno())  # pyserial's next opening would drop them uncounted
        with suppress(*_PORT_ERRORS):
            if port.out_waiting:  # bytes that a dead device does not accept would delay the closing
                port.reset_output_buffer()
        port.close()

    def read(self, timeout_s: float) -> list[Scan]:
        """Return the scans that closed since the last call; raises LinkLostError if the port is gone."""
        if self._reader is None or self._serial is None:
            raise not_open()
        try:
            pieces = self._take_fetched() or [self._reader.read(timeout_s, self._scans.bytes_until_scan())]
        except _PORT_ERRORS as error:
            raise LinkLostError(f"{self.port}: link lost, the cable or the adapter is gone: {error}") from error
        scans: list[Scan] = []
        for data, time_ns, self._unread.empty_ns in pieces:
            with self._counting:
                self._received_bytes += len(data)
                fed = self._scans.feed(data, time_ns)
            scans += self._unread.mark(fed, time_ns, self._scans.clock.begun_ns)
        if self._questions.due(len(scans), self._scans.decoder.refusals, pieces[-1].time_ns):
            _ask(self._serial, STATUS_FLAGS)
        silence = not scans and self._questions.answered_in_silence
        self.trouble = self._scans.decoder.status.trouble(self._scans.decoder.frames, flags_of_a_silence=silence)
        if self._stamps_on and (self._stamps_are_none() or self._scans.clock.dropped):
            self.stamps_dropped = True
            self._asks_stamps = self._stamps_on = False
            self._open_anew(self._serial, STAMPS_OFF)
        elif scans and self._asks_stamps and not self._stamps_on:  # switched off while no scan came
            self._stamps_on = True
            self._open_anew(self._serial, STAMPS_ON)
        return scans

    def fetch(self) -> None:
        """Take the bytes there, without waiting for more."""
        if self._reader is None:
            return
        with suppress(*_PORT_ERRORS):  # the next read reports it
            piece = self._reader.take()
            if piece.data:
                self._fetched.append(piece)

    def _take_fetched(self) -> list[Piece]:
        pieces, self._fetched = self._fetched, []
        return pieces

    def _drop_fetched(self) -> None:
        self._dropped_bytes += sum(len(piece.data) for piece in self._take_fetched())

    def counters(self) -> dict[str, int]:
        """Return the counts of bytes received, and dropped on opening or closing, and the stages' counters."""
        with self._counting:
            sizes = {"received_bytes": self._received_bytes, "dropped_bytes": self._dropped_bytes}
            return sizes | self._scans.counters()

    def can_ids(self) -> frozenset[int]:
        """Return the standard CAN ids received so far."""
        return self._scans.can_ids

    def serial_line(self) -> SerialLine:
        """Return the port and its speed."""
        return SerialLine(self.port, self.baudrate)

    def _open_port(self) -> serial.Serial:
        try:
            port = serial.Serial(
                self.port, self.baudrate, rtscts=True, exclusive=True, timeout=0, write_timeout=WRITE_TIMEOUT_S
            )
        except (*_PORT_ERRORS, ValueError) as error:
            raise DeviceError(f"{self.port}: {_reason(error, self.port)}") from error
        # Not every platform and driver can: there scans come in bunches.
        with suppress(OSError, ValueError, NotImplementedError, AttributeError):
            port.set_low_latency_mode(True)
        return port

    def _start(self, port: serial.Serial) -> None:
        frames = self._scans.decoder.frames
        self._silent_openings = 0 if frames > self._frames_at_opening else self._silent_openings + 1
        self._frames_at_opening = frames
        self._late_stamps_from = self._scans.decoder.late_stamps, frames
        self._stamps_on = self._asks_stamps and self._silent_openings <= MOST_SILENT_OPENINGS
        # One write for each command: some adapters obey only the first one in a USB packet.
        for command in (CLOSE, BITRATE_1M, STAMPS_ON) if self._stamps_on else (CLOSE, BITRATE_1M):
            port.write(command)
            _wait_until_sent(port)
        self._drop_old_bytes(port)
        self._reader = PortReader(port.fileno())  # empty from here on: this thread may not run for long after OPEN
        port.write(OPEN)
        for frame in self._triggers:
            _wait_until_sent(port)
            port.write(encode_frame(frame))

    def _stamps_are_none(self) -> bool:
        late_before, frames_before = self._late_stamps_from
        if self._scans.decoder.late_stamps - late_before >= MOST_LATE_STAMPS:
            return True
        if self._scans.decoder.frames - frames_before >= LATE_STAMPS_FRAMES:
            self._late_stamps_from = self._scans.decoder.late_stamps, self._scans.decoder.frames
        return False

    def _open_anew(self, port: serial.Serial, stamps: bytes) -> None:
        """Reopen the channel with time stamps on or off, on a quiet line: of two forms at once most would be lost."""
        for command in (CLOSE, stamps):
            _say(port, command)
        with suppress(*_PORT_ERRORS):  # gone, which the next read reports
            self._drop_old_bytes(port)
            if self._reader is not None:
                self._reader = PortReader(port.fileno())
        self._begin_anew()
        _say(port, OPEN)

    def _begin_anew(self) -> None:
        with self._counting:
            self._scans.begin_anew()
            self._drop_fetched()

    def _drop_old_bytes(self, port: serial.Serial) -> None:
        """Drop and count the bytes that arrive before the line falls silent."""
        now_s = time.monotonic()
        quiet_s, end_s = now_s + QUIET_S, now_s + LONGEST_SETTLE_S
        while now_s < min(quiet_s, end_s):
            time.sleep(0.002)
            dropped = _take_waiting(port.fileno())
            self._dropped_bytes += dropped
            now_s = time.monotonic()
            if dropped:
                quiet_s = now_s + QUIET_S


def _say(port: serial.Serial, command: bytes) -> None:
    with suppress(*_PORT_ERRORS):  # gone, which the next read reports, or full: then no answer would come
        _wait_until_sent(port)
        os.write(port.fileno(), command)
        _wait_until_sent(port)


def _take_waiting(descriptor: int) -> int:
    """Read the waiting bytes, a bounded number of them, and return their count."""
    taken = 0
    with suppress(BlockingIOError):  # all bytes are read
        for _ in range(1024):
            taken += len(os.read(descriptor, 4096))
    return taken


def _ask(port: serial.Serial, question: bytes) -> None:
    """Send a request without waiting for the output; an adapter that accepts no bytes would not answer either."""
    with suppress(*_PORT_ERRORS):
        if not port.out_waiting:
            os.write(port.fileno(), question)


def _wait_until_sent(port: serial.Serial) -> None:
    # Not flush(): it waits for ever if flow control never releases the line.
    end_s = time.monotonic() + WRITE_TIMEOUT_S
    while port.out_waiting and time.monotonic() < end_s:
        time.sleep(0.001)


def _reason(error: Exception, port: str) -> str:
    code = getattr(error, "errno", None)
    if code in (errno.EACCES, errno.EPERM):
        return NO_PERMISSION
    if code in (errno.EBUSY, errno.EAGAIN):
        return in_use(port)
    if code in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        return f"no such port. Serial ports seen: {'; '.join(map(str, serial_ports())) or 'none'}"
    return f"cannot be used as a serial port: {os.strerror(code) if code else error}"

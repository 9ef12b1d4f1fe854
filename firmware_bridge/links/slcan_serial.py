"""Link over an slcan adapter on a serial port, which wakes up seldom: at the first bytes of a scan, and at its end.

A scan comes in many small pieces over some 2 ms, and waking Python up for each costs more than decoding them. A frame
takes its time on the bus, so it is known when the last one can have come: until then the reader sleeps.
"""

import errno
import math
import os
import select
import termios
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final, Self

import serial

from firmware_bridge.can.slcan import (
    BITRATE_1M,
    BUS_FLAGS,
    CLOSE,
    OPEN,
    STAMPS_OFF,
    STAMPS_ON,
    STATUS_FLAGS,
    encode_frame,
)
from firmware_bridge.errors import DeviceError, LinkLostError
from firmware_bridge.links.base import Link, SourceKind, Unread, not_open
from firmware_bridge.links.serial_ports import NO_PERMISSION, PluggedAdapter, in_use, serial_ports
from firmware_bridge.scans.can_id_maps import USPA44_MAP, ModelMap
from firmware_bridge.scans.scan import Scan
from firmware_bridge.scans.slcan_scans import SlcanScans
from firmware_bridge.schedule import ADAPTER_ASKED_NS

DEFAULT_BAUD: Final = 3_000_000
WRITE_TIMEOUT_S: Final = 1.0
QUIET_S: Final = 0.02  # silence after which the line is quiet: a little over the 16 ms that an FTDI chip holds bytes
LONGEST_SETTLE_S: Final = 0.3

MOST_SILENT_OPENINGS: Final = 10  # in a row, after which stamps are not requested: a lasting link may reopen for days

MOST_BYTES: Final = 65536  # most bytes read at once: as many as a kernel keeps for a serial port
BYTE_S: Final = 5e-6  # time in [s] for a byte of a frame's line, of which a frame of 0.13 ms has 26 at most
SHORTEST_SLEEP_S: Final = 0.0003
LONGEST_WAIT_S: Final = 0.004  # for the end of a scan after its first bytes: sixteen frames take 2.1 ms on the bus
LONGEST_LOOK_S: Final = 0.02  # longest time between two looks that find nothing, in [s]: `Unread` tells stalls by them

ASKED_AGAIN_NS: Final = 5_000_000_000  # between two requests for flags of a silent adapter: each request clears them
BUS_ERRORS: Final = "the adapter reports errors on the bus, and no frame arrives: check bitrate, wiring and termination"
_PORT_ERRORS: Final = (OSError, termios.error)  # pyserial lets termios.error through, which is no OSError

Piece = tuple[bytes, int, int]
"""Bytes received together, the time of that, and the latest time before at which the port was empty, in [ns]."""


class PortReader:
    """Reader of bytes from the descriptor of a serial port that is in raw mode and does not block."""

    def __init__(self, descriptor: int, *, clock_ns: Callable[[], int] = time.monotonic_ns) -> None:
        """Begin with a port that is empty; it raises OSError, or termios.error, if the port is gone."""
        self._descriptor, self._clock_ns = descriptor, clock_ns
        self._empty_ns = clock_ns()
        self._poll = select.poll()
        self._poll.register(descriptor, select.POLLIN)
        os.set_blocking(descriptor, False)
        attributes = termios.tcgetattr(descriptor)
        # With fewer, a port that is empty reads like one that is gone.
        attributes[6][termios.VMIN], attributes[6][termios.VTIME] = 1, 0
        termios.tcsetattr(descriptor, termios.TCSANOW, attributes)

    def read(self, timeout_s: float, wanted_bytes: int) -> Piece:
        """Return the bytes received, once `wanted_bytes` have come, or no more; wait at most `timeout_s` for any.

        Raises OSError once the port is gone, and all earlier bytes have been returned.
        """
        now_ns = self._clock_ns()
        end_ns = now_ns + round(timeout_s * 1e9)
        while not self._poll.poll(math.ceil(1000 * min(max((end_ns - now_ns) / 1e9, 0.0), LONGEST_LOOK_S))):
            self._empty_ns, now_ns = now_ns, self._clock_ns()  # from before the look: it may return long after it
            if now_ns >= end_ns:
                return b"", now_ns, self._empty_ns
        data, now_ns, empty_ns = self.take()
        end_ns = now_ns + round(LONGEST_WAIT_S * 1e9)
        while 0 < len(data) < wanted_bytes and now_ns < end_ns:
            time.sleep(max((wanted_bytes - len(data)) * BYTE_S, SHORTEST_SLEEP_S))
            try:
                more, now_ns, _ = self.take()
            except OSError:
                break  # left to the next call
            data += more
        return data, now_ns, empty_ns

    def take(self) -> Piece:
        """Return the bytes there, without waiting for more; raises as `read` does."""
        begun_ns, empty_ns = self._clock_ns(), self._empty_ns
        data = b""
        while len(data) < MOST_BYTES:
            try:
                part = os.read(self._descriptor, MOST_BYTES - len(data))
                if not part:
                    raise OSError(errno.EIO, "hung up")
            except BlockingIOError:
                break
            except OSError:
                if data:
                    break
                raise
            data += part
            if len(part) < 64:  # the kernel returns 64 bytes a call, and fewer only if no more are there
                break
        if len(data) < MOST_BYTES:
            self._empty_ns = begun_ns  # from before the read: this thread may not run for long after it
        return data, self._clock_ns(), empty_ns if data else self._empty_ns


class SlcanSerialLink(Link):
    """Link to a sensor on an slcan adapter.

    Opening waits for no acknowledgement, since some adapters never send one; what arrives before the line falls silent
    is older than the opening and dropped. Closing switches time stamps off: some adapters keep that setting, and not
    every program expects stamps. They keep it in an EEPROM, which wears, so a bus that stays silent is not asked for
    stamps at every opening.
    """

    def __init__(self, port: str, baudrate: int = DEFAULT_BAUD, *, model: ModelMap = USPA44_MAP) -> None:
        """Prepare a link; nothing is opened yet."""
        self.name = f"slcan:{port}"
        # No hardware sensor is a pseudo-terminal, so a device on one is emulated.
        self.kind: SourceKind = "emulated" if Path(port).resolve().is_relative_to("/dev/pts") else "device"
        self.port = port
        self.baudrate = baudrate  # speed of the serial line, in [bit/s]; USB-CDC adapters ignore it
        self._triggers = model.triggers
        self._plugged = PluggedAdapter(port)
        # Two sensors at 100 scans a second take 832 kbit/s with stamps, and 704 without.
        self._asks_stamps = baudrate >= 1_000_000
        self._scans = SlcanScans(model)
        self._scan_ns, self._answers_at_scan = 0, 0
        self._asked_ns: int | None = None
        self._stamps_on = False
        self._silent_openings = 0
        self._frames_at_opening = 0
        self._counting = threading.Lock()  # counters are of whole pieces, whichever thread asks
        self._counts = {"received_bytes": 0, "dropped_bytes": 0}
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
            self._serial = self._reader = None  # its descriptor may soon be another file's
            raise DeviceError(f"{self.port}: does not take commands: {error}") from error
        return self

    def __exit__(self, *exc_info: object) -> None:
        port, reader, self._serial, self._reader = self._serial, self._reader, None, None
        if port is None or reader is None:
            return
        self._drop_fetched()
        with suppress(*_PORT_ERRORS):  # gone already: no adapter to stop
            _send(port, *((CLOSE, STAMPS_OFF) if self._stamps_on else (CLOSE,)))
            self._counts["dropped_bytes"] += len(reader.take()[0])  # pyserial's next opening would not count them
        with suppress(*_PORT_ERRORS):
            if port.out_waiting:  # bytes that a dead device does not accept would delay the closing
                port.reset_output_buffer()
        port.close()

    def read(self, timeout_s: float) -> list[Scan]:
        """Return the scans that closed since the last call; raises LinkLostError if the port is gone."""
        if self._reader is None or self._serial is None:
            raise not_open()
        try:
            pieces = self._fetched or [self._reader.read(timeout_s, self._scans.bytes_until_scan())]
        except _PORT_ERRORS as error:
            raise LinkLostError(f"{self.port}: link lost, the cable or the adapter is gone: {error}") from error
        self._fetched = []
        scans: list[Scan] = []
        for data, time_ns, self._unread.empty_ns in pieces:
            with self._counting:
                self._counts["received_bytes"] += len(data)
                fed = self._scans.feed(data, time_ns)
            scans += self._unread.mark(fed, time_ns, self._scans.clock.begun_ns)
        now_ns, answers = pieces[-1][1], self._scans.decoder.status_answers
        if scans or not self._scan_ns:
            self._scan_ns, self._answers_at_scan, self._asked_ns, self.trouble = now_ns, answers, None, None
        else:
            self._ask_in_silence(self._serial, now_ns)
        if self._stamps_on and self._scans.clock.dropped:
            self.stamps_dropped = True
            self._asks_stamps = self._stamps_on = False
            self._open_anew(self._serial, STAMPS_OFF)
        elif scans and self._asks_stamps and not self._stamps_on:  # switched off while no scan came
            self._stamps_on = True
            self._open_anew(self._serial, STAMPS_ON)
        return scans

    def _ask_in_silence(self, port: serial.Serial, now_ns: int) -> None:
        """Request the status flags, which may explain that no scan comes: of any bus they hold an error at times."""
        decoder, asked_ns = self._scans.decoder, self._asked_ns
        if now_ns - self._scan_ns >= ADAPTER_ASKED_NS and (asked_ns is None or now_ns - asked_ns >= ASKED_AGAIN_NS):
            self._asked_ns = now_ns
            with suppress(*_PORT_ERRORS):  # an adapter that accepts no bytes would not answer either
                if not port.out_waiting:
                    os.write(port.fileno(), STATUS_FLAGS)
        in_errors = decoder.status_answers > self._answers_at_scan and decoder.flags & BUS_FLAGS
        self.trouble = BUS_ERRORS if in_errors else None

    def fetch(self) -> None:
        """Take the bytes there, without waiting for more."""
        if self._reader is None:
            return
        with suppress(*_PORT_ERRORS):  # the next read reports it
            piece = self._reader.take()
            if piece[0]:
                self._fetched.append(piece)

    def _drop_fetched(self) -> None:
        self._counts["dropped_bytes"] += sum(len(data) for data, _, _ in self._fetched)
        self._fetched = []

    def counters(self) -> dict[str, int]:
        """Return the counts of bytes received, and dropped on opening or closing, and the stages' counters."""
        with self._counting:
            return self._counts | self._scans.counters()

    def can_ids(self) -> frozenset[int]:
        """Return the standard CAN ids received so far."""
        return self._scans.assembler.can_ids

    def serial_line(self) -> tuple[str, int]:
        """Return the port and its speed in [bit/s]."""
        return self.port, self.baudrate

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
        self._stamps_on = self._asks_stamps and self._silent_openings <= MOST_SILENT_OPENINGS
        _send(port, *((CLOSE, BITRATE_1M, STAMPS_ON) if self._stamps_on else (CLOSE, BITRATE_1M)))
        self._reader = PortReader(port.fileno())
        self._drop_old_bytes(self._reader)
        _send(port, OPEN, *map(encode_frame, self._triggers))

    def _open_anew(self, port: serial.Serial, stamps: bytes) -> None:
        """Reopen the channel with time stamps on or off, on a quiet line: of two forms at once most would be lost."""
        with suppress(*_PORT_ERRORS):  # gone, which the next read reports, or full: then no answer would come
            _send(port, CLOSE, stamps)
            if self._reader is not None:
                self._drop_old_bytes(self._reader)
        self._begin_anew()
        with suppress(*_PORT_ERRORS):
            _send(port, OPEN)

    def _begin_anew(self) -> None:
        with self._counting:
            self._scans.begin_anew()
            self._drop_fetched()

    def _drop_old_bytes(self, reader: PortReader) -> None:
        """Drop and count the bytes that arrive before the line falls silent."""
        now_s = time.monotonic()
        quiet_s, end_s = now_s + QUIET_S, now_s + LONGEST_SETTLE_S
        while now_s < min(quiet_s, end_s):
            time.sleep(0.002)
            dropped = len(reader.take()[0])
            self._counts["dropped_bytes"] += dropped
            now_s = time.monotonic()
            if dropped:
                quiet_s = now_s + QUIET_S


def _send(port: serial.Serial, *commands: bytes) -> None:
    """Send commands, one write for each: some adapters obey only the first one in a USB packet."""
    _wait_until_sent(port)
    for command in commands:
        port.write(command)
        _wait_until_sent(port)


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

"""An slcan adapter on a serial port."""

import errno
import os
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

from firmware_bridge.assembler import SlcanScans
from firmware_bridge.errors import DeviceError, LinkLostError
from firmware_bridge.links.base import SourceKind
from firmware_bridge.links.bursts import BurstReader
from firmware_bridge.links.ports import serial_ports
from firmware_bridge.scan import Scan
from firmware_bridge.slcan import BITRATE_1M, CLOSE, OPEN, CanFrame, encode_frame
from firmware_bridge.xela import USPA44_MAP, ModelMap

DEFAULT_BAUD: Final = 3_000_000
WRITE_TIMEOUT_S: Final = 1.0
QUIET_S: Final = 0.02
"""A little over the 16 ms for which an FTDI chip may hold bytes back."""
LONGEST_SETTLE_S: Final = 0.3

# pyserial lets termios.error through, which is no OSError; Windows has no termios.
_PORT_ERRORS: Final[tuple[type[Exception], ...]] = (OSError, termios.error) if termios else (OSError,)
_PERMISSION = (
    "no permission: add the user to the group that owns it (often: sudo usermod -aG dialout $USER), log in again"
)
_BUSY = "in use: end what holds it, such as slcand, xela_server or another edge-sr"


class SlcanSerialLink:
    """Scans from a sensor behind an slcan adapter.

    Opening sends close, bitrate and open, and waits for no acknowledgement, since some adapters
    never send one. What arrives before the line falls silent is older than the opening and dropped.

    Attributes:
        port: path of the serial port.
        low_latency: the platform took the request not to hold bytes back.
    """

    def __init__(
        self,
        port: str,
        baudrate: int = DEFAULT_BAUD,
        *,
        rtscts: bool = True,
        model: ModelMap = USPA44_MAP,
        triggers: Sequence[CanFrame] = (),
    ) -> None:
        """Prepare a link; nothing is opened yet.

        Args:
            port: path of the serial port.
            baudrate: of the serial line, in bit/s; USB-CDC adapters ignore it.
            rtscts: hardware flow control.
            model: which CAN id is which taxel.
            triggers: frames that wake older controllers, sent once after opening.
        """
        self.name = f"slcan:{port}"
        # No hardware sensor is a pseudo-terminal: who is behind one only pretends.
        self.kind: SourceKind = "emulated" if Path(port).resolve().is_relative_to("/dev/pts") else "device"
        self.ended = False
        self.port = port
        self.low_latency = False
        self._baudrate = baudrate
        self._rtscts = rtscts
        self._triggers = tuple(triggers)
        self._scans = SlcanScans(model)
        self._received_bytes = 0
        self._serial: serial.Serial | None = None
        self._bursts: BurstReader | None = None

    def __enter__(self) -> Self:
        self._serial = self._open_port()
        try:
            self._start(self._serial)
            self._bursts = BurstReader(self._serial.fileno())
        except _PORT_ERRORS as error:
            self._serial.close()
            raise DeviceError(f"{self.port}: does not take commands: {error}") from error
        return self

    def __exit__(self, *exc_info: object) -> None:
        port, self._serial, self._bursts = self._serial, None, None
        if port is None:
            return
        with suppress(*_PORT_ERRORS):  # gone already: nobody left to tell
            port.write(CLOSE)
            _wait_until_sent(port)
        with suppress(*_PORT_ERRORS):
            if port.out_waiting:  # what a dead device does not take would hold up the closing
                port.reset_output_buffer()
        port.close()

    def read(self, timeout_s: float) -> list[Scan]:
        """Scans that closed since the last call; waits at most `timeout_s` for the first byte.

        Raises:
            LinkLostError: the port is gone.
        """
        if self._bursts is None:
            raise ValueError("the link is not open: use it in a with statement")
        try:
            data = self._bursts.read(timeout_s, self._scans.bytes_until_scan())
        except OSError as error:
            raise LinkLostError(f"{self.port}: link lost, the cable or the adapter is gone: {error}") from error
        self._received_bytes += len(data)
        return self._scans.feed(data, time.monotonic_ns())

    def counters(self) -> dict[str, int]:
        """Received bytes and the counters of decoder and assembler."""
        return {"received_bytes": self._received_bytes} | self._scans.counters()

    def _open_port(self) -> serial.Serial:
        try:
            port = serial.Serial(
                self.port,
                self._baudrate,
                rtscts=self._rtscts,
                exclusive=True,
                timeout=0,
                write_timeout=WRITE_TIMEOUT_S,
            )
        except (*_PORT_ERRORS, ValueError) as error:
            raise DeviceError(f"{self.port}: {_reason(error)}") from error
        try:
            port.set_low_latency_mode(True)
        except (OSError, ValueError, NotImplementedError, AttributeError):
            self.low_latency = False  # not this platform, or not this driver: scans come in bunches
        else:
            self.low_latency = True
        return port

    def _start(self, port: serial.Serial) -> None:
        # One write each: some adapters obey only the first command in a USB packet.
        for command in (CLOSE, BITRATE_1M):
            port.write(command)
            _wait_until_sent(port)
        self._drop_old_bytes(port)
        port.write(OPEN)
        for frame in self._triggers:
            _wait_until_sent(port)
            port.write(encode_frame(frame))

    def _drop_old_bytes(self, port: serial.Serial) -> None:
        port.timeout = QUIET_S
        end_s = time.monotonic() + LONGEST_SETTLE_S
        while port.read(1) and time.monotonic() < end_s:
            port.reset_input_buffer()


def _wait_until_sent(port: serial.Serial) -> None:
    # Not flush(): it waits for ever where flow control never lets go.
    end_s = time.monotonic() + WRITE_TIMEOUT_S
    while port.out_waiting and time.monotonic() < end_s:
        time.sleep(0.001)


def _reason(error: Exception) -> str:
    code = getattr(error, "errno", None)
    if code in (errno.EACCES, errno.EPERM):
        return _PERMISSION
    if code in (errno.EBUSY, errno.EAGAIN):
        return _BUSY
    if code in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        return f"no such port. Serial ports seen: {'; '.join(map(str, serial_ports())) or 'none'}"
    return f"cannot be used as a serial port: {os.strerror(code) if code else error}"

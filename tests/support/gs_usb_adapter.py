"""Emulated gs_usb adapter that treats requests, frames and a client that dies as a candleLight does.

It is no kinder than the device. Its queue holds 64 frames; a frame without room is lost, and a flag on the next frame
reports it. It receives nothing without the right bit timing. A client's death does not stop it.
"""

import struct
import threading
import time
from collections import deque
from typing import Final

from firmware_bridge.can import gs_usb
from firmware_bridge.can.gs_usb import BitTiming, BitTimingLimits
from firmware_bridge.can.slcan import CanFrame

QUEUE_FRAMES: Final = 64
CANDLELIGHT: Final = BitTimingLimits(
    features=0x13 | gs_usb.HARDWARE_STAMPS, clock_hz=48_000_000, tseg1_min=1, tseg1_max=16, tseg2_min=1, tseg2_max=8,
    sjw_max=4, brp_min=1, brp_max=1024, brp_inc=1,
)  # fmt: skip
_FRAME: Final = struct.Struct("<IIBBBB8s")


class StalledError(Exception):
    """Refusal of a request by the adapter."""


class GsUsbAdapter:
    """Adapter from one plugging-in to the next. Its methods may be called from any thread."""

    def __init__(self, limits: BitTimingLimits = CANDLELIGHT) -> None:
        """Plug it in."""
        self.started = False  # true while its channel is on the bus
        self.right_bitrate = False  # true where its timing makes 1 Mbit/s
        self.sent: list[CanFrame] = []  # frames that it put on the bus for the client
        self.lost_frames = 0  # frames that had no room
        self._limits = limits
        self._stamped = False
        self._overflowed = False
        self.queue: deque[bytes] = deque()  # host frames that wait to be fetched
        self._changed = threading.Condition()
        self.plugged = True  # while its cable is in

    def hear(self, *frames: CanFrame, stamp_us: int | None = None, channel: int = 0) -> None:
        """Receive frames from the bus, at `stamp_us` of its clock, by default now."""
        self._receive(frames, 0, stamp_us, channel)

    def report(self, classes: int, data: bytes = bytes(8)) -> None:
        """Send an error frame, of classes as in Linux's error.h."""
        self._receive((CanFrame(classes, data),), gs_usb.ERROR, None, 0)

    def unplug(self) -> None:
        """Pull the cable out, and wake all who wait for it."""
        with self._changed:
            self.plugged = False
            self._changed.notify_all()

    def request_out(self, number: int, payload: bytes) -> None:
        """Obey a request; raises StalledError if it knows none such, or the payload is too short."""
        lengths = {gs_usb.HOST_FORMAT: 4, gs_usb.BIT_TIMING: 20, gs_usb.MODE: 8}
        if len(payload) < lengths.get(number, 1 << 16):
            raise StalledError(f"request {number} with {len(payload)} bytes")
        with self._changed:
            if number == gs_usb.BIT_TIMING:
                timing = BitTiming(*struct.unpack_from("<5I", payload))
                self.right_bitrate = self._limits.clock_hz == timing.quanta * timing.brp * gs_usb.BITRATE_BIT_S
            elif number == gs_usb.MODE:
                wanted, features = struct.unpack_from("<II", payload)
                self.started = wanted == 1
                if self.started:
                    self._stamped = features & self._limits.features & gs_usb.HARDWARE_STAMPS != 0

    def request_in(self, number: int) -> bytes:
        """Answer a request; raises StalledError if it knows none such."""
        if number == gs_usb.BIT_TIMING_LIMITS:
            return struct.pack("<10I", *self._limits)
        raise StalledError(f"request {number}")

    def take(self, data: bytes) -> None:
        """Take a host frame to send, and echo it."""
        with self._changed:
            if self.started:
                echo_id, raw_id, dlc, _, _, _, payload = _FRAME.unpack_from(data)
                self.sent.append(CanFrame(raw_id, payload[:dlc]))
                self._enqueue(echo_id, raw_id, dlc, 0, payload, None)

    def fetch(self, timeout_s: float | None) -> bytes | None:
        """Wait for the next host frame and return it; None when there is none in time, or the cable is out."""
        with self._changed:
            self._changed.wait_for(lambda: not self.plugged or self.queue, timeout_s)
            return self.queue.popleft() if self.plugged and self.queue else None

    def _receive(self, frames: tuple[CanFrame, ...], flags: int, stamp_us: int | None, channel: int) -> None:
        with self._changed:
            for frame in frames:
                if not (self.started and self.right_bitrate):
                    return
                if len(self.queue) >= QUEUE_FRAMES:
                    self._overflowed = True
                    self.lost_frames += 1
                    continue
                raw_id = frame.can_id | flags | gs_usb.EXTENDED * frame.extended | gs_usb.REMOTE * frame.remote
                self._enqueue(gs_usb.RECEIVED, raw_id, len(frame.data), channel, frame.data, stamp_us)

    def _enqueue(self, echo_id: int, raw_id: int, dlc: int, channel: int, payload: bytes, stamp_us: int | None) -> None:
        flags = gs_usb.OVERFLOW_FLAG if self._overflowed and echo_id == gs_usb.RECEIVED else 0
        self._overflowed = self._overflowed and not flags
        data = _FRAME.pack(echo_id, raw_id, dlc, channel, flags, 0, payload)
        if self._stamped:
            data += struct.pack("<I", (time.monotonic_ns() // 1000 if stamp_us is None else stamp_us) & 0xFFFFFFFF)
        self.queue.append(data)
        self._changed.notify_all()

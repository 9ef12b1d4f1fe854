"""gs_usb, the protocol of candleLight adapters and their kin: requests, bit timing, and bytes to frames. No I/O.

The adapter sends host frames, little-endian, usually one in a USB transfer:

    u32 echo_id | u32 can_id | u8 dlc | u8 channel | u8 flags | u8 reserved | 8 bytes of data [| u32 time stamp in us]

echo_id is all ones where the frame came from the bus, else the number of one that we sent and that went out. can_id
holds three flags (extended, remote, error). A transfer begins with a frame, and a packet that is not full ends it: what
is not whole by then never will be. Within a transfer nothing marks where a frame begins, so a header is believed only
if every field is one that an adapter could send; where it is not, bytes are skipped until it is.

Source: Linux drivers/net/can/usb/gs_usb.c; candleLight_fw include/gs_usb.h.
"""

import struct
from collections.abc import Iterator
from typing import Final, NamedTuple

from firmware_bridge.can.slcan import CanFrame

BITRATE_BIT_S: Final = 1_000_000

REQUEST_OUT: Final = 0x41
REQUEST_IN: Final = 0xC1
HOST_FORMAT: Final = 0
BIT_TIMING: Final = 1
MODE: Final = 2
BIT_TIMING_LIMITS: Final = 4
DEVICE_CONFIG: Final = 5
LIMITS_BYTES: Final = 40
CONFIG_BYTES: Final = 12

HARDWARE_STAMPS: Final = 1 << 4
LPC546XX_QUIRK: Final = 1 << 9
"""This chip needs one byte behind every frame it gets."""

RECEIVED: Final = 0xFFFFFFFF
ECHO_IDS: Final = 10
"""How many frames may be under way to the bus, as Linux has it; their echo ids are 0..9."""

OVERFLOW_FLAG: Final = 1 << 0
FD_FLAG: Final = 1 << 1
_FLAGS: Final = 0x0F
EXTENDED: Final = 1 << 31
REMOTE: Final = 1 << 30
ERROR: Final = 1 << 29
_HIGHEST_STANDARD: Final = 0x7FF
_HIGHEST_EXTENDED: Final = 0x1FFFFFFF

HEADER_BYTES: Final = 12
FRAME_BYTES: Final = 20
STAMP_BYTES: Final = 4
_FD_MORE_BYTES: Final = 64 - 8

USUAL_SAMPLE_POINT: Final = 0.875
_SAMPLE_POINTS: Final = (0.75, 0.90)
"""Outside of these a bus of usual length does not work. Source: CiA 301, recommended bit timing."""

_header = struct.Struct("<IIBBBB")
_frame = struct.Struct("<IIBBBB8s")
_stamp = struct.Struct("<I")


class BitTimingLimits(NamedTuple):
    """What an adapter's CAN controller can do: its features, its clock in [Hz], and ranges in time quanta."""

    features: int
    clock_hz: int
    tseg1_min: int
    tseg1_max: int
    tseg2_min: int
    tseg2_max: int
    sjw_max: int
    brp_min: int
    brp_max: int
    brp_inc: int

    @classmethod
    def from_bytes(cls, data: bytes) -> "BitTimingLimits":
        """From the answer to the request BIT_TIMING_LIMITS.

        Raises:
            ValueError: it is too short.
        """
        if len(data) < LIMITS_BYTES:
            raise ValueError(f"bit timing limits have {len(data)} bytes, expected {LIMITS_BYTES}")
        return cls(*struct.unpack_from("<10I", data))


class BitTiming(NamedTuple):
    """The parts of a bit in time quanta, and how many clocks a quantum has."""

    prop_seg: int
    phase_seg1: int
    phase_seg2: int
    sjw: int
    brp: int

    @property
    def quanta(self) -> int:
        """Of a whole bit."""
        return 1 + self.prop_seg + self.phase_seg1 + self.phase_seg2

    @property
    def sample_point(self) -> float:
        """Where in a bit it is read, 0..1."""
        return (self.quanta - self.phase_seg2) / self.quanta

    def to_bytes(self) -> bytes:
        """For the request BIT_TIMING."""
        return struct.pack("<5I", *self)


def bit_timing(limits: BitTimingLimits) -> BitTiming:
    """The timing for 1 Mbit/s whose sample point is nearest to 87.5 %; of equal ones that of the finest quanta.

    Raises:
        ValueError: this controller cannot do it.
    """
    timings = list(_timings(limits))
    if not timings:
        raise ValueError(
            f"its CAN controller cannot do 1 Mbit/s sampled at {_SAMPLE_POINTS[0]:.0%} to {_SAMPLE_POINTS[1]:.0%} "
            f"(clock {limits.clock_hz} Hz, divided by {limits.brp_min} to {limits.brp_max}): use another adapter"
        )
    return min(timings, key=lambda timing: (abs(timing.sample_point - USUAL_SAMPLE_POINT), timing.brp))


def channel_count(config: bytes) -> int:
    """From the answer to the request DEVICE_CONFIG.

    Raises:
        ValueError: it is too short.
    """
    if len(config) < CONFIG_BYTES:
        raise ValueError(f"device configuration has {len(config)} bytes, expected {CONFIG_BYTES}")
    return config[3] + 1


def host_format() -> bytes:
    """Says that we speak little-endian; all but the first adapters speak nothing else."""
    return struct.pack("<I", 0x0000BEEF)


def mode(*, started: bool, features: int = 0) -> bytes:
    """For the request MODE: start the channel with some features, or reset it."""
    return struct.pack("<II", started, features if started else 0)


def encode_frame(frame: CanFrame, echo_id: int, limits: BitTimingLimits) -> bytes:
    """A frame to send on channel 0; `echo_id`, below ECHO_IDS, comes back when it has gone out."""
    raw_id = frame.can_id | EXTENDED * frame.extended | REMOTE * frame.remote
    data = _frame.pack(echo_id, raw_id, len(frame.data), 0, 0, 0, frame.data)
    return data + b"\0" if limits.features & LPC546XX_QUIRK else data


class HostFrame(NamedTuple):
    """What the adapter sent: a frame from the bus, or an error frame, with `error` the classes of errors.

    Attributes:
        frame: as it was on the bus; of an error frame only its data mean something.
        error: None of a frame from the bus.
        stamp_us: of the adapter's clock, which wraps round after 32 bits, in [us]; None if it has none.
        overflow: frames before this one were lost, since the adapter's queue was full.
    """

    frame: CanFrame
    error: int | None
    stamp_us: int | None
    overflow: bool


class GsUsbDecoder:
    """Cuts a byte stream into host frames. Any chunking gives the same frames and the same counters."""

    def __init__(self, *, stamped: bool, channels: int = 1) -> None:
        """Know how the adapter was started: with time stamps or not, and how many channels it has."""
        self._stamped = stamped
        self._channels = channels
        self._frame_bytes = FRAME_BYTES + STAMP_BYTES * stamped
        self._pending = b""
        self._in_step = True
        self._counts = dict.fromkeys(("frames", "error_frames", "echoes", "other_channels", "fd_frames"), 0)
        self._skipped_bytes = 0

    def end_transfer(self) -> None:
        """Give up a frame that is not whole: the next transfer begins with another."""
        self._skipped_bytes += len(self._pending)
        self._pending, self._in_step = b"", True

    def feed(self, data: bytes) -> list[HostFrame]:
        """Frames from channel 0 whose last byte lies in `data`; echoes and what we cannot want are left out."""
        buffer = self._pending + data
        end = len(buffer)
        position = 0
        taken: list[HostFrame] = []
        while end - position >= HEADER_BYTES:
            echo_id, raw_id, dlc, channel, flags, _ = _header.unpack_from(buffer, position)
            # Where a frame must begin, one of a channel that was not announced is one as well.
            known = channel < self._channels or self._in_step
            if not known or not self._plausible(echo_id, raw_id, dlc, flags):
                self._skipped_bytes += 1
                self._in_step = False
                position += 1
                continue
            size = self._frame_bytes + (_FD_MORE_BYTES if flags & FD_FLAG else 0)
            if end - position < size:
                break
            self._in_step = True
            if echo_id != RECEIVED:
                self._counts["echoes"] += 1
            elif channel != 0:
                self._counts["other_channels"] += 1
            elif flags & FD_FLAG:
                self._counts["fd_frames"] += 1
            else:
                taken.append(self._read(buffer, position, raw_id, dlc, flags))
            position += size
        self._pending = buffer[position:]
        return taken

    def counters(self) -> dict[str, int]:
        """Frames, those of each sort that is not given, and bytes that belong to none."""
        return self._counts | {"skipped_bytes": self._skipped_bytes}

    def _plausible(self, echo_id: int, raw_id: int, dlc: int, flags: int) -> bool:
        return (
            (echo_id == RECEIVED or echo_id < ECHO_IDS)
            and (raw_id & (EXTENDED | ERROR) != 0 or raw_id & _HIGHEST_EXTENDED <= _HIGHEST_STANDARD)
            and dlc <= 15
            and flags <= _FLAGS
        )

    def _read(self, buffer: bytes, position: int, raw_id: int, dlc: int, flags: int) -> HostFrame:
        start = position + HEADER_BYTES
        is_error, remote = raw_id & ERROR != 0, raw_id & REMOTE != 0
        # Nine to fifteen are lawful on the wire, and mean eight.
        data = b"" if remote and not is_error else buffer[start : start + min(dlc, 8)]
        self._counts["error_frames" if is_error else "frames"] += 1
        stamp_us = _stamp.unpack_from(buffer, start + 8)[0] if self._stamped else None
        classes = raw_id & _HIGHEST_EXTENDED
        frame = CanFrame(classes, data, raw_id & EXTENDED != 0, remote)
        return HostFrame(frame, classes if is_error else None, stamp_us, flags & OVERFLOW_FLAG != 0)


def _timings(limits: BitTimingLimits) -> Iterator[BitTiming]:
    clocks, rest = divmod(limits.clock_hz, BITRATE_BIT_S)
    if rest:
        return
    step = max(limits.brp_inc, 1)
    for brp in range(max(limits.brp_min, 1), min(limits.brp_max, clocks) + 1, step):
        quanta, rest = divmod(clocks, brp)
        if rest:
            continue
        for phase_seg2 in range(max(limits.tseg2_min, 1), min(limits.tseg2_max, quanta) + 1):
            tseg1 = quanta - 1 - phase_seg2
            if not limits.tseg1_min <= tseg1 <= limits.tseg1_max:
                continue
            # The adapter adds the first two up; Linux halves them as well.
            prop_seg = tseg1 // 2
            sjw = max(1, min(limits.sjw_max, phase_seg2 // 2, tseg1 - prop_seg))
            timing = BitTiming(prop_seg, tseg1 - prop_seg, phase_seg2, sjw, brp)
            if _SAMPLE_POINTS[0] <= timing.sample_point <= _SAMPLE_POINTS[1]:
                yield timing

"""Protocol gs_usb of candleLight adapters and their kin: requests, bit timing, and bytes to frames. No I/O.

The adapter sends host frames, little-endian, usually one in a USB transfer:

    u32 echo_id | u32 can_id | u8 dlc | u8 channel | u8 flags | u8 reserved | 8 bytes of data [| u32 time stamp in us]

echo_id is all ones for a frame from the bus, else the number of a frame that this side sent and that went out. can_id
holds three flags (extended, remote, error). A transfer begins with a frame, and a packet that is not full ends it: a
frame that is incomplete by then stays incomplete. USB has checksums, so that no other bytes come between frames.

Source: Linux drivers/net/can/usb/gs_usb.c; candleLight_fw include/gs_usb.h.
"""

import struct
from enum import IntEnum
from typing import Final, NamedTuple

from firmware_bridge.can.slcan import CanFrame

BITRATE_BIT_S: Final = 1_000_000

REQUEST_OUT: Final = 0x41
REQUEST_IN: Final = 0xC1
LIMITS_BYTES: Final = 40

HARDWARE_STAMPS: Final = 1 << 4

RECEIVED: Final = 0xFFFFFFFF

OVERFLOW_FLAG: Final = 1 << 0
FD_FLAG: Final = 1 << 1

EXTENDED: Final = 1 << 31
REMOTE: Final = 1 << 30
ERROR: Final = 1 << 29
_HIGHEST_EXTENDED: Final = 0x1FFFFFFF

HEADER_BYTES: Final = 12
FRAME_BYTES: Final = 20

_SAMPLE_POINTS: Final = (0.75, 0.90)  # within which a bus of usual length works. Source: CiA 301, bit timing

_header = struct.Struct("<IIBBBB")
_frame = struct.Struct("<IIBBBB8s")
_stamp = struct.Struct("<I")


class Request(IntEnum):
    """Numbers of the adapter's control requests."""

    HOST_FORMAT = 0
    BIT_TIMING = 1
    MODE = 2
    BIT_TIMING_LIMITS = 4


class BitTimingLimits(NamedTuple):
    """Capabilities of an adapter's CAN controller: features, clock in [Hz], and ranges in time quanta."""

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
        """Decode the answer to the request BIT_TIMING_LIMITS; raises ValueError if it is too short."""
        if len(data) < LIMITS_BYTES:
            raise ValueError(f"bit timing limits have {len(data)} bytes, expected {LIMITS_BYTES}")
        return cls(*struct.unpack_from("<10I", data))


class BitTiming(NamedTuple):
    """Segments of a bit in time quanta, and the clock ticks in a quantum (brp)."""

    prop_seg: int
    phase_seg1: int
    phase_seg2: int
    sjw: int
    brp: int

    @property
    def quanta(self) -> int:
        """Number of time quanta in a bit."""
        return 1 + self.prop_seg + self.phase_seg1 + self.phase_seg2

    @property
    def sample_point(self) -> float:
        """Position within a bit at which it is sampled, 0..1."""
        return (self.quanta - self.phase_seg2) / self.quanta

    def to_bytes(self) -> bytes:
        """Encode the payload of the request BIT_TIMING."""
        return struct.pack("<5I", *self)


def bit_timing(limits: BitTimingLimits) -> BitTiming:
    """Return the timing for 1 Mbit/s of the finest quanta that allow a usual sample point, or raise a ValueError."""
    clocks, rest = divmod(limits.clock_hz, BITRATE_BIT_S)
    for brp in range(max(limits.brp_min, 1), min(limits.brp_max, clocks) + 1, max(limits.brp_inc, 1)):
        quanta, uneven = divmod(clocks, brp)
        phase_seg2 = min(max(-(-quanta // 8), limits.tseg2_min, 1), limits.tseg2_max)
        # The adapter sums the first two segments; they are halved as in Linux.
        tseg1 = quanta - 1 - phase_seg2
        prop_seg = tseg1 // 2
        timing = BitTiming(prop_seg, tseg1 - prop_seg, phase_seg2, max(1, min(limits.sjw_max, phase_seg2 // 2)), brp)
        possible = not rest and not uneven and limits.tseg1_min <= tseg1 <= limits.tseg1_max
        if possible and _SAMPLE_POINTS[0] <= timing.sample_point <= _SAMPLE_POINTS[1]:
            return timing
    raise ValueError(
        f"its CAN controller cannot do 1 Mbit/s sampled at {_SAMPLE_POINTS[0]:.0%} to {_SAMPLE_POINTS[1]:.0%} "
        f"(clock {limits.clock_hz} Hz, divided by {limits.brp_min} to {limits.brp_max}): use another adapter"
    )


def host_format() -> bytes:
    """Encode the choice of little-endian; all but the first adapters support nothing else."""
    return struct.pack("<I", 0x0000BEEF)


def mode(*, started: bool, features: int = 0) -> bytes:
    """Encode the payload of the request MODE: start the channel with the features, or reset it."""
    return struct.pack("<II", started, features if started else 0)


def encode_frame(frame: CanFrame, echo_id: int) -> bytes:
    """Encode a standard data frame to send on channel 0; `echo_id`, below 10, comes back once it has gone out."""
    return _frame.pack(echo_id, frame.can_id, len(frame.data), 0, 0, 0, frame.data)


class HostFrame(NamedTuple):
    """Frame received from the adapter: one from the bus, or an error frame."""

    frame: CanFrame  # as it was on the bus; only the data of an error frame have a meaning
    error: int | None  # error classes of an error frame, None for a frame from the bus
    stamp_us: int | None  # time by the adapter's clock, which wraps round after 32 bits, in [us]
    overflow: bool  # True where frames before this one were lost, since the adapter's queue was full


class GsUsbDecoder:
    """Decoder of a byte stream into host frames. Any chunking gives the same frames and the same counters."""

    def __init__(self, *, stamped: bool) -> None:
        self._pending = b""
        self._counts = dict.fromkeys(("frames", "error_frames", "echoes", "other_channels", "fd_frames"), 0)
        self._skipped_bytes = 0
        self.start(stamped=stamped)

    def start(self, *, stamped: bool) -> None:
        """Begin with an adapter that was started with time stamps or without."""
        self.end_transfer()
        self._stamped = stamped
        self._frame_bytes = FRAME_BYTES + 4 * stamped

    def end_transfer(self) -> None:
        """Discard an incomplete frame: the next transfer begins with another one."""
        self._skipped_bytes += len(self._pending)
        self._pending = b""

    def feed(self, data: bytes) -> list[HostFrame]:
        """Decode frames of channel 0 whose last byte lies in `data`; without echoes, FD frames and other channels."""
        buffer = self._pending + data
        position = 0
        taken: list[HostFrame] = []
        while len(buffer) - position >= HEADER_BYTES:
            echo_id, raw_id, dlc, channel, flags, _ = _header.unpack_from(buffer, position)
            size = self._frame_bytes + (64 - 8 if flags & FD_FLAG else 0)
            if len(buffer) - position < size:
                break
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
        """Return the counts of frames, of each kind that is left out, and of bytes that belong to no frame."""
        return self._counts | {"skipped_bytes": self._skipped_bytes}

    def _read(self, buffer: bytes, position: int, raw_id: int, dlc: int, flags: int) -> HostFrame:
        start = position + HEADER_BYTES
        is_error, remote = raw_id & ERROR != 0, raw_id & REMOTE != 0
        # A dlc of 9 to 15 is allowed on the wire, and means eight bytes.
        data = b"" if remote and not is_error else buffer[start : start + min(dlc, 8)]
        self._counts["error_frames" if is_error else "frames"] += 1
        stamp_us = _stamp.unpack_from(buffer, start + 8)[0] if self._stamped else None
        classes = raw_id & _HIGHEST_EXTENDED
        frame = CanFrame(classes, data, raw_id & EXTENDED != 0, remote)
        return HostFrame(frame, classes if is_error else None, stamp_us, flags & OVERFLOW_FLAG != 0)

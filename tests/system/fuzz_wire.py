"""Targets of the fuzzer that come over a wire: lines, frames, messages and commands."""

import json
import os
import struct

import numpy as np
from fuzz_samples import LONGEST_MESSAGE, REST, check_counts, refused

from edge.pipeline.commands import LONGEST_LINE_BYTES, CommandLines, Commands
from firmware_bridge.can.gs_usb import BitTiming, BitTimingLimits, GsUsbDecoder, bit_timing, channel_count
from firmware_bridge.can.slcan import LONGEST_LINE, CanFrame, SlcanDecoder, encode_frame
from firmware_bridge.scans.can_id_maps import USPA44_MAP
from firmware_bridge.scans.gs_usb_scans import GsUsbScans
from firmware_bridge.scans.slcan_scans import SlcanScans
from firmware_bridge.scans.xela_server_scans import ServerScans


def slcan(data: bytes) -> None:
    """Check slcan: equal frames for any chunks; each is in the text; no byte counts twice; memory is bounded."""
    whole, cut = SlcanDecoder(), SlcanDecoder()
    frames = whole.feed(data)
    step = 1 + len(data) % 31
    pieces = [frame for start in range(0, len(data), step) for frame in cut.feed(data[start : start + step])]
    assert pieces == frames and cut.counters() == whole.counters()
    assert whole.pending_bytes <= LONGEST_LINE
    text, position = data.upper(), 0
    for frame in frames:
        if not frame.remote:  # of which the length is not kept
            found = text.find(encode_frame(frame).upper(), position)
            assert found >= 0, (frame, data)
            position = found + 1
    for scan in SlcanScans(USPA44_MAP).feed(data, time_ns=1):
        check_counts(scan.counts)


def gs_usb(data: bytes) -> None:
    """Check gs_usb: equal frames for any chunks, each of them in the bytes; then their scans, stamped or not."""
    stamped, data = data[:1] > b"\x7f", data[1:]
    whole, cut = (GsUsbDecoder(stamped=stamped, channels=2) for _ in range(2))
    frames = whole.feed(data)
    step = 1 + len(data) % 31
    pieces = [frame for start in range(0, len(data), step) for frame in cut.feed(data[start : start + step])]
    assert pieces == frames and cut.counters() == whole.counters()
    assert all(frame.frame.data in data and len(frame.frame.data) <= 8 for frame in frames)
    scans = GsUsbScans()
    scans.start(stamped=stamped, channels=2)
    for scan in scans.feed(data, time_ns=1):
        check_counts(scan.counts)
    trouble = scans.trouble(2)
    assert trouble is None or ("\n" not in trouble and len(trouble) <= LONGEST_MESSAGE)


def gs_usb_seeds() -> list[bytes]:
    made = [b"\0", b"\xff"]
    for number, (can_id, _) in enumerate(USPA44_MAP.wire_order("4")):
        frame = struct.pack("<IIBBBB8s", 0xFFFFFFFF, can_id, 8, 0, 0, 0, bytes(range(8)))
        made[0] += frame
        made[1] += frame + struct.pack("<I", 600 * number)
    error = struct.pack("<IIBBBB8s", 0xFFFFFFFF, 0x20000004, 8, 0, 1, 0, bytes((0, 4, 0, 0, 0, 0, 96, 0)))
    return [*made, b"\0" + error + made[0][1:41]]


def gs_usb_limits(data: bytes) -> None:
    """Decode what an adapter reports about itself."""
    limits = refused(lambda: BitTimingLimits.from_bytes(data), ValueError)
    if isinstance(limits, BitTimingLimits):
        timing = refused(lambda: bit_timing(limits), ValueError)
        if isinstance(timing, BitTiming):
            assert timing.quanta * timing.brp * 1_000_000 == limits.clock_hz and len(timing.to_bytes()) == 20
    refused(lambda: channel_count(data), ValueError)


def gs_usb_limits_seeds() -> list[bytes]:
    return [struct.pack("<10I", 16, 48_000_000, 1, 16, 1, 8, 4, 1, 1024, 1), bytes(12)]


def server(data: bytes) -> None:
    """Feed messages by lines; the results are readings of this geometry, and counters."""
    scans = ServerScans()
    scans.begin()
    for number, text in enumerate(data.split(b"\n")):
        for scan in scans.feed(text, arrival_ns=10_000_000 * (1 + number)):
            check_counts(scan.counts)
    assert len(scans.foreign) <= 1110 and all(count >= 0 for count in scans.counters().values())
    trouble = scans.trouble
    assert trouble is None or ("\n" not in trouble and len(trouble) <= 10 * LONGEST_MESSAGE)


def server_seeds() -> list[bytes]:
    counts = REST.reshape(3, 16).T.ravel().tolist()
    texts = ",".join(f"{value:X}" for value in counts)
    welcome = {"message": "Welcome", "version": "1.7.6", "time": 1.7e9}
    sensor = {"data": texts, "taxels": 16, "model": "XR1944", "ups": [100] * 16, "temp": [300] * 16, "time": 1.7e9}
    newer = sensor | {"data": counts, "integer": counts, "calibrated": [0.5] * 48}
    messages = [welcome, *({"message": n, "time": 1.7e9 + n / 100, "1": sensor, "2": newer} for n in range(3))]
    return ["\n".join(json.dumps(one) for one in several).encode() for several in (messages, messages[:2])]


def slcan_seeds() -> list[bytes]:
    order = USPA44_MAP.wire_order("4")
    frames = [CanFrame(can_id, bytes((0, *np.uint16(REST[:, 0, 0]).byteswap().tobytes(), 0))) for can_id, _ in order]
    cycle = b"".join(map(encode_frame, frames))
    others = [CanFrame(0x1ABCDEF0, b"\x01\x02", extended=True, timestamp_ms=59_999), CanFrame(5, b"", remote=True)]
    return [cycle, cycle[:100] + cycle, b"".join(map(encode_frame, others)), b"\rz\r\aV1013\rF00\rsb000000\re1a\r"]


def commands(data: bytes) -> None:
    """Read anything on stdin: commands are those that exist, and no more than the lines that hold one."""
    read_end, write_end = os.pipe()
    os.write(write_end, data)
    os.close(write_end)
    asked = Commands()
    lines = CommandLines(asked, read_end)
    try:
        asked.ask(lines.read)
        got = [command for _ in range(len(data) // 4096 + 2) for command in asked.poll()]
        for command in got:
            assert command.name in ("reset", "zero")
            assert command.sensor is None or (isinstance(command.sensor, str) and command.name == "zero")
            assert isinstance(command.force, bool)
        assert len(got) + asked.refused <= data.count(b"\n") + 1
        assert len(got) <= data.count(b"reset") + data.count(b"zero") + data.count(b"\\u")
        assert len(lines._partial) <= LONGEST_LINE_BYTES + 1
    finally:
        lines.close()
        os.close(read_end)


def commands_seeds() -> list[bytes]:
    zero = b'{"cmd": "zero", "sensor": "4", "force": true}\n{"cmd":"zero"}\n'
    return [zero, b'{"cmd": "reset"}\n', b'{"cmd":"r\\u0065set"}\n\n{"cmd": ["reset"]}\n[[[[1e999, null]]]]\n']

"""CAN ids of each layout, and the readings in its frames."""

import pytest

from firmware_bridge.can.slcan import CanFrame
from firmware_bridge.scans.can_id_maps import (
    LAYOUT_A_MAP,
    LAYOUT_B_MAP,
    USPA44_MAP,
    XR1944_MAP,
)
from firmware_bridge.scans.scan_assembler import ScanAssembler

DATA = bytes.fromhex("937E317E1593120F")
BACKWARDS = [3, 2, 1, 0]


@pytest.mark.parametrize(
    ("can_id", "data", "place", "counts"),
    [  # the first two as a sensor sent them, with what its maker's server read in them
        (0x004, DATA, (0, 3), [32305, 32277, 37650]),
        (0x104, bytes.fromhex("938406805591BB0C"), (1, 3), [33798, 32853, 37307]),
        (0x004, b"\0" + DATA[1:7] + b"\xff", (0, 3), [32305, 32277, 37650]),
        (0x33F, b"\1" + bytes.fromhex("0000 8000 FFFF") + b"\1", (3, 0), [0, 32768, 65535]),
    ],
)
def test_golden_frames(can_id, data, place, counts):
    assembler, sensor = ScanAssembler(USPA44_MAP), str(can_id & 0xF)
    frames = [CanFrame(one, data if one == can_id else bytes(8)) for one, _ in USPA44_MAP.wire_order(sensor)]
    (scan,) = [scan for frame in frames for scan in assembler.feed_frame(frame, 0)]
    assert scan.sensor == sensor and scan.counts[:, *place].tolist() == counts


@pytest.mark.parametrize(
    ("model", "sensor", "ids"),
    [
        (USPA44_MAP, "4", [row << 8 | col << 4 | 4 for row in range(4) for col in BACKWARDS]),
        (XR1944_MAP, "4", [row // 2 << 8 | row % 2 << 6 | col << 4 | 4 for row in range(4) for col in BACKWARDS]),
        (LAYOUT_A_MAP, "1", range(0x710, 0x720)),
        (LAYOUT_A_MAP, "7", range(0x770, 0x780)),
        (LAYOUT_B_MAP, "1a", range(0x100, 0x110)),
        (LAYOUT_B_MAP, "1b", range(0x110, 0x120)),
        (LAYOUT_B_MAP, "3b", range(0x310, 0x320)),
    ],
)
def test_the_ids_of_each_layout(model, sensor, ids):
    assert [model.taxels[can_id] for can_id in ids] == [(sensor, taxel) for taxel in range(16)]


@pytest.mark.parametrize(
    ("model", "sensors", "triggered"),
    [(USPA44_MAP, 16, False), (XR1944_MAP, 16, False), (LAYOUT_A_MAP, 7, True), (LAYOUT_B_MAP, 14, True)],
)
def test_every_sensor_has_every_taxel_once(model, sensors, triggered):
    names = {sensor for sensor, _ in model.taxels.values()}
    assert (len(names), len(model.taxels), model.triggered) == (sensors, 16 * sensors, triggered)
    assert all(sorted(taxel for _, taxel in model.wire_order(sensor)) == [*range(16)] for sensor in names)


@pytest.mark.parametrize(
    "frame",
    [
        CanFrame(0x004, DATA[:7]),
        CanFrame(0x004, b""),
        CanFrame(0x004, DATA, extended=True),
        CanFrame(0x004, DATA, remote=True),
        CanFrame(0x004, b"", remote=True),
    ],
)
def test_foreign_frames(frame):
    assembler = ScanAssembler(USPA44_MAP)
    assert assembler.feed_frame(frame, 0) == []
    assert (assembler.counters()["foreign"], assembler.counters()["readings"]) == (1, 0)

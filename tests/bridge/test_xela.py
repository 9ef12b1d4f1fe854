import pytest

from firmware_bridge.can.slcan import CanFrame, encode_frame
from firmware_bridge.scans.can_id_maps import (
    LAYOUT_A_MAP,
    LAYOUT_B_MAP,
    USPA44_MAP,
    XR1944_MAP,
    Reading,
    decode,
    trigger_frame,
)

MAPS = [USPA44_MAP, XR1944_MAP, LAYOUT_A_MAP, LAYOUT_B_MAP]
DATA = bytes.fromhex("937E317E1593120F")


def test_golden_frames():
    """Frames as a sensor sent them, and what its maker's server read in them."""
    assert decode(CanFrame(0x004, DATA), USPA44_MAP) == Reading("4", 3, 32305, 32277, 37650)
    other = CanFrame(0x104, bytes.fromhex("938406805591BB0C"))
    assert decode(other, USPA44_MAP) == Reading("4", 7, 33798, 32853, 37307)


def test_uspa44_columns_run_backwards():
    seen = [
        [0x034, 0x024, 0x014, 0x004],
        [0x134, 0x124, 0x114, 0x104],
        [0x234, 0x224, 0x214, 0x204],
        [0x334, 0x324, 0x314, 0x304],
    ]
    for row, ids in enumerate(seen):
        for col, can_id in enumerate(ids):
            assert USPA44_MAP.taxels[can_id] == ("4", 4 * row + col)


def test_xr1944_is_two_sdas_of_two_rows():
    seen = [
        [0x034, 0x024, 0x014, 0x004],
        [0x074, 0x064, 0x054, 0x044],
        [0x134, 0x124, 0x114, 0x104],
        [0x174, 0x164, 0x154, 0x144],
    ]
    for row, ids in enumerate(seen):
        for col, can_id in enumerate(ids):
            assert XR1944_MAP.taxels[can_id] == ("4", 4 * row + col)


def test_layout_a():
    assert [LAYOUT_A_MAP.taxels[0x710 + n] for n in range(16)] == [("1", n) for n in range(16)]
    assert LAYOUT_A_MAP.taxels[0x725] == ("2", 5)


def test_layout_b_has_two_sensors_a_board():
    assert [LAYOUT_B_MAP.taxels[0x100 + n] for n in range(16)] == [("1a", n) for n in range(16)]
    assert [LAYOUT_B_MAP.taxels[0x110 + n] for n in range(16)] == [("1b", n) for n in range(16)]
    assert LAYOUT_B_MAP.taxels[0x31F] == ("3b", 15)


@pytest.mark.parametrize("model", MAPS, ids=lambda model: model.name)
def test_every_sensor_has_every_taxel_once(model):
    assert all(0 <= can_id <= 0x7FF for can_id in model.taxels)
    sensors = {sensor for sensor, _ in model.taxels.values()}
    for sensor in sensors:
        taxels = [taxel for _, taxel in model.wire_order(sensor)]
        assert sorted(taxels) == list(range(model.geometry.taxel_count))
    assert len(model.taxels) == len(sensors) * model.geometry.taxel_count
    assert len(sensors) <= 16


def test_how_many_sensors_a_bus_can_hold():
    counts = [len({sensor for sensor, _ in model.taxels.values()}) for model in MAPS]
    assert counts == [16, 16, 7, 14]


def test_every_id_of_layout_c_names_its_controller():
    for can_id in range(0x800):
        reading = decode(CanFrame(can_id, DATA), USPA44_MAP)
        ours = can_id >> 8 <= 3 and can_id >> 4 & 0xF <= 3
        assert (reading is not None) == ours, hex(can_id)
        if reading is not None:
            assert reading.sensor == str(can_id & 0xF)


@pytest.mark.parametrize(
    "frame",
    [
        CanFrame(0x044, DATA),
        CanFrame(0x404, DATA),
        CanFrame(0x004, DATA[:7]),
        CanFrame(0x004, b""),
        CanFrame(0x004, DATA, extended=True),
        CanFrame(0x004, DATA, remote=True),
        CanFrame(0x004, b"", remote=True),
        CanFrame(0x201, bytes((0x07, 0x00))),
    ],
)
def test_foreign_frames(frame):
    assert decode(frame, USPA44_MAP) is None


def test_the_unused_bytes_do_not_matter():
    readings = {
        decode(CanFrame(0x004, bytes([a]) + DATA[1:7] + bytes([b])), USPA44_MAP) for a in (0, 255) for b in (0, 9)
    }
    assert readings == {Reading("4", 3, 32305, 32277, 37650)}


@pytest.mark.parametrize("word", [0, 1, 0x7FFF, 0x8000, 0xFFFF])
def test_counts_are_unsigned(word):
    data = b"\x01" + word.to_bytes(2, "big") * 3 + b"\x01"
    assert decode(CanFrame(0x004, data), USPA44_MAP) == Reading("4", 3, word, word, word)


def test_trigger():
    assert encode_frame(trigger_frame(1)) == b"t20120700\r"
    assert [trigger_frame(board).can_id for board in (2, 7)] == [0x202, 0x207]
    for board in (0, 8):
        with pytest.raises(ValueError, match=r"expected 1\.\.7"):
            trigger_frame(board)
    assert [model.triggered for model in MAPS] == [False, False, True, True]

"""Cycles of scans: none mixes two, whatever is lost, and a sensor's place is recovered; readings name their cycle."""

import pytest
from bridge_samples import read_until_lost
from cycle_samples import (
    PLAIN,
    PLAIN_BURSTS,
    READERS,
    STAMPED,
    USB,
    bus,
    doubling,
    in_order,
    losing,
    numbered,
    pausing,
    read,
    swapping,
)
from wire_faults import FAULTS, STAMPS, Case, play
from wire_faults import READERS as LINE_READERS

from firmware_bridge.can.slcan import CanFrame
from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.links.slcan_serial import SlcanSerialLink
from firmware_bridge.scans.can_id_maps import ID_MAPS, LAYOUT_A_MAP, LAYOUT_B_MAP, USPA44_MAP

LONGEST_WAIT_MS = 1.5
FIRST = 1000
ORDERS = {
    "downwards": list(range(15, -1, -1)),
    "rows backwards": [4 * (place // 4) + 3 - place % 4 for place in range(16)],
    "begun elsewhere": [*range(5, 16), *range(5)],
    "any": [9, 2, 14, 0, 7, 11, 4, 1, 15, 6, 3, 12, 8, 5, 13, 10],
}
# Plain bursts of 16 ms end anywhere in a cycle, which looks like a pause of the bus until the period is known. Later,
# cycles that come late wait for others to show that none was lost. What holds for that reader as well is that nothing
# is mixed.
every_reader = pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
sharp_reader = pytest.mark.parametrize("reader", [PLAIN, STAMPED, USB], ids=lambda reader: reader.name)


@every_reader
@pytest.mark.parametrize("first_frame", range(16))
def test_who_joins_anywhere_has_the_next_cycle(reader, first_frame):
    worth = read(bus(12, first_frame=first_frame), reader)
    assert worth.mixed == 0
    assert worth.numbers["4"][0] == FIRST + (first_frame > 0)
    cut_off = (16 - first_frame) % 16
    assert worth.counters["resynchronised"] == cut_off or reader is PLAIN_BURSTS
    assert worth.whole == 12 - (first_frame > 0) or reader is PLAIN_BURSTS


@every_reader
@pytest.mark.parametrize("lost", range(16))
def test_a_lost_frame_costs_its_own_cycle_alone(reader, lost):
    frames = bus(12)
    del frames[16 * 5 + lost]
    worth = read(frames, reader)
    assert worth.mixed == 0
    assert worth.counters["torn_wire"] == 1 or reader is PLAIN_BURSTS
    missing = set(range(FIRST, FIRST + 12)) - set(worth.numbers["4"])
    assert missing == {FIRST + 5} or reader is PLAIN_BURSTS


@every_reader
@pytest.mark.parametrize("share", [0.0005, 0.05])
def test_no_scan_is_of_two_cycles_at_any_share_of_loss(reader, share):
    worth = read(losing(share, seed=1)(bus(400)), reader)
    assert worth.mixed == 0 and worth.whole > 400 * (1 - share) ** 16 * 0.8
    assert max(worth.waits_ms) < LONGEST_WAIT_MS or reader is PLAIN_BURSTS


@every_reader
def test_doubles_and_swaps_mix_nothing(reader):
    for fault in (doubling(0.02), swapping(0.02)):
        assert read(fault(bus(300)), reader).mixed == 0
    assert read(swapping(0.02)(bus(300)), reader).whole >= 240
    assert read(doubling(0.02)(bus(300)), reader).whole >= (280 if reader is PLAIN_BURSTS else 295)


@every_reader
@pytest.mark.parametrize("stall_ms", [5, 70, 500])
def test_a_reader_that_stands_still_mixes_nothing(reader, stall_ms):
    stalls = [(0.9 * n + 0.0131 * (n % 7), stall_ms / 1000) for n in range(1, 6)]
    worth = read(bus(600), reader, stalls=stalls)
    assert worth.mixed == 0
    assert worth.numbers["4"][-50:] == list(range(FIRST + 550, FIRST + 600)) or reader is PLAIN_BURSTS


@sharp_reader
@pytest.mark.parametrize("pause_ms", [2, 10, 30, 200])
def test_a_bus_that_pauses_mixes_nothing(reader, pause_ms):
    every_s = 0.13 if pause_ms < 100 else 0.5
    worth = read(pausing(pause_ms / 1000, every_s, seed=1)(bus(600)), reader)
    assert worth.mixed == 0 and worth.whole > (250 if reader.stamped else 190)


@every_reader
def test_two_sensors_whose_phases_drift_are_told_apart(reader):
    worth = read(losing(0.002)(bus(400, (100, 103))), reader)
    assert worth.mixed == 0 and worth.numbers.keys() == {"4", "6"}
    assert worth.whole > 720


@pytest.mark.parametrize("reader", [PLAIN, STAMPED, USB], ids=lambda reader: reader.name)
@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("first_frame", [0, 7])
def test_another_order_is_learnt_and_nothing_mixed_meanwhile(reader, order, first_frame):
    worth = read(losing(0.005)(in_order(bus(300, first_frame=first_frame), ORDERS[order])), reader)
    # Without stamps a pause counts only once the period is measured: until then the order of the ids is all there is.
    assert worth.mixed <= (2 if reader is PLAIN and order == "begun elsewhere" else 0) and worth.whole > 250
    assert worth.numbers["4"][0] < FIRST + 12
    assert worth.numbers["4"][-1] == FIRST + 299


@pytest.mark.parametrize("model", [LAYOUT_A_MAP, LAYOUT_B_MAP, ID_MAPS["XR1944"]], ids=lambda model: model.name)
def test_other_layouts_are_cut_alike(model):
    sensor = model.taxels[next(iter(model.taxels))][0]
    ids = [can_id for can_id, _ in model.wire_order(sensor)]
    usual = [can_id for can_id, _ in USPA44_MAP.wire_order("4")]
    renamed = dict(zip(usual, ids, strict=True))
    for first_frame in range(16):
        frames: list[tuple[float, CanFrame]] = [
            (time_s, frame._replace(can_id=renamed[frame.can_id])) for time_s, frame in bus(20, first_frame=first_frame)
        ]
        del frames[75]
        worth = read(frames, PLAIN, model=model)
        assert worth.mixed == 0 and worth.whole >= 18 - (first_frame > 0)


@pytest.mark.parametrize("old_canable", [True, False], ids=["plain", "stamped"])
def test_a_link_opened_in_mid_cycle_gives_scans_of_one(old_canable):
    """The real serial path is used, as its reader waits for the bytes of a cycle and could sleep through one."""
    recording = numbered(60, first=FIRST)
    with (
        Emulator([recording], first_frame=5, old_canable=old_canable) as emulator,
        SlcanSerialLink(emulator.port) as link,
    ):
        scans = read_until_lost(link)
        assert link.counters()["resynchronised"] >= 11
    assert all(len(set(scan.counts[2][scan.fresh].tolist())) == 1 for scan in scans)
    # Without stamps a machine that is busy for long cannot show that no cycle was lost meanwhile.
    assert len(scans) > (20 if old_canable else 40)


SLOW_OR_FAST = [name for name in STAMPS if "%" in name]
NO_CLOCK = [name for name in STAMPS if name not in ("good", *SLOW_OR_FAST)]


@pytest.mark.parametrize("reader", LINE_READERS)
@pytest.mark.parametrize("lost", FAULTS)
@pytest.mark.parametrize("stamps", [None, *STAMPS], ids=str)
def test_no_scan_of_a_faulty_wire_is_of_two_cycles(stamps, lost, reader):
    found = play(Case(stamps, lost, reader), 400)
    assert found.mixed == 0 and found.scans == found.whole + found.torn
    assert found.whole > (350 if lost == "nothing" else 250)
    assert found.late <= 1 and found.lag_ms < 60
    if lost == "nothing" and reader != "each 16 ms" and stamps in (None, "good", *SLOW_OR_FAST):
        assert found.missed == 0 and found.torn == 0


@pytest.mark.parametrize("lost", FAULTS)
@pytest.mark.parametrize("stamps", [None, "good"], ids=str)
@pytest.mark.parametrize(("sensors", "rate_hz"), [(2, 100), (4, 100), (1, 10), (1, 400)])
def test_nor_is_one_of_several_sensors_or_of_another_rate(sensors, rate_hz, stamps, lost):
    found = play(Case(stamps, lost, "each ms", sensors, rate_hz), 600 // sensors)
    assert found.mixed == 0 and found.whole > 380
    assert lost != "nothing" or found.missed == found.torn == 0


@pytest.mark.parametrize("stamps", [*SLOW_OR_FAST, *NO_CLOCK])
def test_a_clock_is_followed_or_dropped(stamps):
    found = play(Case(stamps, "nothing"), 1500)
    assert found.late <= 1 and found.missed <= 20
    assert found.lag_ms < 5 or stamps not in SLOW_OR_FAST

"""Readings to scans: where a scan is cut, what is counted, and which sensors exist."""

import random
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_bridge.can.slcan import CanFrame
from firmware_bridge.scans.can_id_maps import USPA44_MAP
from firmware_bridge.scans.device_clock import DeviceTime
from firmware_bridge.scans.scan import ABSENT, Scan
from firmware_bridge.scans.scan_assembler import Readings, ScanAssembler, key
from firmware_bridge.scans.wire_cycle import LONGEST_PAUSE_NS, MOST_DOUBTS

Reading = tuple[int, int, int, int]
"""Key of its id, and counts x, y, z."""
ORDER = [taxel for _, taxel in USPA44_MAP.wire_order("4")]


def cycle(number: int, sensor: str = "4") -> list[Reading]:
    """One cycle of a sensor in wire order; every reading of every cycle is different."""
    order = USPA44_MAP.wire_order(sensor)
    return [(key(can_id), 1000 * taxel + number, 2000 + number, 3000 + number) for can_id, taxel in order]


def feed_all(assembler: ScanAssembler, readings: list[Reading], time_ns: int, *stamps) -> list[Scan]:
    return assembler.feed(Readings(*zip(*readings, strict=True)), time_ns, *stamps)


def feed(assembler: ScanAssembler, readings: list[Reading], start_ns: int = 0) -> list[Scan]:
    return [scan for i, reading in enumerate(readings) for scan in feed_all(assembler, [reading], start_ns + i)]


def counters(assembler: ScanAssembler) -> dict[str, int]:
    return {name: count for name, count in assembler.counters().items() if count}


def test_a_scan_closes_with_its_last_taxel():
    assembler = ScanAssembler(USPA44_MAP)
    assert feed(assembler, cycle(0)[:-1]) == []
    (scan,) = feed_all(assembler, cycle(0)[-1:], 99)
    assert (scan.sensor, scan.number, scan.time_ns) == ("4", 0, 99)
    assert scan.complete and not scan.torn and not scan.repeated
    assert scan.counts.dtype == np.int32 and scan.counts.shape == (3, 4, 4)
    assert scan.counts.reshape(3, 16).T.tolist() == [[1000 * taxel, 2000, 3000] for taxel in range(16)]
    assert scan.fresh.all() and scan.renewed.all()
    assert not any(array.flags.writeable for array in (scan.counts, scan.fresh, scan.renewed))
    assert counters(assembler) == {"readings": 16, "scans": 1}


@pytest.mark.parametrize(
    ("parts", "fresh", "counted"),
    [
        # Losing the first or the last frame moves no cut.
        (
            [(0, 0, 16), (1, 1, 16), (2, 0, 16), (3, 0, 15), (4, 0, 16), (5, 0, 16)],
            [16, 15, 16, 15, 16, 16],
            {"torn_wire": 2, "missing_taxels": 2},
        ),
        # Who joins in mid-cycle has whole scans.
        ([(0, 7, 16), (1, 0, 16), (2, 0, 16)], [16, 16], {"resynchronised": 9}),
        # Another value of a taxel that came begins another scan.
        ([(0, 0, 16), (1, 0, 9), (2, 8, 9)], [16, 9], {"torn_wire": 1, "missing_taxels": 7}),
        # So does an order that wraps round, though the taxel had not come.
        (
            [(0, 0, 16), (1, 0, 3), (1, 4, 12), (2, 3, 16), (3, 0, 16)],
            [16, 11, 13, 16],
            {"torn_wire": 2, "missing_taxels": 8},
        ),
        # Half of the taxels make a sensor: scans of a wrong model map must be seen. Of fewer none is made.
        (
            [(0, 0, 8), (1, 0, 8), (2, 0, 9), (3, 0, 3), (4, 0, 1)],
            [8, 9],
            {"torn_wire": 2, "missing_taxels": 15, "unconfirmed": 8, "resynchronised": 3},
        ),
        ([(0, 0, 7), (1, 0, 7), (2, 0, 1)], [], {"unconfirmed": 14}),
    ],
)
def test_parts_of_cycles_are_cut_where_one_ends(parts, fresh, counted):
    """Each is of a cycle, from a place to another; what is cut is of one cycle."""
    assembler = ScanAssembler(USPA44_MAP)
    readings = [reading for number, first, end in parts for reading in cycle(number)[first:end]]
    scans = feed(assembler, readings)
    assert [int(scan.fresh.sum()) for scan in scans] == fresh
    assert [scan.number for scan in scans] == list(range(len(scans)))
    assert all(len(set(scan.counts[2][scan.fresh].tolist())) == 1 for scan in scans)
    newest = {z: at for at, (*_, z) in enumerate(readings)}  # not the one that closes a scan
    assert [scan.time_ns for scan in scans] == [newest[scan.counts[2].max()] for scan in scans]
    made = {"scans": len(fresh)} if fresh else {}
    assert counters(assembler) == {"readings": len(readings)} | made | counted


def test_renewed_is_against_the_taxels_own_reading_before():
    assembler = ScanAssembler(USPA44_MAP)
    second = cycle(0)
    second[2] = (*second[2][:3], 9)
    third = list(second)
    del third[4]
    fourth = list(second)
    fourth[4] = (fourth[4][0], 8, *fourth[4][2:])
    fourth[5] = (*fourth[5][:2], 8, fourth[5][3])
    scans = feed(assembler, cycle(0) + second + third + fourth + fourth)
    renewed = [np.flatnonzero(scan.renewed).tolist() for scan in scans]
    assert renewed == [list(range(16)), [ORDER[2]], [], sorted([ORDER[4], ORDER[5]]), []]
    assert [scan.torn for scan in scans] == [False, True, True, True, False]
    assert [scan.repeated for scan in scans] == [False, False, False, False, True]
    expected = {"readings": 79, "scans": 5, "torn_wire": 1, "torn_source": 2, "repeated": 1, "missing_taxels": 1}
    assert counters(assembler) == expected


@pytest.mark.parametrize("known", [False, True])
def test_what_comes_after_a_pause_is_of_another_scan(known):
    """As where the bus was off for a moment: half of one press and half of another are no reading of the pad."""
    assembler = ScanAssembler(USPA44_MAP)
    # A slow sensor, all of whose readings come at equal times: so its cycles are sixteen longest pauses long.
    before = [reading for number in range(3) for reading in cycle(number)]
    times_ns = [n * LONGEST_PAUSE_NS for n in range(-48, 11)] + [10 * LONGEST_PAUSE_NS + LONGEST_PAUSE_NS + 1]
    scans = []
    for reading, time_ns in zip([*before, *cycle(3)[:12]], times_ns, strict=True):
        # The device's own times count where there are any: being late here says nothing of the bus.
        stamps = ([time_ns], -time_ns) if known else ()
        scans += feed_all(assembler, [reading], 10 * time_ns if known else time_ns, *stamps)
    assert [int(scan.fresh.sum()) for scan in scans] == [16, 16, 16, 11]
    (scan,) = feed_all(assembler, cycle(4), times_ns[-1] + 1, *([[times_ns[-1] + 1] * 16] if known else []))
    assert set(scan.counts[2].ravel().tolist()) == {3004} and counters(assembler)["resynchronised"] == 1


@given(st.integers(0, 2**32), st.integers(0, 40))
@settings(deadline=None, max_examples=60)
def test_every_reading_is_in_a_scan_or_counted(seed, percent_lost):
    noise = random.Random(seed)
    bus = [reading for n in range(30) for reading in cycle(n) + cycle(n, "6") if noise.randrange(100) >= percent_lost]
    bus = [reading for reading in bus for _ in range(1 + (noise.randrange(20) == 0))]
    assembler, broken = ScanAssembler(USPA44_MAP), noise.randrange(len(bus))
    scans = feed(assembler, bus[:broken])
    assembler.begin_anew()
    scans += feed(assembler, bus[broken:], broken)
    told = assembler.counters()
    fresh = sum(int(scan.fresh.sum()) for scan in scans)
    counted = sum(told[name] for name in ("duplicates", "unconfirmed", "resynchronised", "abandoned"))
    still_open = told["readings"] - fresh - counted
    assert told["readings"] == len(bus) and 0 <= still_open < 2 * 16
    assert told["scans"] == len(scans) and told["torn_wire"] == sum(not scan.complete for scan in scans)
    assert told["missing_taxels"] == sum(int((~scan.fresh).sum()) for scan in scans)
    for scan in scans:
        assert ((scan.counts == ABSENT) == ~scan.fresh).all()
        assert not (scan.renewed & ~scan.fresh).any()
        # Nothing made up: each value is one that its taxel had in some cycle.
        numbers = scan.counts[1][scan.fresh] - 2000
        assert (scan.counts[0][scan.fresh] == 1000 * np.flatnonzero(scan.fresh) + numbers).all()
        assert (scan.counts[2][scan.fresh] == 3000 + numbers).all()


def play(assembler: ScanAssembler, number: int) -> list[int]:
    """Feed a cycle reading by reading, 100 a second, and return the numbers of the cycles that close."""
    times_ns = range(number * 10_000_000, (number + 1) * 10_000_000, 250_000)
    scans = [scan for one, at in zip(cycle(number), times_ns, strict=False) for scan in feed_all(assembler, [one], at)]
    return [int(scan.counts[2, 0, 0]) - 3000 for scan in scans]


def test_cycles_that_wait_for_one_in_time_are_counted():
    """A lost cycle makes the next ones late: they may be parts of two, and none came in time."""
    assembler = ScanAssembler(USPA44_MAP)
    assert [number for one in [*range(60), *range(61, 66)] for number in play(assembler, one)] == [*range(60), 64, 65]
    assert assembler.counters()["resynchronised"] == 3 * 16


def test_a_frame_tells_when_it_was_on_the_bus():
    assembler, order = ScanAssembler(USPA44_MAP), USPA44_MAP.wire_order("4")
    frames = [CanFrame(can_id, bytes(8)) for can_id, _ in order]
    for at_ns, frame in enumerate(frames * 2):  # the device's clock began 1000 ns before the host's
        scans = assembler.feed_frame(frame, 5000 + at_ns, DeviceTime(host_ns=4000 + at_ns, own_ns=5000 + at_ns))
    assert [(scan.device_ns, scan.time_ns) for scan in scans] == [(4031, 5031)]


def test_a_scan_held_back_when_the_link_broke_never_comes():
    assembler, ms = ScanAssembler(USPA44_MAP), 1_000_000
    played = partial(play, assembler)
    assert [number for paced in range(60) for number in played(paced)] == [*range(60)]
    assert played(61) == [], "a cycle was lost, so it may be parts of two"
    assembler.begin_anew()
    assert [number for paced in range(70, 75) for number in played(paced)] == [*range(70, 75)]
    assert assembler.counters()["abandoned"] == 16
    feed(assembler, cycle(75)[:8], 750 * ms)
    assembler.begin_anew()
    assert feed(assembler, cycle(76)[8:], 760 * ms) == [], "nor is it joined with half of another"
    assert played(77) == [77] and assembler.counters()["abandoned"] == 16 + 8


def test_a_scan_is_waited_for_by_who_sends():
    """One flipped bit in an id, or a sensor unplugged in mid-scan, is not waited for."""
    assembler = ScanAssembler(USPA44_MAP)
    feed(assembler, cycle(0) + cycle(1))
    feed_all(assembler, cycle(0, "5")[:1], 50)
    assert assembler.fewest_missing() == 16
    feed(assembler, cycle(0, "6") + cycle(1, "6")[:9], 60)
    assert assembler.fewest_missing() == 7
    feed_all(assembler, cycle(2)[:2] + cycle(1, "6")[9:10], 80)
    assert assembler.fewest_missing() == 6
    feed_all(assembler, cycle(2)[2:3], 90)
    assert assembler.fewest_missing() == 13


def test_no_read_sleeps_while_an_order_is_to_be_learnt():
    assembler = ScanAssembler(USPA44_MAP)
    feed(assembler, cycle(0, "6")[:1])
    assert assembler.fewest_missing() == 16
    for number in range(2 * MOST_DOUBTS):
        feed(assembler, cycle(number, "5")[13:], 100 * number)
    assert assembler.fewest_missing() == 1
    feed(assembler, cycle(0) + cycle(1), 10_000)
    assert assembler.fewest_missing() == 16, "a sensor that exists does not wait for one that does not"

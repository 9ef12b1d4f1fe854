"""Cycles that are fed as one, stamped or not, among readings that come one by one, and halves that close."""

import numpy as np
import pytest

from firmware_bridge.scans.can_id_maps import USPA44_MAP, Cycle, Reading
from firmware_bridge.scans.device_clock import DeviceClock, DeviceTime
from firmware_bridge.scans.scan import ABSENT, Scan
from firmware_bridge.scans.scan_assembler import SCAN_GIVEN_UP_NS, ScanAssembler
from firmware_bridge.scans.wire_cycle import LONGEST_PAUSE_NS, MOST_DOUBTS, SHORTEST_PAUSE_NS

MS = 1_000_000
IDS = [can_id for can_id, _ in USPA44_MAP.wire_order("4")]
ORDER = [taxel for _, taxel in USPA44_MAP.wire_order("4")]


def cycle_of(ids: list[int]) -> Cycle:
    cycle = USPA44_MAP.cycle(ids)
    assert cycle is not None
    return cycle


WHOLE = cycle_of(IDS)


def readings(number: int, sensor: str = "4") -> list[Reading]:
    return [Reading(sensor, taxel, 1000 * taxel + number, 2000 + number, 3000 + number) for taxel in ORDER]


def packed(number: int) -> bytes:
    """The same readings as frames without stamps: counter or so, three words, another byte."""
    words = (b"".join(word.to_bytes(2, "big") for word in reading[2:]) for reading in readings(number))
    return b"".join(b"abc" + six + b"z" for six in words)


def feed(assembler: ScanAssembler, parts: list[Reading], time_ns: int = 0, *, stamped: bool = False) -> list[Scan]:
    """Feed readings of one moment; stamped, they were on the bus a tenth of that time from the device's beginning."""
    device = DeviceTime(time_ns - 7, time_ns // 10) if stamped else None
    return [scan for reading in parts for scan in assembler.feed(reading, time_ns, device)]


def feed_cycle(assembler: ScanAssembler, number: int, time_ns: int = 0, *, stamped: bool = False) -> Scan:
    device = DeviceTime(time_ns - 7, time_ns // 10) if stamped else None
    return assembler.feed_cycle(WHOLE, packed(number), time_ns, device)


def counters(assembler: ScanAssembler) -> dict[str, int]:
    return {name: count for name, count in assembler.counters().items() if count}


@pytest.mark.parametrize("stamped", [False, True])
def test_a_cycle_fed_as_one_is_the_scan_of_its_readings(stamped):
    assembler, one_by_one = ScanAssembler(USPA44_MAP), ScanAssembler(USPA44_MAP)
    for number in range(3):
        (expected,) = feed(one_by_one, readings(number), 100 * number * MS, stamped=stamped)
        if number == 0:
            (got,) = feed(assembler, readings(0), stamped=stamped)
        else:
            got = feed_cycle(assembler, number, 100 * number * MS, stamped=stamped)
        assert (got.sensor, got.number, got.time_ns) == ("4", number, 100 * number * MS)
        assert got.device_ns == expected.device_ns == (100 * number * MS - 7 if stamped else None)
        np.testing.assert_array_equal(got.counts, expected.counts)
        assert got.counts.shape == (3, 4, 4) and got.whole and expected.whole
    assert counters(assembler) == counters(one_by_one) == {"readings": 48, "scans": 3}
    assert feed_cycle(assembler, 2, 300 * MS, stamped=stamped).repeated
    assert counters(assembler) == {"readings": 64, "scans": 4, "repeated": 1}


@pytest.mark.parametrize(("stamped", "pause_ns"), [(False, 50 * MS), (True, 5 * MS)])
@pytest.mark.parametrize("first", [feed, feed_cycle])
def test_the_period_is_measured_by_stamps_if_there_are_any(first, stamped, pause_ns):
    assembler = ScanAssembler(USPA44_MAP)
    feed(assembler, readings(0)[3:])  # of an unknown beginning: counts for nothing
    first(assembler, readings(1) if first is feed else 1, 10 * MS, stamped=stamped)
    assert assembler.longest_cycle_ns(WHOLE) == SHORTEST_PAUSE_NS
    feed_cycle(assembler, 2, 110 * MS, stamped=stamped)
    assert assembler.longest_cycle_ns(WHOLE) == pause_ns


def test_the_period_is_half_known_by_half_a_scan():
    for come, pause_ns in ((8, 5 * MS), (7, 10 * MS)):
        assembler = ScanAssembler(USPA44_MAP)
        feed(assembler, readings(0))
        feed(assembler, readings(1)[:come], 10 * MS)
        feed(assembler, readings(2), 20 * MS)
        assert assembler.longest_cycle_ns(WHOLE) == pause_ns


def test_a_link_that_was_away_has_no_period():
    assembler = ScanAssembler(USPA44_MAP)
    feed(assembler, readings(0))
    assembler.begin_anew()
    feed_cycle(assembler, 1, 20 * MS)
    assert assembler.longest_cycle_ns(WHOLE) == SHORTEST_PAUSE_NS
    feed_cycle(assembler, 2, 40 * MS)
    assert assembler.longest_cycle_ns(WHOLE) == 10 * MS


def test_a_cycle_is_taken_as_one_only_in_the_usual_order():
    assembler, other = ScanAssembler(USPA44_MAP), cycle_of([*IDS[1:], IDS[0]])
    assert assembler.longest_cycle_ns(WHOLE) == 0
    feed(assembler, readings(0))
    for _ in range(2):
        assert assembler.longest_cycle_ns(WHOLE) > 0 == assembler.longest_cycle_ns(other)
    feed(assembler, readings(1)[:1])
    assert assembler.longest_cycle_ns(WHOLE) == 0
    feed(assembler, readings(1)[1:])
    assert assembler.longest_cycle_ns(WHOLE) > 0


@pytest.mark.parametrize("stamped", [False, True])
def test_the_last_frame_of_a_cycle_again_is_a_duplicate(stamped):
    assembler = ScanAssembler(USPA44_MAP)
    feed(assembler, readings(0), stamped=stamped)
    feed_cycle(assembler, 1, stamped=stamped)
    assert feed(assembler, readings(1)[-1:], stamped=stamped) == []
    assert counters(assembler) == {"readings": 33, "scans": 2, "duplicates": 1}
    feed_cycle(assembler, 2, 10 * MS, stamped=stamped)
    feed(assembler, readings(1)[-1:], 10 * MS, stamped=stamped)
    assert counters(assembler)["duplicates"] == 1 and counters(assembler)["resynchronised"] == 1


def test_a_cycle_takes_doubts_of_the_order_away():
    assembler, ends = ScanAssembler(USPA44_MAP), [readings(number)[13:] for number in range(20)]
    feed(assembler, readings(0))
    for number in range(1, MOST_DOUBTS):
        feed(assembler, ends[number])
    feed_cycle(assembler, 8)
    for number in range(MOST_DOUBTS + 1, 2 * MOST_DOUBTS):
        feed(assembler, ends[number])
    assert assembler.longest_cycle_ns(WHOLE) > 0 and assembler.fewest_missing() == 16
    feed(assembler, ends[19])
    assert assembler.longest_cycle_ns(WHOLE) == 0, "one more, and the order is another"
    assert assembler.fewest_missing() == 1, "no pause is slept through while it is learnt"
    assert counters(assembler)["resynchronised"] == 15 * 3 and counters(assembler)["scans"] == 2


def test_a_cycle_shows_its_sensor_and_where_the_next_begins():
    assembler = ScanAssembler(USPA44_MAP)
    feed(assembler, readings(0)[5:])
    assert counters(assembler) == {"readings": 11, "resynchronised": 11}
    feed_cycle(assembler, 1)
    assembler.begin_anew()
    feed_cycle(assembler, 2)
    (torn,) = feed(assembler, readings(3)[1:])
    assert torn.fresh.sum() == 15 and counters(assembler)["torn_wire"] == 1


def test_a_cycle_fed_as_one_tells_when_others_are_given_up():
    assembler = ScanAssembler(USPA44_MAP)
    feed(assembler, [*readings(0), *readings(0, "6"), *readings(1, "6")[:9]])
    feed_cycle(assembler, 1, SCAN_GIVEN_UP_NS)
    assert assembler.fewest_missing() == 7
    feed_cycle(assembler, 2, SCAN_GIVEN_UP_NS + 1)
    assert assembler.fewest_missing() == 16


@pytest.mark.parametrize("stamped", [False, True])
def test_a_few_taxels_set_apart_by_a_pause_are_a_scan(stamped):
    assembler, factor = ScanAssembler(USPA44_MAP), 10 if stamped else 1
    feed(assembler, readings(0), stamped=stamped)
    assert feed(assembler, readings(1)[:7], stamped=stamped) == []
    later_ns = (LONGEST_PAUSE_NS + 1) * factor
    torn, whole = feed(assembler, readings(2), later_ns, stamped=stamped)
    assert torn.fresh.sum() == 7 and whole.whole
    assert (torn.counts[2][torn.fresh] == 3001).all() and (torn.counts[:, ~torn.fresh] == ABSENT).all()
    assert torn.time_ns == 0 and torn.device_ns == (-7 if stamped else None)
    assert counters(assembler) == {"readings": 39, "scans": 3, "torn_wire": 1, "missing_taxels": 9}


@pytest.mark.parametrize("stamped", [False, True])
def test_before_the_period_is_known_gaps_of_stamps_tell_a_pause(stamped):
    """By arrival alone it is not: our being late would look like one."""
    assembler, scans, now_ns = ScanAssembler(USPA44_MAP), [], 0
    for number, reading in enumerate(readings(0) + readings(1)):
        now_ns += 5 * MS if number == 25 else 130_000
        scans += assembler.feed(reading, now_ns, DeviceTime(now_ns, now_ns) if stamped else None)
    assert [int(scan.fresh.sum()) for scan in scans] == ([16, 9] if stamped else [16, 16])


def test_where_stamps_end_the_open_scan_ends_too():
    """Arrivals are on another clock, by which no pause between the two shows."""
    assembler = ScanAssembler(USPA44_MAP)
    feed(assembler, readings(0)[:5], 3 * MS, stamped=True)
    (scan,) = feed(assembler, readings(0)[5:] + readings(1), 4 * MS)
    assert scan.whole and counters(assembler) == {"readings": 32, "scans": 1, "abandoned": 5, "resynchronised": 11}


def test_a_pause_is_measured_by_the_device_s_own_clock():
    """Its times on our clock are a guess, and a better one may hide a pause: half a press would join another's half."""
    assembler, clock = ScanAssembler(USPA44_MAP), DeviceClock(1_000_000, None)
    feed(assembler, readings(0))
    for number, reading in enumerate(readings(1)[:9]):
        assembler.feed(reading, 400 * MS, clock.at(number, 400 * MS))
    (torn,) = assembler.feed(readings(2)[9], 450 * MS, clock.at(350, 450 * MS))
    assert not torn.complete

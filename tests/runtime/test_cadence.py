"""Period and deadline of a sensor, sensors that fall silent, and scans that left no trace."""

import itertools
import random
from dataclasses import replace

import pytest
from edge_samples import make_scan

from edge.pipeline.cadence import FEWEST_INTERVALS, LONGEST_BURST, SENSOR_SILENT_NS, SETTLING_SCANS, Cadence, Cadences

MS = 1_000_000
PERIOD_NS = 10 * MS
RATE_HZ = 100.0


def scan(number, time_ms, sensor="4", device_ms=None):
    device_ns = None if device_ms is None else device_ms * MS
    return replace(make_scan(number, sensor=sensor), time_ns=round(time_ms * MS), device_ns=device_ns)


def followed(intervals_ms, rate_hz=None):
    cadence = Cadence(rate_hz)
    for number, time_ms in enumerate(itertools.accumulate(intervals_ms, initial=0)):
        cadence.follow(scan(number, time_ms))
    return cadence


@pytest.mark.parametrize(
    ("intervals_ms", "period_ms"),
    [
        ([10] * (FEWEST_INTERVALS - 1), None),
        ([10] * FEWEST_INTERVALS, 10),
        ([9, 11, 10, 10, 900, 10, 1, 9, 11], 10),  # the median of what came
        ([20] * 40 + [5] * 31, 5),
        ([10] * 40 + [400] + [0.3] * 39 + [10] * 5, 10),  # scans that were held up come in a burst
        ([10] * 40 + [0.5] * (LONGEST_BURST + 40), 0.5),  # a sensor that has become much faster
        ([10, 0, 10, 0, 10, 0, 10, 0, 10], 10),  # scans of one read
    ],
)
def test_the_period_is_that_of_the_sensor(intervals_ms, period_ms):
    period_ns = followed(intervals_ms).period_ns
    assert period_ns == (None if period_ms is None else period_ms * MS)
    assert Cadence(100).period_ns == followed(intervals_ms, rate_hz=100).period_ns == 10 * MS


def test_a_pattern_is_late_after_one_period_and_not_before():
    cadence = followed([10] * 9)
    assert not cadence.late(10_000) and cadence.late(10_000.001) and not Cadence().late(1e9)


def missed(*scans):
    """Count what is missed of these scans and some more at their pace, as only scans after a gap show what was lost."""
    cadences, last = Cadences(rate_hz=RATE_HZ), scans[-1]
    after = [
        replace(
            last,
            number=last.number + n,
            time_ns=last.time_ns + n * PERIOD_NS,
            device_ns=None if last.device_ns is None else last.device_ns + n * PERIOD_NS,
        )
        for n in range(1, SETTLING_SCANS + 2)
    ]
    for one in (*scans, *after):
        cadences.follow(one)
    return cadences.missed


def test_what_never_came_is_counted_by_the_gap():
    assert missed(*(scan(n, 10 * n) for n in range(9))) == 0
    assert missed(scan(0, 0), scan(1, 30)) == 2
    assert missed(scan(0, 0), scan(1, 3_000)) == 299
    assert missed(scan(0, 0), scan(1, 30), scan(2, 60)) == 4


def test_jitter_is_no_loss():
    assert missed(scan(0, 0), scan(1, 15), scan(2, 20), scan(3, 35)) == 0
    assert missed(scan(0, 0), scan(1, 17), scan(2, 20), scan(3, 37), scan(4, 40)) == 0


def test_scans_that_were_thrown_away_unseen_are_not_missed_as_well():
    assert missed(scan(0, 0), scan(8, 100)) == 2
    assert missed(scan(0, 0), scan(10, 100)) == 0


def test_what_was_held_up_and_comes_in_a_burst_was_late_and_not_missed():
    """Forty scans are held up, two are lost."""
    cadences = Cadences()
    times_us = [10_000 * n for n in range(100)]
    times_us += [1_400_000 + 300 * n for n in range(40)]
    times_us += [10_000 * n for n in range(142, 200)]
    for number, time_us in enumerate(times_us):
        cadences.follow(replace(scan(number, 0), time_ns=1000 * time_us))
    assert cadences.missed == 2


def test_a_stall_that_lost_nothing_misses_nothing():
    """The median of the newest intervals, 1 % off, once made a second a period too long."""
    for seed in range(40):
        noise = random.Random(seed)
        cadences = Cadences()
        due_ms = [10 * n + noise.uniform(-1, 1) for n in range(1000)]
        arrivals_ms = [max(due, 2500 if 1500 <= due < 2500 else 0, 6200 if 5400 <= due < 6200 else 0) for due in due_ms]
        for number, arrival_ms in enumerate(arrivals_ms):
            late_ms = noise.expovariate(0.5) if noise.random() < 0.05 else 0.2
            one = replace(scan(number, 0), time_ns=round((arrival_ms + late_ms) * MS) + number)
            cadences.follow(one)
        assert cadences.missed == 0, seed


def missed_by_a_busy_reader(seed, *, stamped, away_ms, busy, lost=()):
    """Count what is missed of a thousand scans that came when the reader had time, which it lacked at first."""
    noise, cadences = random.Random(seed), Cadences()
    free_ms, arrival_ms = away_ms, 0.0
    for number, due in enumerate(due for due in range(1000) if due not in lost):
        due_ms = 10 * due + noise.uniform(-0.4, 0.4)
        if due_ms > free_ms and noise.random() < busy:
            free_ms = due_ms + noise.expovariate(1 / 15)
        arrival_ms = max(arrival_ms + 0.1, due_ms + 0.2, free_ms)
        unread_ms = arrival_ms - due_ms if arrival_ms - due_ms > 50 else 0
        one = replace(
            make_scan(number, sensor="4"),
            time_ns=round(arrival_ms * MS),
            device_ns=round(due_ms) * MS if stamped else None,
            unread_ns=round(unread_ms * MS),
        )
        cadences.follow(one)
    return cadences.missed


@pytest.mark.parametrize("away_ms", [0, 500])
def test_a_busy_reader_misses_with_time_stamps_just_what_was_lost(away_ms):
    """The pace of reading alone would give thousands missed of a thousand."""
    lost = {*range(300, 307), *range(600, 640)}
    for seed in range(20):
        assert missed_by_a_busy_reader(seed, stamped=True, away_ms=away_ms, busy=0.6) == 0
        assert missed_by_a_busy_reader(seed, stamped=True, away_ms=away_ms, busy=0.6, lost=lost) == 47


@pytest.mark.parametrize("away_ms", [0, 500])
def test_a_busy_reader_misses_next_to_nothing_without(away_ms):
    """Nothing was lost: its guess is off by one scan now and then, where it was off by thousands."""
    counts = [missed_by_a_busy_reader(seed, stamped=False, away_ms=away_ms, busy=0.2) for seed in range(20)]
    assert max(counts) <= 10 and sorted(counts)[10] == 0


def test_the_device_s_own_time_tells_bursts_from_losses():
    assert missed(scan(0, 0, device_ms=0), scan(1, 16, device_ms=10)) == 0
    assert missed(scan(0, 16, device_ms=0), scan(1, 16, device_ms=20)) == 1


def test_without_a_period_nobody_knows():
    cadences = Cadences()
    cadences.follow(scan(0, 0))
    cadences.follow(scan(1, 500))
    assert cadences.missed == 0


def test_a_finger_that_comes_after_it_was_missed_is_told_back_once():
    cadences, events = Cadences(["4", "6"], rate_hz=RATE_HZ), []
    for n in range(100):
        for sensor in ("4", "6") if n >= 80 else ("4",):
            back = cadences.follow(scan(n, 10 * n, sensor))
            events += [] if back is None else [back]
        events += cadences.look()
    assert [(event.kind, event.sensor, event.time_ns // MS) for event in events] == [
        ("silent", "6", SENSOR_SILENT_NS // MS + 10),
        ("back", "6", 800),
    ]
    assert events[1].text == "sensor 6 is back after 0.8 s"


def test_a_finger_that_falls_silent_while_the_other_goes_on_is_told_once_and_told_back():
    cadences, events = Cadences(rate_hz=RATE_HZ), []
    for n in range(200):
        for sensor in ("4", "6"):
            if sensor == "4" or not 20 <= n < 120:
                back = cadences.follow(scan(n, 10 * n, sensor))
                events += [] if back is None else [back]
        events += cadences.look()
    assert [(event.kind, event.sensor, event.time_ns // MS) for event in events] == [
        ("silent", "6", 190 + SENSOR_SILENT_NS // MS + 10),
        ("back", "6", 1200),
    ]
    assert events[0].text.startswith("no scan from sensor 6 for 0.5 s")
    assert events[1].text == "sensor 6 is back after 1.0 s"


def test_after_the_link_was_away_no_finger_is_silent_for_coming_second():
    cadences = Cadences(rate_hz=RATE_HZ)
    for sensor in ("4", "6"):
        cadences.follow(scan(0, 0, sensor))
    cadences.begin_anew(5_000 * MS)
    cadences.follow(scan(1, 5_000))
    assert cadences.look() == []
    cadences.follow(scan(2, 5_000 + SENSOR_SILENT_NS // MS + 1))
    assert [event.sensor for event in cadences.look()] == ["6"]


def test_one_link_that_was_away_excuses_its_own_sensors_alone():
    cadences = Cadences(rate_hz=RATE_HZ)
    for sensor in ("left/4", "right/4", "right/6"):
        cadences.follow(scan(0, 0, sensor))
    cadences.begin_anew(5_000 * MS, "left/")
    cadences.follow(scan(1, 5_000, "right/4"))
    assert [event.sensor for event in cadences.look()] == ["right/6"]


def test_a_sensor_that_there_should_be_and_is_never_heard_is_told_once():
    cadences = Cadences(["4", "6"], rate_hz=RATE_HZ)
    assert cadences.look() == []
    events = []
    for n in range(100):
        cadences.follow(scan(n, 10 * n))
        events += cadences.look()
    assert [(event.kind, event.sensor) for event in events] == [("silent", "6")]


def test_when_all_are_silent_it_is_not_a_finger():
    cadences = Cadences(rate_hz=RATE_HZ)
    for sensor in ("4", "6"):
        cadences.follow(scan(0, 0, sensor))
    assert cadences.look() == []

"""Stamps of a device on the host's clock."""

import random
from dataclasses import replace

import pytest
from edge_samples import make_scan

from edge.pipeline.cadence import Cadence
from firmware_bridge.scans.device_clock import DeviceClock

US, MS, S = 1_000, 1_000_000, 1_000_000_000
WRAP_US = 1 << 32  # 71.6 minutes
HOST_NS = 5_000 * S


@pytest.mark.parametrize(
    ("tick_ns", "wrap", "first", "delays_ms"),
    [
        (US, WRAP_US, 0, [0, 3, 16]),
        (US, WRAP_US, WRAP_US - 15_000, [0] * 4),  # the wrap of 32 bits is no step
        (MS, 60_000, 0, [0] * 20_000),  # milliseconds wrap each minute
    ],
)
def test_a_frame_is_placed_by_the_shortest_delay_over_any_wrap(tick_ns, wrap, first, delays_ms) -> None:
    clock = DeviceClock(tick_ns, wrap)
    mapped = [
        clock.host_ns((first + number * 10 * MS // tick_ns) % wrap, HOST_NS + (number * 10 + delay) * MS)
        for number, delay in enumerate(delays_ms)
    ]
    assert mapped == [HOST_NS + number * 10 * MS for number in range(len(delays_ms))]


def test_hours_of_silence_are_hours() -> None:
    clock = DeviceClock(US, WRAP_US)
    clock.host_ns(1_000, HOST_NS)
    silent_us = 3 * 3600 * 10**6
    arrival_ns = HOST_NS + silent_us * US + 4 * MS
    # After so long the drift between the clocks is unknown: the offset is estimated again, and the turns are counted.
    assert clock.host_ns((1_000 + silent_us) % WRAP_US, arrival_ns) == arrival_ns
    assert clock.host_ns((1_000 + silent_us + 10_000) % WRAP_US, arrival_ns + 26 * MS) == arrival_ns + 10 * MS


def times(stamps_us, arrivals_ms):
    clock = DeviceClock(US, None)
    return clock, [clock.at(us, HOST_NS + round(ms * MS)) for us, ms in zip(stamps_us, arrivals_ms, strict=True)]


@pytest.mark.parametrize(
    ("us_per_ms", "within_ms"), [(0, 60), (100, 60), (150, 60), (950, 12_500), (3000, 200), (1_000_000, 200)]
)
def test_stamps_of_another_unit_or_none_are_dropped(us_per_ms, within_ms) -> None:
    arrivals_ms = range(0, within_ms + 10, 10)
    clock, got = times([us_per_ms * ms for ms in arrivals_ms], arrivals_ms)
    assert clock.dropped and got[0] is not None and got[-1] is None
    assert clock.at(10**9, HOST_NS + 20_000 * MS) is None


def test_stamps_out_of_order_are_dropped_but_not_for_a_few() -> None:
    for steps_back, dropped in ((7, False), (8, True)):
        stamps_us = [ms * 1000 - 3001 * (ms % 2) * (ms // 2 < steps_back) for ms in range(49)]
        clock, _ = times(stamps_us, range(49))
        assert clock.dropped == dropped
    clock, _ = times([ms * 1000 - 3000 * (ms % 2) for ms in range(2000)], range(2000))
    assert not clock.dropped, "frames that changed places"
    clock, _ = times([ms * 1000 - 3001 * (ms % 10 == 0) for ms in range(2000)], range(2000))
    assert not clock.dropped, "few at a time"


LATE_READS_MS = [number + 19.3 * (number >= 23) + 467.7 * (number >= 24) for number in range(1, 101)]


@pytest.mark.parametrize(
    ("stamps_ms", "arrivals_ms"),
    [
        ([frame + 6 * (frame > 22) for frame in range(100)], LATE_READS_MS),  # two late reads of frames
        ([10 * frame // 16 for frame in range(640)], [frame * 36 / 16 for frame in range(640)]),  # a slow line
    ],
)
def test_frames_that_are_late_keep_their_stamps(stamps_ms, arrivals_ms) -> None:
    _, got = times([1000 * ms for ms in stamps_ms], arrivals_ms)
    assert None not in got


@pytest.mark.parametrize("stall_ms", [50, 200, 1000, 20_000])
def test_reads_that_are_late_drop_nothing(stall_ms) -> None:
    """The process stands still for so long each time; then all that waited, or the oldest of it, comes at once."""
    arrivals_ms, on_bus_ms = [], []
    for stop in range(20):
        begun_ms = stop * (stall_ms + 100)
        on_bus_ms += range(begun_ms, begun_ms + 100 + min(stall_ms, 200), 10)
        arrivals_ms += [*range(begun_ms, begun_ms + 100, 10), *[begun_ms + 99 + stall_ms] * (min(stall_ms, 200) // 10)]
    clock, got = times([ms * 1000 for ms in on_bus_ms], arrivals_ms)
    assert not clock.dropped
    oldest_ns = max(HOST_NS + ms * MS - time.host_ns for ms, time in zip(arrivals_ms, got, strict=True))
    assert oldest_ns >= 0.9 * (stall_ms - 2) * MS


def test_a_device_that_begins_anew_is_still_a_clock() -> None:
    clock, got = times([ms * 1000 % 1_000_000 for ms in range(0, 20_000, 10)], range(0, 20_000, 10))
    assert not clock.dropped and got[100].host_ns == HOST_NS + 1000 * MS, "mapped anew"


@pytest.mark.parametrize("back_ms", [-3_600_000, -50, 3, 12, 15, 99, 3000, 3_600_000])
def test_a_wall_clock_that_is_set_back_costs_no_scan(back_ms: int) -> None:
    """Stamps of socketcan and of a server are of one. No scan is lost, so none may be reported missing."""
    clock, cadence, noise = DeviceClock(US, None), Cadence(100.0), random.Random(back_ms)
    for number in range(2_000):
        bus_us = 10_000 * number
        arrival_ns = HOST_NS + bus_us * US + noise.randint(0, 2 * MS)
        stamp_us = 1_800_000_000_000_000 + bus_us - 1_000 * back_ms * (number >= 1_000)
        device_ns = clock.host_ns(stamp_us, arrival_ns)
        cadence.follow(replace(make_scan(number), time_ns=arrival_ns, device_ns=device_ns))
        assert abs(back_ms) < 10**6 or (device_ns is not None and 0 <= arrival_ns - device_ns <= 2 * MS)
    assert cadence.missed == 0

"""Pace of reading: late at rest, many sensors together, and at once in contact; what is read stays the same."""
# pyright: reportAttributeAccessIssue=false

import threading
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from edge_samples import REST, FakeLink, ListSink, make_scan
from runtime_samples import pumped

from edge.pipeline.pace import Pace, PaceSetter
from edge.pipeline.scan_reader import Source
from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.links.reconnecting import LastingLink
from firmware_bridge.links.slcan_serial import SlcanSerialLink
from firmware_bridge.recording.tracks import Recording, Track
from firmware_bridge.scans.scan import Scan


def followed(setter, scans, state="idle", *, stamped=True, begin=0):
    for number in range(begin, begin + scans):
        scan = make_scan(number)
        setter.follow(SimpleNamespace(state=state, scan=replace(scan, device_ns=scan.time_ns if stamped else None)))


def test_rest_is_a_second_without_contact_of_stamped_sensors():
    setter = PaceSetter(0.1)
    assert setter.choose(1, 0.01) == Pace()
    followed(setter, 50, "contact")
    assert setter.choose(1, 0.01) == Pace()
    followed(setter, 100, begin=50)
    assert setter.choose(1, 0.01) == Pace() and not setter.waited(make_scan(149))
    followed(setter, 2, begin=150)
    rest = setter.choose(1, 0.01)
    assert rest == Pace(0.01, 10) and setter.waited(make_scan(160))
    assert setter.choose(1, 0.0105) is rest, "a measured period jitters"
    followed(setter, 1, "contact", begin=152)
    assert setter.choose(1, 0.01) == Pace()
    assert setter.waited(make_scan(152)), "it was still on its way"
    assert not setter.waited(make_scan(154))


@pytest.mark.parametrize(
    ("sensors", "period_s", "patience_s", "stamped", "pace"),
    [
        (1, 0.01, 0.0, True, Pace()),
        (1, 0.01, 0.1, False, Pace()),
        (1, 0.002, 0.1, True, Pace()),
        (1, float("inf"), 0.1, True, Pace()),
        (3, 0.01, 0.0, True, Pace()),
        (4, 0.01, 0.0, True, Pace(0.0025)),
        (4, 0.1, 0.0, True, Pace()),
        (4, 0.01, 0.1, True, Pace(0.01, 10)),
    ],
)
def test_many_are_read_together_and_rest_needs_patience(sensors, period_s, patience_s, stamped, pace):
    setter = PaceSetter(patience_s)
    followed(setter, 200, stamped=stamped)
    assert setter.choose(sensors, period_s) == pace


def recording(scans, pressed):
    """Two sensors on a bus, which change in every scan, and are pressed at the end."""
    rng = np.random.default_rng(2)
    counts = [(REST + rng.integers(-3, 4, (scans, 3, 4, 4))).astype(np.int32) for _ in range(2)]
    for one in counts:
        one[pressed:, 2, 1, 1] += 3000
    tracks = tuple(Track(name, one, None) for name, one in zip("46", counts, strict=True))
    return Recording(Path("made.csv"), tracks, 100.0)


@pytest.mark.parametrize("pace", [Pace(0.01, 8), Pace(0.003), Pace()])
def test_what_is_read_does_not_depend_on_when(pace):
    """Cycles of two sensors mix on each of two buses, and reads end within them."""
    played = recording(100, 60)
    with ExitStack() as closing:
        emulators = [closing.enter_context(Emulator([played], waits=True)) for _ in range(2)]
        named = enumerate(emulators)
        source = Source(*(LastingLink(SlcanSerialLink(emulator.port), name=f"f{index}") for index, emulator in named))
        closing.enter_context(source)
        source.pace = pace
        taken: list[list[Scan]] = []
        end_s = time.monotonic() + 30
        while sum(map(len, taken)) < 400 and time.monotonic() < end_s:
            taken.append([one for one in source.take(0.1) or () if isinstance(one, Scan)])
        counters = source.counters()
    for name in ("f0/4", "f0/6", "f1/4", "f1/6"):
        mine = [[scan for scan in together if scan.sensor == name] for together in taken]
        scans = [scan for together in mine for scan in together]
        assert [scan.number for scan in scans] == list(range(100))
        expected = played.tracks["46".index(name[-1])].counts
        assert (np.stack([scan.counts for scan in scans]) == expected).all()
        assert pace.reads == 1 or max(map(len, mine)) >= 5
    assert counters["frames"] == counters["readings"] == 6400


@pytest.mark.parametrize("patience_s", [0.0, 0.2])
def test_a_contact_that_waited_gets_all_its_patterns(patience_s):
    """Its scans come together after rest: none is dropped, nor late by its pattern."""
    rested, scans = threading.Event(), [make_scan(n, noise=3, press_counts=(n >= 150) * (3000 + n)) for n in range(156)]
    stamped = [replace(scan, device_ns=scan.time_ns) for scan in scans]
    link = FakeLink([[scan] for scan in stamped[:150]] + [rested, stamped[150:]])

    class Patient(ListSink):
        def write(self, result, counters):
            super().write(result, counters)
            if result.scan.number == 149:
                rested.set()

    sink = Patient()
    sink.patience_s = patience_s
    late_ns = scans[-1].time_ns + 100_000_000
    statistics = pumped(link, sink, clock_ns=lambda: late_ns)
    patterns = [result.pattern is not None for result in sink.results if result.scan.number >= 150]
    assert len(patterns) == 6 and all(patterns) == (patience_s > 0)
    assert (statistics.dropped == statistics.late == 0) == (patience_s > 0)

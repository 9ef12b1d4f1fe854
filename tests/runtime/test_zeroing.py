import threading

import numpy as np
import pytest
from edge_samples import REST, FakeLink, make_scan

from edge.pipeline.baseline_capture import take_baselines
from edge.pipeline.scan_reader import Source
from firmware_bridge.errors import BaselineRefusedError, DeviceError, LinkLostError
from firmware_bridge.links.base import Notice


def rest_scans(count, *sensors, start=0):
    return [[make_scan(n, sensor=sensor, noise=3) for sensor in sensors or ("4",)] for n in range(start, start + count)]


def take(link, **settings):
    with Source(link) as source:
        return take_baselines(source, **settings)


def test_every_sensor_heard_gets_its_baseline():
    baselines = take(FakeLink(rest_scans(150, "4", "6"), endless=True))
    assert sorted(baselines) == ["4", "6"]
    assert np.abs(baselines["6"].counts - REST).max() <= 2 and baselines["6"].sensor == "6"
    assert baselines["6"].scans == 100


def test_the_first_scans_can_be_left_out():
    touched = [[make_scan(n, press_counts=5000)] for n in range(20)]
    link = FakeLink(touched + rest_scans(120, start=20), endless=True)
    assert np.abs(take(link, skip=20)["4"].counts - REST).max() <= 2


def test_a_refusal_names_the_sensor():
    scans = [[make_scan(n, noise=3, press_counts=10 * n)] for n in range(100)]
    with pytest.raises(BaselineRefusedError, match=r"sensor 4: taxel \(1, 1\) z moved"):
        take(FakeLink(scans, endless=True))


def test_a_source_that_ends_too_soon_is_told():
    with pytest.raises(BaselineRefusedError, match="ended before 100 complete scans"):
        take(FakeLink(rest_scans(99)))


def test_silence_is_told_and_measured_from_the_last_scan():
    class Script:
        """Gives 30 scans, then nothing; every take takes a second."""

        name, kind, taken = "fake", "device", 0

        def lend(self):
            """Has no other stream."""

        def counters(self):
            return {}

        def take(self, timeout_s):
            self.taken += 1
            return [make_scan(self.taken, noise=3)] if self.taken <= 30 else []

    source = Script()
    with pytest.raises(DeviceError, match=r"no scan from fake for 10 s"):
        take_baselines(source, clock_s=lambda: float(source.taken))
    assert source.taken == 30 + 11


@pytest.mark.parametrize(
    ("heard", "skip"),
    [
        (lambda n: [make_scan(n, noise=3, absent=(3,))], 0),  # a silent taxel, or another id map
        (lambda n: [make_scan(n, noise=3)] + ([make_scan(n, sensor="6", noise=3)] if n < 30 else []), 0),
        (lambda n: [make_scan(n, noise=3)] + ([make_scan(n, sensor="6", noise=3)] if n < 30 else []), 50),
        (lambda n: [make_scan(0, stale=range(16))], 0),  # frozen: the same readings again and again
    ],
)
def test_a_sensor_that_gives_no_whole_scan_is_told_though_scans_come(heard, skip):
    class Script:
        name, kind, taken = "fake", "device", 0

        def lend(self):
            """Has no other stream."""

        def counters(self):
            return {}

        def take(self, timeout_s):
            self.taken += 1
            assert self.taken < 5000
            return heard(self.taken)

    source = Script()
    with pytest.raises(DeviceError, match=r"no whole new scan from sensor [46] for 10 s: .*edge-sr doctor"):
        take_baselines(source, skip=skip, clock_s=lambda: 0.1 * source.taken)
    assert source.taken < 200


def test_a_sensor_that_is_done_may_move_while_another_is_not():
    scans = [
        [
            make_scan(n, noise=3, press_counts=0 if n < 100 else 50 * n),
            make_scan(n, sensor="6", noise=3, absent=(1,) if n < 150 else ()),
        ]
        for n in range(300)
    ]
    baselines = take(FakeLink(scans))
    assert sorted(baselines) == ["4", "6"]
    assert np.abs(baselines["4"].counts - REST).max() <= 2


def test_a_lost_link_is_told():
    with pytest.raises(LinkLostError):
        take(FakeLink(rest_scans(5), error=LinkLostError("gone")))


def test_what_came_before_an_outage_is_not_mixed_with_what_comes_behind_it():
    """A sensor that was powered again rests elsewhere: a baseline of both halves would fit neither."""

    class Lost(FakeLink):
        def notices(self):
            return [Notice(0, "lost", "gone")] if self.reads == 90 else []

    before = [[make_scan(n, press_counts=9)] for n in range(89)]
    assert np.abs(take(Lost(before + rest_scans(100, start=89)))["4"].counts - REST).max() <= 2
    with pytest.raises(BaselineRefusedError, match="ended before 100"):
        take(Lost(rest_scans(188)))


def test_stopped_half_way_it_keeps_nothing():
    stop = threading.Event()
    stop.set()
    with pytest.raises(BaselineRefusedError, match="nothing is kept"):
        take(FakeLink(rest_scans(100)), stop=stop)

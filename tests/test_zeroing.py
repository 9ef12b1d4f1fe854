import threading

import numpy as np
import pytest
from edge_samples import REST, FakeLink, make_scan

from edge.zeroing import take_baselines
from firmware_bridge.errors import BaselineRefusedError, DeviceError, LinkLostError


def rest_scans(count, *sensors, start=0):
    return [[make_scan(n, sensor=sensor, noise=3) for sensor in sensors or ("4",)] for n in range(start, start + count)]


def take(link, scans=100, **settings):
    settings.setdefault("stop", threading.Event())
    return take_baselines(link, scans=scans, **settings)


def test_every_sensor_heard_gets_its_baseline_and_no_more_is_read():
    link = FakeLink(rest_scans(150, "4", "6"), endless=True)
    baselines = take(link)
    assert sorted(baselines) == ["4", "6"]
    assert np.abs(baselines["6"].counts - REST).max() <= 2 and baselines["6"].sensor == "6"
    assert link.reads == 100


def test_the_first_scans_can_be_left_out():
    touched = [[make_scan(n, press_counts=5000)] for n in range(20)]
    link = FakeLink(touched + rest_scans(120, start=20), endless=True)
    assert np.abs(take(link, skip=20)["4"].counts - REST).max() <= 2
    assert link.reads == 120


def test_a_refusal_names_the_sensor():
    scans = [[make_scan(n, noise=3, press_counts=10 * n)] for n in range(100)]
    with pytest.raises(BaselineRefusedError, match=r"sensor 4: taxel \(1, 1\) z moved"):
        take(FakeLink(scans, endless=True))


def test_a_source_that_ends_too_soon_is_told():
    with pytest.raises(BaselineRefusedError, match="ended before 100 complete scans"):
        take(FakeLink(rest_scans(99)))


def test_silence_is_told_and_measured_from_the_last_scan():
    link = FakeLink(rest_scans(30), endless=True)
    with pytest.raises(DeviceError, match=r"no scan from fake for 10 s"):
        take(link, clock_s=lambda: float(link.reads))
    assert link.reads == 30 + 11


def test_a_sensor_that_is_done_may_move_while_another_is_not():
    scans = [
        [
            make_scan(n, noise=3, press_counts=0 if n < 100 else 50 * n),
            make_scan(n, sensor="6", noise=3, absent=(1,) if n < 150 else ()),
        ]
        for n in range(300)
    ]
    link = FakeLink(scans)
    baselines = take(link)
    assert sorted(baselines) == ["4", "6"] and link.reads == 250
    assert np.abs(baselines["4"].counts - REST).max() <= 2


def test_a_lost_link_is_told():
    with pytest.raises(LinkLostError):
        take(FakeLink(rest_scans(5), error=LinkLostError("gone")))


def test_stopped_half_way_it_keeps_nothing():
    stop = threading.Event()
    stop.set()
    with pytest.raises(BaselineRefusedError, match="nothing is kept"):
        take(FakeLink(rest_scans(100)), stop=stop)

"""Recordings that are played: at their own pace, side by side, from a sign on, and by the emulator of the demo."""

import threading
import time
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from bridge_samples import make_counts, make_recording, read_scans, read_until_lost, stacked, write_npz, write_recording
from edge_samples import Clock, FakeModel, make_scan
from mcap_samples import SURE

from edge.api import Event, Stream, infer, open_recording, open_runtime
from firmware_bridge.emulation.slcan_emulator import FRAME_S, Controller, Emulator, bus_timeline
from firmware_bridge.errors import DeviceError, RecordingError, SourceError
from firmware_bridge.links.demo import DemoLink
from firmware_bridge.links.registry import open_sources
from firmware_bridge.links.replay import ReplayLink
from firmware_bridge.links.slcan_serial import SlcanSerialLink
from firmware_bridge.recording.tracks import Track
from firmware_bridge.scans.scan import ABSENT
from firmware_bridge.schedule import NS_PER_S, Ticker

START_NS = 7_000_000_000
MS = 1_000_000


class FakeTime(Clock):
    """A clock that only sleeping moves on, later or earlier than asked for."""

    def __init__(self, *off_by_s: float) -> None:
        self.now_ns = START_NS
        self._off_by_s = list(off_by_s)

    def sleep(self, time_s: float) -> None:
        assert time_s > 0
        self.pass_s(time_s + (self._off_by_s.pop(0) if self._off_by_s else 0.0))

    def pass_s(self, time_s: float) -> None:
        self.now_ns += round(time_s * NS_PER_S)


def replay(time: FakeTime, *paths, **options) -> ReplayLink:
    return ReplayLink(paths, clock=time, sleep=time.sleep, **options)


def test_waiting_ends_with_the_timeout_and_who_is_late_gets_all(tmp_path):
    time = FakeTime()
    with replay(time, write_recording(tmp_path / "finger.csv", make_counts(9)), rate_hz=10) as link:
        assert len(link.read(0.0)) == 1
        assert link.read(0.03) == [] and time.now_ns == START_NS + 30 * MS
        assert link.read(0.0) == [] and time.now_ns == START_NS + 30 * MS
        assert len(link.read(1.0)) == 1 and time.now_ns == START_NS + 100 * MS
        time.now_ns += 250 * MS
        assert [scan.number for scan in link.read(1.0)] == [2, 3]
        (scan,) = link.read(1.0)
        assert time.now_ns == scan.time_ns == START_NS + 400 * MS, "the grid stays"


def test_it_may_wait_for_a_sign_to_begin(tmp_path):
    time, begins = FakeTime(), threading.Event()
    with replay(time, write_recording(tmp_path / "finger.csv", make_counts(2)), rate_hz=10, begins=begins) as link:
        assert link.read(0.01) == []
        time.now_ns += 900 * MS
        begins.set()
        assert [scan.time_ns for _ in range(2) for scan in link.read(1.0)] == [START_NS + ms * MS for ms in (900, 1000)]


def test_sources_without_a_name_are_called_by_their_place(tmp_path):
    """Not "1/4", which reads like the first of four sensors."""
    forms = []
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        forms.append(f"replay:{write_recording(tmp_path / folder / '4.csv', make_counts(2), rate_hz=50)}")
    for texts, names in (([forms[0], f"left={forms[1]}"], ["source1/4", "left/4"]), (forms[:1], ["4"])):
        assert [link.__enter__().read(1)[0].sensor for link in open_sources(texts)] == names


def test_an_npz_at_its_recorded_times_or_at_another_rate(tmp_path):
    counts = make_counts(4)
    times_ns = [500, 500 + 3 * MS, 500 + 30 * MS, 500 + 33 * MS]
    path = write_npz(tmp_path / "both.npz", counts, times_ns, ["4", "6", "4", "6"])
    for rate_hz, due_ms in ((None, [0, 3, 30, 33]), (10, [0, 0, 100, 100])):
        time, scans = FakeTime(), []
        with replay(time, path, rate_hz=rate_hz) as link:
            while not link.ended:
                scans += link.read(1.0)
                assert time.now_ns == scans[-1].time_ns
            assert link.read(1.0) == []
        assert [scan.time_ns - START_NS for scan in scans] == [due * MS for due in due_ms]
        assert [(scan.sensor, scan.number) for scan in scans] == [("4", 0), ("6", 0), ("4", 1), ("6", 1)]
        assert all((scan.counts == one).all() for scan, one in zip(scans, counts, strict=True))


def test_torn_and_repeated_scans_are_told(tmp_path):
    counts = make_counts(2)[[0, 0, 1, 1]]
    counts[2, :, 1:] = counts[1, :, 1:]
    counts[3, :, 2, 2] = ABSENT
    with replay(FakeTime(), write_npz(tmp_path / "one.npz", counts, range(4))) as link:
        scans = [scan for _ in range(4) for scan in link.read(1.0)]
    assert [scan.repeated for scan in scans] == [False, True, False, False]
    assert [scan.torn for scan in scans] == [False, False, True, True]
    assert not scans[3].fresh[2, 2] and int(scans[3].fresh.sum()) == 15
    assert link.counters() == {"scans": 4, "torn_wire": 1, "torn_source": 1, "repeated": 1}


@pytest.mark.parametrize(
    ("names", "options", "words"),
    [
        (["finger.csv"], {}, r"finger\.csv .* --rate-hz"),
        (["finger.csv"] * 2, {"rate_hz": 10}, "each sensor once"),
        *((["finger.csv"], {"rate_hz": rate_hz}, "positive") for rate_hz in (0.0, -1.0, float("nan"), float("inf"))),
        (["finger.csv"], {"rate_hz": 1e-10}, r"finger\.csv lasts .* give a higher rate"),
        (
            ["timed.npz"],
            {"rate_hz": 100, "paced": False},
            r"timed\.npz has times of its own.*leave out --rate-hz, or add --paced",
        ),
        (["finger.csv", "emulated.npz"], {"rate_hz": 10}, r"finger\.csv is not, .*emulated\.npz is emulated"),
        (["gone.csv"], {}, "cannot be read"),
    ],
)
def test_recordings_that_cannot_be_replayed(tmp_path, names, options, words):
    write_recording(tmp_path / "finger.csv", make_counts(2))
    write_npz(tmp_path / "timed.npz", make_counts(1), [5])
    write_npz(tmp_path / "emulated.npz", make_counts(1), origin=np.array(["emulated"]))
    with pytest.raises(RecordingError if names == ["gone.csv"] else SourceError, match=words):
        ReplayLink([tmp_path / name for name in names], **options)


@pytest.mark.parametrize(
    ("rate_hz", "going", "noted"),
    [(None, 1, "3 s"), (1000, 1, "3 s"), (100, -1, "298 periods"), (None, 1e7, "2.99e+07 s"), (None, 1e99, "e+99 s")],
)
def test_no_tap_goes_on_over_a_gap_in_the_times_of_a_csv(tmp_path, rate_hz, going, noted):
    """Nor where another recording, whose times begin anew, was put behind it."""
    pressed = {*range(120, 130), *range(136, 200)}
    counts = [make_scan(n, press_counts=3000 * (n in pressed), noise=3).counts for n in range(200)]
    lines = write_recording(tmp_path / "all.csv", np.array(counts)).read_text().splitlines()
    times = ["time", *(f"{(n + 299 * going * (n >= 150)) / 100:.2f}" for n in range(200))]
    path = tmp_path / "finger.csv"
    path.write_text("\n".join(f"{time},{line}" for time, line in zip(times, lines, strict=True)))
    events: list[Event] = []
    with open_recording(path, rate_hz=rate_hz) as source:
        made = list(Stream(source, open_runtime(FakeModel(SURE), source), on_event=events.append))
    assert "before scan 151 there is a gap of " in events[0].text and noted in events[0].text
    assert [made[n].taps_used for n in (149, 150)] == [2, 1], "as live, after an outage"
    assert 2.9e9 < made[150].scan.time_ns - made[149].scan.time_ns < 1.01e12, "no replay waits for years"


@pytest.mark.parametrize(
    ("cut_off", "words"), [(False, None), (True, "0 on one axis and not on another, as readings over")]
)
def test_readings_over_a_baseline_cut_off_at_0_are_no_counts(tmp_path, cut_off, words):
    """Their patterns look right; a broken chip, whose counts are 0 on all axes, is another thing."""
    counts = np.stack([make_scan(n, press_counts=3000 * (n > 90), noise=3).counts for n in range(150)])
    counts[:, :, 0, :3] = 0
    if cut_off:
        counts = np.maximum(counts - counts[:9].mean(axis=0), 0).astype(int)
    path = write_recording(tmp_path / "finger.csv", counts)
    with nullcontext() if words is None else pytest.raises(RecordingError, match=rf"finger\.csv: .*{words}"):
        open_recording(path, rate_hz=100)
    with nullcontext() if words is None else pytest.raises(RecordingError, match=rf"counts: .*{words}"):
        infer(FakeModel(), counts, counts[:9])


# The demo: its emulator plays through, and has hung up however the demo ends.


@pytest.fixture
def recording(tmp_path):
    pose = {"pose_time_ns": np.array([50_000_000]), "pose": np.array([[1.0, 2.0, 3.0, 0.2, 1.0]])}
    return write_npz(tmp_path / "demo.npz", make_counts(30), rate_hz=100.0, **pose)


@pytest.mark.parametrize(("loop", "rate_hz", "rounds"), [(False, None, 1), (True, 150, 3)])
def test_it_plays_through_and_ends_or_begins_again(recording, loop, rate_hz, rounds):
    with DemoLink(recording, rate_hz, loop=loop) as link:
        scans = read_scans(link, 75)[:75] if loop else read_until_lost(link)
        assert link.ended != loop
        assert loop or link.read(0.1) == []
        poses = link.poses()[:rounds]
    assert [one.pose.x_mm for one in poses] == [1.0] * rounds
    assert all(abs(one.time_ns - scan.time_ns) < 150_000_000 for one, scan in zip(poses, scans[5::30], strict=True))
    assert (stacked(scans) == np.concatenate([make_counts(30)] * rounds)[: len(scans)]).all()
    assert len(scans) == (75 if loop else 30)


def test_an_early_end_or_a_port_that_fails_leaves_no_emulator(recording, tmp_path, monkeypatch):
    def refuse(link):
        raise DeviceError("no port")

    before = threading.active_count(), len(list(Path("/proc/self/fd").iterdir()))
    with DemoLink(recording, rate_hz=2) as link:  # fifteen seconds, if it were left to play on
        read_scans(link, 1)
    monkeypatch.setattr(SlcanSerialLink, "__enter__", refuse)
    with pytest.raises(DeviceError, match="no port"):
        DemoLink(recording).__enter__()
    with pytest.raises(DeviceError, match=r"^the emulator did not start: .*--rate-hz"):
        DemoLink(write_recording(tmp_path / "a.csv", make_counts(1))).__enter__()
    assert (threading.active_count(), len(list(Path("/proc/self/fd").iterdir()))) == before


# The controller and the adapter that are emulated: their frames, times and answers, on a pseudo-terminal as well.


def test_scans_lie_on_the_grid():
    for rate_hz, period_s in ((100.0, 0.01), (1000.0, 16 * FRAME_S)):
        controller = Controller(Track("x", make_counts(50, 0), None), 4, rate_hz)
        times_s = [time_s for time_s, _ in bus_timeline([controller], loop=False)]
        assert abs(np.array(times_s[::16]) - period_s * np.arange(50)).max() <= 1e-9
        assert np.diff(times_s[:16]) == pytest.approx([FRAME_S] * 15)


def test_what_no_such_sensors_made_is_refused():
    other = make_recording(1)
    wide = Track("4", np.zeros((1, 3, 5, 6), dtype=np.int32), None)
    with pytest.raises(RecordingError, match=r"\(3, 5, 6\)"):
        Emulator([type(other)(other.path, (wide,), 100.0)])
    with pytest.raises(ValueError, match="7 sensors on one bus, expected at most 6"):
        Emulator([other] * 7)


def test_an_emulator_that_waits_loses_no_frame_by_a_slow_reader():
    with (
        Emulator([make_recording(200, rate_hz=450.0)], waits=True) as emulator,
        SlcanSerialLink(emulator.port) as link,
    ):
        time.sleep(0.4)  # the terminal is full after .1 s; nor does it take its lateness for a stop, amid a scan
        scans = read_until_lost(link)
    assert (stacked(scans) == make_counts(200)).all()


@pytest.mark.parametrize(
    ("off_by_s", "ticks"),
    [  # each tick: the time worked before it, its number, and when it came, in [s]
        ((), [(0.0, 1, 0.01), (0.003, 2, 0.02), (0.0099, 3, 0.03)]),
        ((0.004,), [(0.0, 1, 0.014), (0.0, 2, 0.02)]),
        ((-0.005, -0.002), [(0.0, 1, 0.01), (0.0, 2, 0.02)]),  # woken too soon, it sleeps again
        ((), [(0.0201, 2, 0.0201), (0.0, 3, 0.03)]),
        ((), [(0.0349, 3, 0.0349), (0.0, 4, 0.04)]),
    ],
)
def test_ticks_lie_on_the_grid_however_long_the_work_takes(off_by_s, ticks):
    time = FakeTime(*off_by_s)
    ticker = Ticker(100, time, time.sleep)
    start_ns = time.now_ns
    for work_s, tick, at_s in ticks:
        time.pass_s(work_s)
        assert (ticker.wait(), time.now_ns - start_ns) == (tick, round(at_s * NS_PER_S))

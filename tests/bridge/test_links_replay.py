"""Recordings that are played: at their own pace, side by side, and from a sign on."""

import threading

import pytest
from bridge_samples import make_counts, write_npz, write_recording

from firmware_bridge.errors import RecordingError, SourceError
from firmware_bridge.links.registry import open_sources
from firmware_bridge.links.replay import ReplayLink
from firmware_bridge.scans.scan import ABSENT

START_NS = 7_000_000_000
MS = 1_000_000


class FakeTime:
    def __init__(self):
        self.now_ns = START_NS

    def clock(self) -> int:
        return self.now_ns

    def sleep(self, time_s: float) -> None:
        assert time_s > 0
        self.now_ns += round(time_s * 1e9)


def replay(time: FakeTime, *paths, **options) -> ReplayLink:
    return ReplayLink(paths, clock=time.clock, sleep=time.sleep, **options)


def test_a_csv_at_its_recorded_rate(tmp_path):
    counts = make_counts(5)
    time = FakeTime()
    with replay(time, write_recording(tmp_path / "finger.csv", counts, rate_hz=50)) as link:
        for number in range(5):
            (scan,) = link.read(1.0)
            assert time.now_ns == START_NS + number * 20 * MS == scan.time_ns
            assert (scan.counts == counts[number]).all() and scan.complete and scan.renewed.all()
            assert link.ended == (number == 4)
        assert link.read(1.0) == []
    assert link.counters() == {"scans": 5, "torn_wire": 0, "torn_source": 0, "repeated": 0}


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


def test_sources_without_a_name_are_called_by_their_place(tmp_path):
    """Not "1/4", which reads like the first of four sensors."""
    forms = []
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        forms.append(f"replay:{write_recording(tmp_path / folder / '4.csv', make_counts(2), rate_hz=50)}")
    for texts, names in (
        (forms, ["source1/4", "source2/4"]),
        ([forms[0], f"left={forms[1]}"], ["source1/4", "left/4"]),
        (forms[:1], ["4"]),
    ):
        assert [link.__enter__().read(1)[0].sensor for link in open_sources(texts)] == names


def test_an_npz_at_its_recorded_times_or_at_another_rate(tmp_path):
    counts = make_counts(4)
    times_ns = [500, 500 + 3 * MS, 500 + 30 * MS, 500 + 33 * MS]
    path = write_npz(tmp_path / "both.npz", counts, times_ns, ["4", "6", "4", "6"], rate_hz=1.0)
    for rate_hz, due_ms in ((None, [0, 3, 30, 33]), (10, [0, 0, 100, 100])):
        time, scans = FakeTime(), []
        with replay(time, path, rate_hz=rate_hz) as link:
            while not link.ended:
                scans += link.read(1.0)
                assert time.now_ns == scans[-1].time_ns
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
        (["gone.csv"], {}, "cannot be read"),
    ],
)
def test_recordings_that_cannot_be_replayed(tmp_path, names, options, words):
    write_recording(tmp_path / "finger.csv", make_counts(2))
    write_npz(tmp_path / "timed.npz", make_counts(1), [5])
    with pytest.raises(RecordingError if names == ["gone.csv"] else SourceError, match=words):
        ReplayLink([tmp_path / name for name in names], **options)


def test_it_may_wait_for_a_sign_to_begin(tmp_path):
    time, begins = FakeTime(), threading.Event()
    with replay(time, write_recording(tmp_path / "finger.csv", make_counts(3)), rate_hz=10, begins=begins) as link:
        assert link.read(0.01) == [] and link.length_s == 0.2
        time.now_ns += 900 * MS
        begins.set()
        assert [scan.time_ns for _ in range(3) for scan in link.read(1.0)] == [
            START_NS + (900 + due) * MS for due in (0, 100, 200)
        ]

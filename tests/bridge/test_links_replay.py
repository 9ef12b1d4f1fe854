import numpy as np
import pytest
from bridge_samples import make_counts, write_recording

from firmware_bridge.errors import RecordingError, SourceError
from firmware_bridge.links.registry import open_sources
from firmware_bridge.links.replay import ReplayLink
from firmware_bridge.scans.scan import ABSENT

START_NS = 7_000_000_000


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


def write_npz(path, sensors, times_ns, counts, **more):
    scan = np.arange(len(counts))
    arrays = {"sensor": np.array(sensors), "scan": scan, "time_ns": np.array(times_ns), "counts": counts}
    np.savez(path, format=np.array("tactile-recording"), version=np.array(1), **arrays, **more)
    return path


def test_a_csv_at_its_recorded_rate(tmp_path):
    counts = make_counts(5)
    path = write_recording(tmp_path / "finger.csv", counts, rate_hz=50)
    time = FakeTime()
    with replay(time, path) as link:
        assert (link.kind, link.name, link.ended) == ("replay", f"replay:{path}", False)
        for number in range(5):
            (scan,) = link.read(1.0)
            assert time.now_ns == START_NS + number * 20_000_000 == scan.time_ns
            assert (scan.sensor, scan.number) == ("finger", number)
            assert (scan.counts == counts[number]).all() and scan.complete and scan.renewed.all()
            assert link.ended == (number == 4)
        assert link.read(1.0) == []
    assert link.counters() == {"scans": 5, "torn_wire": 0, "torn_source": 0, "repeated": 0}


def test_waiting_ends_with_the_timeout(tmp_path):
    path = write_recording(tmp_path / "finger.csv", make_counts(2))
    time = FakeTime()
    with replay(time, path, rate_hz=10) as link:
        assert len(link.read(0.0)) == 1
        assert link.read(0.03) == [] and time.now_ns == START_NS + 30_000_000
        assert link.read(0.0) == [] and time.now_ns == START_NS + 30_000_000
        assert len(link.read(1.0)) == 1 and time.now_ns == START_NS + 100_000_000


def test_a_late_reader_gets_all_that_is_due_and_the_grid_stays(tmp_path):
    path = write_recording(tmp_path / "finger.csv", make_counts(9))
    time = FakeTime()
    with replay(time, path, rate_hz=100) as link:
        time.now_ns += 35_000_000
        assert [scan.number for scan in link.read(1.0)] == [0, 1, 2, 3]
        (scan,) = link.read(1.0)
        assert time.now_ns == scan.time_ns == START_NS + 40_000_000


def test_two_fingers_side_by_side(tmp_path):
    paths = [write_recording(tmp_path / f"{name}.csv", make_counts(3, seed), 100) for seed, name in enumerate("ab")]
    time = FakeTime()
    with replay(time, *paths) as link:
        assert link.name == f"replay:{paths[0]},{paths[1]}"
        read = [[(scan.sensor, scan.number) for scan in link.read(1.0)] for _ in range(3)]
    assert read == [[("a", n), ("b", n)] for n in range(3)]


def test_sources_without_a_name_are_called_by_their_place(tmp_path):
    """Not "1/4", which reads like the first of four sensors."""
    forms = []
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        forms.append(f"replay:{write_recording(tmp_path / folder / '4.csv', make_counts(1), rate_hz=50)}")
    for texts, names in (
        (forms, ["source1/4", "source2/4"]),
        ([forms[0], f"left={forms[1]}"], ["source1/4", "left/4"]),
        (forms[:1], ["4"]),
    ):
        links = open_sources(texts)
        assert [scan.sensor for link in links for scan in played(link)] == names


def played(link):
    with link:
        return link.read(1)


def test_an_npz_at_its_recorded_times(tmp_path):
    counts = make_counts(4)
    times_ns = [500, 500 + 3_000_000, 500 + 30_000_000, 500 + 33_000_000]
    path = write_npz(tmp_path / "both.npz", ["4", "6", "4", "6"], times_ns, counts, rate_hz=np.array(1.0))
    time = FakeTime()
    with replay(time, path) as link:
        scans = []
        while not link.ended:
            for scan in link.read(1.0):
                assert time.now_ns == scan.time_ns
                scans.append(scan)
    assert [scan.time_ns - START_NS for scan in scans] == [0, 3_000_000, 30_000_000, 33_000_000]
    assert [(scan.sensor, scan.number) for scan in scans] == [("4", 0), ("6", 0), ("4", 1), ("6", 1)]
    assert all((scan.counts == one).all() for scan, one in zip(scans, counts, strict=True))


def test_a_given_rate_wins_over_recorded_times(tmp_path):
    path = write_npz(tmp_path / "one.npz", ["4"] * 3, [0, 1, 2], make_counts(3))
    time = FakeTime()
    with replay(time, path, rate_hz=10) as link:
        assert [len(link.read(1.0)) for _ in range(3)] == [1, 1, 1]
    assert time.now_ns == START_NS + 200_000_000


def test_torn_and_repeated_scans_are_told(tmp_path):
    counts = make_counts(2)[[0, 0, 1, 1]]
    counts[2, :, 1:] = counts[1, :, 1:]
    counts[3, :, 2, 2] = ABSENT
    path = write_npz(tmp_path / "one.npz", ["4"] * 4, range(4), counts)
    with replay(FakeTime(), path) as link:
        scans = [scan for _ in range(4) for scan in link.read(1.0)]
    assert [scan.repeated for scan in scans] == [False, True, False, False]
    assert [scan.torn for scan in scans] == [False, False, True, True]
    assert not scans[3].fresh[2, 2] and int(scans[3].fresh.sum()) == 15
    assert link.counters() == {"scans": 4, "torn_wire": 1, "torn_source": 1, "repeated": 1}


def test_what_cannot_be_replayed(tmp_path):
    path = write_recording(tmp_path / "finger.csv", make_counts(1))
    with pytest.raises(SourceError, match=r"finger\.csv .* --rate-hz"):
        ReplayLink([path])
    with pytest.raises(SourceError, match="each sensor once"):
        ReplayLink([path, path], rate_hz=10)
    for rate_hz in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(SourceError, match="positive"):
            ReplayLink([path], rate_hz=rate_hz)
    with pytest.raises(SourceError, match=r"finger\.csv lasts .* give a higher rate"):
        ReplayLink([write_recording(path, make_counts(2))], rate_hz=1e-10)
    timed = write_npz(tmp_path / "timed.npz", ["4"], [5], make_counts(1))
    with pytest.raises(SourceError, match=r"timed\.npz has times of its own.*leave out --rate-hz, or add --paced"):
        ReplayLink([timed], rate_hz=100, paced=False)
    with pytest.raises(RecordingError, match="cannot be read"):
        ReplayLink([tmp_path / "gone.csv"])

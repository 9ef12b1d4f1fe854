"""Poses of a pad, and their course over time; in recordings they are played at the scans that they served."""

from dataclasses import replace

import numpy as np
import pytest
from bridge_samples import make_counts, write_recording
from cli_samples import write_recording as write_npz
from edge_samples import BASELINE, FakeModel, fake_source, make_scan
from mcap_samples import OFFSET_NS
from pose_samples import PosedModel

from edge import api
from edge.perception.runtime import Runtime
from edge.pipeline.result_stream import Stream
from edge.sinks.mcap import McapSink
from firmware_bridge.errors import CdrError, RecordingError
from firmware_bridge.links.replay import ReplayLink
from firmware_bridge.poses import AHEAD_NS, GAP_NS, MOST_POSES, PadPose, PoseTrack, TimedPose
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.recording.scan_messages import POSE, decode_pose, encode_pose

MS = 1_000_000


def test_a_pose_seen_from_another_gives_the_place_again():
    newest, earlier = PadPose(12.0, -3.0, 100.0), PadPose(13.5, -1.0, -170.0)
    seen = earlier.seen_from(newest)
    place = complex(12.0, -3.0) + complex(seen.x_mm, seen.y_mm) * np.exp(1j * np.radians(100.0))
    assert (place.real, place.imag) == pytest.approx((13.5, -1.0)) and seen.turn_deg == pytest.approx(90.0)
    assert seen.error_mm == pytest.approx(np.hypot(0.2, 0.2)) and seen.error_deg == pytest.approx(np.hypot(1, 1))


def test_there_is_no_pose_beyond_those_that_came():
    track = PoseTrack()
    assert track.at(0) is None
    track.add(10 * MS, PadPose(0, 0))
    track.add(10 * MS + 2 * GAP_NS, PadPose(5, 0))
    assert track.at(9 * MS) is None and track.at(10 * MS + GAP_NS) is None
    assert track.at(10 * MS + 2 * GAP_NS + AHEAD_NS + 1) is None


def test_poses_of_one_burst_show_no_speed():
    """Lines that a program writes at once arrive within microseconds, whatever their distance in time was."""
    track = PoseTrack()
    for burst in range(5):
        for number in range(10):  # 100 poses/s at 20 mm/s, sent ten at a time
            track.add(100 * MS * burst + 10_000 * number, PadPose(2.0 * burst + 0.2 * number, 0))
            pose = track.at(100 * MS * burst + 10_000 * number + 20 * MS)
            assert pose.x_mm == pytest.approx(2.0 * burst + 0.2 * number, abs=2.0)
    one = PoseTrack()
    one.add(0, PadPose(7, 7, 0, 0, 0), holds=True)
    one.add(5 * MS, PadPose(0, 0, 350, 0, 0))
    one.add(10 * MS, PadPose(1, 0, 0, 0, 0))
    ahead = one.at(14 * MS)
    assert (ahead.x_mm, ahead.error_mm) == pytest.approx((1.8, 0.8)), "not from where it rested"
    assert (ahead.turn_deg % 360, ahead.error_deg) == pytest.approx((8, 8))
    assert one.at(18 * MS) == PadPose(1, 0, 0, 0, 0), "poses of 5 ms say nothing of 8 ms more"


def test_a_pose_that_holds_is_that_of_all_times_until_the_next():
    track = PoseTrack()
    track.add(0, PadPose(1, 2), holds=True)
    assert track.at(10**12) == PadPose(1, 2)
    track.add(10**12, PadPose(3, 2))
    assert track.at(10**12 - 1) == PadPose(1, 2) and track.at(10**12 + MS) == PadPose(3, 2)


def test_a_pose_that_is_not_later_is_not_taken():
    track = PoseTrack()
    assert track.add(5, PadPose(0, 0)) and not track.add(5, PadPose(1, 0)) and not track.add(4, PadPose(1, 0))
    for at in range(6, 2 * MOST_POSES):
        track.add(at, PadPose(0, 0))
    assert len(track) == MOST_POSES


STEP_NS = 10_000_000
POSES = [
    # Time, place and sensor; and the scan that was first made with it at hand, which may be earlier than its own time.
    (TimedPose(PadPose(1.0, 2.0, 3.0, 0.4, 0.5), 500_000_000, None, True), 0),
    (TimedPose(PadPose(-1.5, 0.25, -170.0, 0.0, 0.0), 1_012_000_000, "4", False), 2),
    (TimedPose(PadPose(7.0, 8.0, 9.0, 0.1, 2.0), 1_019_000_000, "4", True), 2),
    (TimedPose(PadPose(4.0, 5.0, 6.0, 0.1, 2.0), 1_021_000_000, None, False), 4),
]


def make_scans():
    return [make_scan(number, time_ns=10**9 + number * STEP_NS, press_counts=3000, noise=3) for number in range(6)]


def poses_of(number, scan):
    return [replace(pose, used_from_ns=scan.time_ns) for pose, first in POSES if first == number]


def record(path):
    runtime = Runtime(FakeModel(), source="device", baselines={"4": BASELINE})
    sink = McapSink(path, FakeModel().contract, fake_source(unix_offset_ns=OFFSET_NS))
    for number, scan in enumerate(make_scans()):
        if mine := poses_of(number, scan):
            sink.pose(mine)
        sink.write(runtime.push(scan), {})
    sink.close()
    return path


def test_poses_are_played_at_the_scans_that_they_served_again(tmp_path):
    expected = [one for number, scan in enumerate(make_scans()) for one in (*poses_of(number, scan), scan.time_ns)]
    path = record(tmp_path / "0.mcap")
    for again in ("1.mcap", "2.mcap"):
        seen, statistics = [], api.Statistics()
        with api.open_recording(path) as source:
            while (taken := source.take(1.0)) is not None:
                seen += taken
        assert [one if isinstance(one, TimedPose) else one.time_ns for one in seen] == expected
        with api.open_recording(path) as source:
            path = tmp_path / again
            sink = McapSink(path, FakeModel().contract, fake_source(unix_offset_ns=OFFSET_NS))
            api.pump(source, Runtime(FakeModel(), source="replay", baselines={"4": BASELINE}), [sink], statistics)
            sink.close()
        assert (statistics.poses, statistics.poses_refused) == (len(POSES), 0)


def test_poses_of_another_program_are_interpolated_in_time(tmp_path):
    times_ns = np.arange(0, 400_000_000, 33_000_000)
    values = np.zeros((len(times_ns), 5))
    values[:, 0] = times_ns / 1e9 * 20  # 20 mm/s
    with np.load(write_npz(tmp_path / "bare.npz", [3000] * 40)) as arrays:
        np.savez(tmp_path / "other.npz", **arrays, pose_time_ns=times_ns, pose=values)
    with api.open_recording(tmp_path / "other.npz") as source:
        runtime = Runtime(PosedModel(), source="replay", baselines={"4": BASELINE})
        places = {result.scan.time_ns: result.pose.x_mm for result in Stream(source, runtime)}
    assert len(places) == 40
    for time_ns, x_mm in places.items():
        assert x_mm == pytest.approx(time_ns / 1e9 * 20)


@pytest.mark.parametrize(("ago_s", "kept"), [(60, True), (50_000, False)])
def test_poses_of_another_clock_hold_for_no_scan(tmp_path, ago_s, kept):
    """As of microseconds beside nanoseconds: the last one, which holds, would be the pose of every scan."""
    with np.load(write_npz(tmp_path / "bare.npz", [3000] * 5)) as arrays:
        times_ns = arrays["time_ns"] + 100_000 * 10**9
        poses = {"pose_time_ns": times_ns - ago_s * 10**9, "pose": np.zeros((5, 5)), "pose_holds": np.ones(5, bool)}
        np.savez(tmp_path / "other.npz", **{**arrays, "time_ns": times_ns}, **poses)
    with api.open_recording(tmp_path / "other.npz") as source:
        runtime, events = Runtime(PosedModel(), source="replay", baselines={"4": BASELINE}), []
        posed = [result.pose is not None for result in Stream(source, runtime, on_event=events.append)]
    assert posed == [kept] * 5
    assert any("its 5 poses are left out, since the last is of 5e+04 s" in event.text for event in events) is not kept


def test_a_paced_replay_moves_the_poses_with_the_scans(tmp_path):
    clock = iter([70 * 10**9, *[77 * 10**9] * 9]).__next__
    path = record(tmp_path / "posed.mcap")
    with ReplayLink([path], clock=clock, sleep=lambda time_s: None) as link:
        scans = link.read(1.0)
        poses = link.poses()
    assert [scan.time_ns - 70 * 10**9 for scan in scans] == [number * STEP_NS for number in range(6)]
    assert [one.time_ns - 69 * 10**9 for one in poses] == [pose.time_ns for pose, _ in POSES]
    assert link.poses() == []
    assert "its 4 poses are left out" in ReplayLink([path], 50.0).notices()[0].text, "a rate of its own"


class TestCsv:
    def write(self, path, cells, columns="pose_x_mm,pose_y_mm,pose_turn_deg"):
        write_recording(path, make_counts(len(cells)), rate_hz=50)
        lines = path.read_text().splitlines()
        path.write_text("".join(f"{line},{more}\n" for line, more in zip(lines, [columns, *cells], strict=True)))
        return path

    def test_each_row_of_each_file_has_its_pose_or_none(self, tmp_path):
        left = self.write(tmp_path / "left.csv", ["1,2,3", ",,", "-4.5, 5e-1,0"])
        right = self.write(tmp_path / "right.csv", ["7,2", "7,2", ","], "pose_x_mm,pose_y_mm")
        with ReplayLink([left, right], paced=False) as link:
            read = [(link.read(0.0)[0].time_ns, link.poses()) for _ in range(6)]
        assert [(time_ns, pose) for time_ns, taken in read for pose in taken] == [
            (at_ns, TimedPose(pose, at_ns, sensor, used_from_ns=at_ns))
            for at_ns, sensor, pose in (
                (0, "left", PadPose(1, 2, 3)),
                (0, "right", PadPose(7, 2, 0)),
                (20_000_000, "right", PadPose(7, 2, 0)),
                (40_000_000, "left", PadPose(-4.5, 0.5, 0)),
            )
        ]

    @pytest.mark.parametrize("cells", ["1,,3", "1,x,3", "nan,0,0", "inf,0,0", "1e7,0,0"])
    def test_a_cell_that_is_no_pose_is_refused(self, tmp_path, cells):
        with pytest.raises(RecordingError, match=r"finger.csv"):
            load_recording(self.write(tmp_path / "finger.csv", ["1,2,3", cells]))


class TestHostile:
    @pytest.mark.parametrize(
        "change",
        [
            {"pose": np.zeros((2, 4))},
            {"pose": np.full((2, 5), np.nan)},
            {"pose_time_ns": np.array([0, 2**63], np.uint64)},
            {"pose_sensor": np.array(["4", "\x1b"])},
            {"pose_holds": np.array([0, 1])},
            {"pose": None},
        ],
    )
    def test_arrays_that_cannot_be_are_refused_with_one_line(self, tmp_path, change):
        poses = {"pose_time_ns": np.array([1, 2]), "pose": np.zeros((2, 5)), "pose_sensor": np.array(["4", ""])}
        with np.load(write_npz(tmp_path / "bare.npz", [3000] * 2)) as bare:
            arrays = dict(bare) | poses | change
        np.savez(tmp_path / "bad.npz", **{name: one for name, one in arrays.items() if one is not None})
        with pytest.raises(RecordingError, match="array 'pose") as caught:
            load_recording(tmp_path / "bad.npz")
        assert str(caught.value).isprintable()

    def test_a_message_that_cannot_be_is_refused(self):
        fields = POSE.decode(encode_pose(POSES[0][0], OFFSET_NS))
        with pytest.raises(CdrError, match="holds: '2', expected 0 or 1"):
            decode_pose(POSE.encode({**fields, "holds": 2}))

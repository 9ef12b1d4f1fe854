"""Poses of a pad: in another's axes and back, and their course over time."""

import numpy as np
import pytest

from firmware_bridge.poses import AHEAD_NS, GAP_NS, MOST_POSES, PadPose, PoseTrack

MS = 1_000_000


def turned(turn_deg):
    turn = np.radians(turn_deg)
    return np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])


def test_a_pose_seen_from_another_gives_the_place_again():
    newest, earlier = PadPose(12.0, -3.0, 100.0), PadPose(13.5, -1.0, -170.0)
    seen = earlier.seen_from(newest)
    back = turned(newest.turn_deg) @ (seen.x_mm, seen.y_mm) + (newest.x_mm, newest.y_mm)
    assert back == pytest.approx([13.5, -1.0]) and seen.turn_deg == pytest.approx(90.0)
    assert seen.error_mm == pytest.approx(np.hypot(0.2, 0.2)) and seen.error_deg == pytest.approx(np.hypot(1, 1))


def test_there_is_no_pose_beyond_those_that_came():
    track = PoseTrack()
    assert track.at(0) is None
    track.add(10 * MS, PadPose(0, 0))
    track.add(10 * MS + 2 * GAP_NS, PadPose(5, 0))
    assert track.at(9 * MS) is None and track.at(10 * MS + GAP_NS) is None
    assert track.at(10 * MS + 2 * GAP_NS + AHEAD_NS + 1) is None


def test_shortly_after_the_last_pose_the_course_goes_on():
    track = PoseTrack()
    track.add(0, PadPose(0, 0, error_mm=0))
    track.add(10 * MS, PadPose(1, 0, error_mm=0))
    pose = track.at(15 * MS)
    assert pose.x_mm == pytest.approx(1.5) and pose.error_mm == pytest.approx(0.5)


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
    one.add(10 * MS, PadPose(0, 0, 0, 0, 0))
    ahead = one.at(14 * MS)
    assert (ahead.x_mm, ahead.turn_deg % 360, ahead.error_deg) == pytest.approx((0, 8, 8)), "not from where it rested"
    assert one.at(18 * MS) == PadPose(0, 0, 0, 0, 0), "poses of 5 ms say nothing of 8 ms more"


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

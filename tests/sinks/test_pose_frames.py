"""Geometry and time of poses from ROS: tool frames, trees of transforms, and stamps. No DDS."""

import math
from math import cos, radians, sin

import numpy as np
import pytest

from edge.pipeline.pose_queue import PoseError
from edge.pose_sources.stamped_poses import EARLY_NS, LATE_NS, MOST_TILT_DEG, StampClock, pad_pose, placed
from firmware_bridge.poses.pad_pose import PLACE_ERROR_MM, TURN_ERROR_DEG

DOWN = (1.0, 0.0, 0.0, 0.0)
"""Half a turn about x: the tool's z against that of the frame, as of a gripper above a table."""


def times(one, other):
    """Return the product of two quaternions (x, y, z, w): the second rotation first."""
    x, y, z, w = one
    a, b, c, d = other
    return (
        w * a + x * d + y * c - z * b,
        w * b - x * c + y * d + z * a,
        w * c + x * b - y * a + z * d,
        w * d - x * a - y * b - z * c,
    )


def about(axis, angle_deg):
    half = radians(angle_deg) / 2
    return (*(sin(half) * np.array(axis, float)).tolist(), cos(half))


def named(numbers):
    return dict(zip("xyzw", numbers, strict=False))


def read(place, quaternion, covariance=()):
    return pad_pose(placed(named(place), named(quaternion)), covariance)


class TestToolFrame:
    def test_above_a_table_x_and_y_are_those_of_the_table_in_mm(self):
        pose = read((0.25, -0.125, 0.4), DOWN)
        assert (pose.x_mm, pose.y_mm, pose.turn_deg) == (250.0, -125.0, pytest.approx(0))
        assert (pose.error_mm, pose.error_deg) == (PLACE_ERROR_MM, TURN_ERROR_DEG)

    @pytest.mark.parametrize("turn_deg", [-170, -30, 5, 90, 179])
    def test_a_turn_about_the_tables_z_is_the_turn(self, turn_deg):
        assert read((0, 0, 0), times(about((0, 0, 1), turn_deg), DOWN)).turn_deg == pytest.approx(turn_deg)

    def test_a_frame_that_points_into_the_object_has_its_y_and_turns_the_other_way(self):
        pose = read((0.01, 0.02, 0), about((0, 0, 1), 30))
        assert (pose.x_mm, pose.y_mm, pose.turn_deg) == (pytest.approx(10), pytest.approx(-20), pytest.approx(-30))

    @pytest.mark.parametrize("up", [DOWN, (0.0, 0.0, 0.0, 1.0)])
    def test_a_feature_of_the_object_keeps_its_place_however_the_pad_lies_on_it(self, up):
        """A point of the object, seen from two poses of the pad, in the axes of a pattern: x right, y down."""
        rng, point = np.random.default_rng(3), np.array([0.003, -0.002, 0.0])
        seen = []
        for turn_deg in (0.0, 40.0):
            place = np.array([*rng.uniform(-0.005, 0.005, 2), 0.0])
            quaternion = times(about((0, 0, 1), turn_deg), up)
            tool = placed(named(place), named(quaternion))
            in_tool = tool.rotation.T @ (point - place)
            seen.append((pad_pose(tool), 1e3 * np.array([in_tool[0], -in_tool[1]])))  # y of the tool is up
        (first, at_first), (second, at_second) = seen
        earlier = first.seen_from(second)
        turn = radians(earlier.turn_deg)
        to = np.array([[cos(turn), sin(turn)], [-sin(turn), cos(turn)]])
        assert to @ (at_second - np.array([earlier.x_mm, earlier.y_mm])) == pytest.approx(at_first)

    @pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0)])
    def test_a_tilt_is_allowed_up_to_a_limit(self, axis):
        read((0, 0, 0), times(about(axis, MOST_TILT_DEG - 0.1), DOWN))
        with pytest.raises(PoseError, match="tilted by 12 degrees") as caught:
            read((0, 0, 0), times(about(axis, 12), DOWN))
        assert caught.value.reason == "tilt"

    @pytest.mark.parametrize(
        ("place", "quaternion", "reason"),
        [
            ((math.nan, 0, 0), DOWN, "finite"),
            ((0, 0, 0), (math.inf, 0, 0, 0), "finite"),
            ((0, 0, 0), (0, 0, 0, 0), "quaternion"),
            ((0, 0, 0), (2, 0, 0, 0), "quaternion"),
            ((1e9, 0, 0), DOWN, "range"),
        ],
    )
    def test_what_is_no_pose_is_refused(self, place, quaternion, reason):
        with pytest.raises(PoseError) as caught:
            read(place, quaternion)
        assert caught.value.reason == reason

    def test_the_covariance_gives_the_errors(self):
        covariance = np.zeros(36)
        covariance[[0, 7, 35]] = 0.001**2, 0.002**2, radians(3) ** 2
        pose = read((0, 0, 0), DOWN, covariance)
        assert (pose.error_mm, pose.error_deg) == (pytest.approx(2), pytest.approx(3))

    @pytest.mark.parametrize("value", [0.0, -1.0, math.nan])
    def test_a_covariance_that_is_not_known_leaves_the_usual_errors(self, value):
        pose = read((0, 0, 0), DOWN, np.full(36, value))
        assert (pose.error_mm, pose.error_deg) == (PLACE_ERROR_MM, TURN_ERROR_DEG)


class TestStampClock:
    OFFSET_NS = 1_700_000_000 * 10**9

    def clock(self):
        lines = []
        return StampClock(lines.append, lambda: self.OFFSET_NS), lines

    @pytest.mark.parametrize("delay_ns", [-EARLY_NS, 0, 30_000_000, LATE_NS])
    def test_where_clocks_agree_a_stamp_is_the_time_and_a_delay_stays(self, delay_ns):
        clock, lines = self.clock()
        arrival_ns = 10**12
        assert clock.monotonic_ns(self.OFFSET_NS + arrival_ns - delay_ns, arrival_ns) == arrival_ns - max(delay_ns, 0)
        assert lines == []

    def test_a_late_one_among_others_keeps_its_time(self):
        clock, lines = self.clock()
        for number, delay_ns in enumerate([5_000_000, 900_000_000, 5_000_000]):
            time_ns = 10**12 + number * 10**9
            assert clock.monotonic_ns(self.OFFSET_NS + time_ns, time_ns + delay_ns) == time_ns
        assert lines == []

    @pytest.mark.parametrize("off_ns", [-5 * 10**9, 10**8, 10**15, -(10**15)])
    def test_where_they_do_not_the_smallest_delay_counts_as_none(self, off_ns):
        clock, lines = self.clock()
        rng = np.random.default_rng(1)
        delays_ns = [2_000_000, *rng.integers(0, 8_000_000, 50).tolist(), 0]
        got = [
            clock.monotonic_ns(self.OFFSET_NS + off_ns + time_ns, time_ns + delay_ns) - time_ns
            for number, delay_ns in enumerate(delays_ns)
            for time_ns in [10**12 + 20_000_000 * number]
        ]
        assert got[0] == 2_000_000 and got[-1] == 0
        smallest = np.minimum.accumulate(delays_ns)
        # Where none was as small for a quarter of a second, the sender's clock may be slower by a little.
        assert (got >= smallest).all() and (got - smallest).max() < 3_000_000
        assert lines and all(word in lines[0] for word in ("time stamps of poses", "clock"))

    @pytest.mark.parametrize("stamp", [None, 0])
    def test_without_a_stamp_it_is_the_arrival(self, stamp):
        clock, lines = self.clock()
        assert clock.monotonic_ns(stamp, 123) == 123 and lines == []

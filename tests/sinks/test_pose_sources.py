"""Poses from ROS 2, and their geometry and time."""

import math
import time
from contextlib import ExitStack, closing
from functools import partial

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="of the extra `ros2`")

from edge_samples import wait_for
from ros2_samples import ENVIRONMENT, speaker
from scipy.spatial.transform import Rotation

from edge.api import UsageError
from edge.pipeline.pose_queue import PoseError, PoseQueue
from edge.pose_sources import EARLY_NS, LATE_NS, MOST_TILT_DEG, StampClock, check_poses, open_poses, pad_pose
from firmware_bridge.poses import PLACE_ERROR_MM, TURN_ERROR_DEG

DOWN = {"x": 1.0, "y": 0.0, "z": 0.0, "w": 0.0}


def test_a_source_of_poses_is_a_topic_for_one_sensor_or_all():
    assert check_poses("ros2:/arm/pose") == (None, "arm/pose")
    assert check_poses("4=ros2:pose") == ("4", "pose")
    assert check_poses("left/4=ros2:/a/b") == ("left/4", "a/b")
    for text in ("", "ros2", "ros2:", "ros2:/9x", "tf:a:b", "zenoh", "mqtt:x"):
        with pytest.raises(UsageError, match=r"^[^\n]+$"):
            check_poses(text)


def until(queue, satisfied, act=lambda: None):
    """Act until the poses that came suffice, and return all of them."""
    poses = []
    wait_for(lambda: act() or poses.extend(queue.take()) or satisfied(poses), within_s=20)
    return poses


POSE, UNCERTAIN = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped"
TRANSFORM = "geometry_msgs/msg/TransformStamped"


def header(at_ns=None):
    sec, nanosec = divmod(time.time_ns() if at_ns is None else at_ns, 10**9)
    return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": "base"}


def pose_at(x_m, y_m, orientation=DOWN):
    return {"position": {"x": x_m, "y": y_m, "z": 0.3}, "orientation": orientation}


class TestRos2:
    @pytest.fixture
    def publish(self):
        with speaker(*(("arm/pose", kind) for kind in (POSE, UNCERTAIN, TRANSFORM))) as say:
            yield partial(say, "arm/pose")

    @pytest.fixture
    def opened(self, monkeypatch):
        for name, value in ENVIRONMENT.items():
            monkeypatch.setenv(name, value)
        queue = PoseQueue()
        with ExitStack() as sources:

            def open_them(text):
                sources.enter_context(closing(open_poses(text, queue)))
                return queue

            yield open_them

    def test_a_pose_comes_with_its_stamp(self, opened, publish):
        queue = opened("4=ros2:/arm/pose")
        sent = []

        def act():
            sent.append(time.time_ns() - 20_000_000)  # measured 20 ms ago
            publish(POSE, {"header": header(sent[-1]), "pose": pose_at(0.001 * (len(sent) - 1), -0.5)})

        offset_ns = time.time_ns() - time.monotonic_ns()

        def in_time(one):
            return abs(one.time_ns + offset_ns - sent[round(one.pose.x_mm)]) < 1_000_000

        # The first ones may have waited for their writer, and then count as those of a clock that is behind.
        last = until(queue, lambda poses: poses and in_time(poses[-1]), act)[-1]
        assert (last.sensor, last.pose.y_mm, last.pose.error_mm, last.pose.error_deg) == ("4", -500.0, 0.2, 1.0)

    def test_types_share_a_topic_and_what_is_wrong_is_reported(self, opened, publish):
        queue = opened("ros2:arm/pose")
        covariance = np.zeros(36)
        covariance[[0, 7, 35]] = 0.001**2, 0.002**2, math.radians(3) ** 2
        moved = {"translation": {"x": 0.25, "y": 0.5, "z": 0.0}, "rotation": DOWN}
        tilted = {"x": 0.9, "y": 0.0, "z": 0.0, "w": 0.19**0.5}
        old_ns = time.time_ns() - 3600 * 10**9  # by a clock that differs

        def act():
            pose = {"pose": pose_at(0.001, 0.002), "covariance": covariance.tolist()}
            publish(UNCERTAIN, {"header": header(old_ns), "pose": pose})
            publish(TRANSFORM, {"header": header(old_ns), "child_frame_id": "pad", "transform": moved})
            publish(POSE, {"header": header(old_ns), "pose": pose_at(0, 0, tilted)})

        poses = until(queue, lambda poses: {1.0, 250.0} <= {p.pose.x_mm for p in poses} and queue.refused >= 2, act)
        errors = {one.pose.x_mm: (one.pose.error_mm, one.pose.error_deg) for one in poses}
        assert errors[1.0] == (pytest.approx(2), pytest.approx(3)) and errors[250.0] == (0.2, 1.0)
        now_ns = time.monotonic_ns()
        assert all(now_ns - 25 * 10**9 < one.time_ns <= now_ns for one in poses)
        reasons = queue.take_reasons()
        assert "tilted" in reasons["tilt"] and "3.6e+03 s behind" in reasons["clock"]


UP, FLIPPED = (0.0, 0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0)
"""Quaternions (x, y, z, w): no turn; and half a turn about x, the tool's z against the frame's, as above a table."""


def turned(axis, angle_deg, first=FLIPPED):
    """Return the quaternion of one turn, and then one about an axis of the frame."""
    return (Rotation.from_euler(axis, angle_deg, degrees=True) * Rotation.from_quat(first)).as_quat().tolist()


def read(place, quaternion):
    return pad_pose(*(dict(zip("xyzw", one, strict=False)) for one in (place, quaternion)), ())


class TestToolFrame:
    @pytest.mark.parametrize(
        ("place", "quaternion", "pose"),
        [
            ((0.25, -0.125, 0.4), FLIPPED, (250, -125, 0)),  # above a table: x and y are the table's, in mm
            *(((0, 0, 0), turned("z", turn), (0, 0, turn)) for turn in (-170, -30, 5, 90, 179)),
            ((0.01, 0.02, 0), turned("z", 30, UP), (10, -20, -30)),  # into the object: its y, and the other way round
        ],
    )
    def test_a_tool_frame_is_a_pose_of_the_pad(self, place, quaternion, pose):
        got = read(place, quaternion)
        assert (got.x_mm, got.y_mm, got.turn_deg) == pytest.approx(pose)
        assert (got.error_mm, got.error_deg) == (PLACE_ERROR_MM, TURN_ERROR_DEG)

    @pytest.mark.parametrize(
        ("place", "quaternion", "reason"),
        [
            ((math.nan, 0, 0), FLIPPED, "finite"),
            ((0, 0, 0), (math.inf, 0, 0, 0), "finite"),
            ((0, 0, 0), (0, 0, 0, 0), "quaternion"),
            ((0, 0, 0), (2, 0, 0, 0), "quaternion"),
            ((1e9, 0, 0), FLIPPED, "range"),
            *(((0, 0, 0), turned(axis, 12), "tilt") for axis in "xy"),
        ],
    )
    def test_what_is_no_pose_is_refused(self, place, quaternion, reason):
        read((0, 0, 0), turned("x", MOST_TILT_DEG - 0.1))
        with pytest.raises(PoseError) as caught:
            read(place, quaternion)
        assert caught.value.reason == reason


class TestStampClock:
    OFFSET_NS = 1_700_000_000 * 10**9

    def times_ns(self, *stamped):
        """Return the times of stamps, each with its arrival, and the lines that the clock printed."""
        lines = []
        clock = StampClock(lines.append, lambda: self.OFFSET_NS)
        return [clock.monotonic_ns(stamp, arrival_ns) for stamp, arrival_ns in stamped], lines

    @pytest.mark.parametrize("delay_ns", [-EARLY_NS, 0, 30_000_000, LATE_NS])
    def test_where_clocks_agree_a_stamp_is_the_time_and_delay_stays(self, delay_ns):
        arrival_ns = 10**12
        got = self.times_ns((self.OFFSET_NS + arrival_ns - delay_ns, arrival_ns))
        assert got == ([arrival_ns - max(delay_ns, 0)], [])

    @pytest.mark.parametrize("off_ns", [-5 * 10**9, 10**8, 10**15, -(10**15)])
    def test_where_they_do_not_the_smallest_delay_counts_as_none(self, off_ns):
        delays_ns = np.array([2_000_000, *np.random.default_rng(1).integers(0, 8_000_000, 50), 0])
        sent_ns = 10**12 + 20_000_000 * np.arange(len(delays_ns))
        stamps = [self.OFFSET_NS + off_ns + int(one) for one in sent_ns]
        times_ns, lines = self.times_ns(*zip(stamps, (sent_ns + delays_ns).tolist(), strict=True))
        got, smallest = times_ns - sent_ns, np.minimum.accumulate(delays_ns)
        assert got[0] == 2_000_000 and got[-1] == 0
        # Where none was as small for a quarter of a second, the sender's clock may be slower by a little.
        assert (got >= smallest).all() and (got - smallest).max() < 3_000_000
        assert lines and all(word in lines[0] for word in ("time stamps of poses", "clock"))

        assert self.times_ns((0, 123)) == ([123], []), "without a stamp it is the arrival"

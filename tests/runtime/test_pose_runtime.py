"""Model that takes poses, in the runtime and alone: which taps a pattern is made from, and where to touch next."""

import math
from dataclasses import replace

import numpy as np
import pytest
from edge_samples import BASELINE, PERIOD_NS, inferred
from pose_samples import PosedModel, make_posed_contract, posed_pattern, write_posed_model
from runtime_samples import PRESS, Pushed, make_runtime
from trust_samples import make_checked_contract, make_posed_trust

from edge.api import USPA44, PadPose, UsageError
from edge.inference.contract import pose_rows, scheduled_rows
from edge.inference.onnx_session import ModelSession
from edge.perception.run_options import RuntimeOptions
from edge.perception.taps import next_shift_mm

POSES = [PadPose(0, 0, 0), PadPose(2, 1, 5, 0.1, 2), PadPose(3, -1, 90, 0.3, 0.5)]


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    return ModelSession(write_posed_model(tmp_path_factory.mktemp("posed") / "posed.onnx"))


def make_pad(contract=None, **options):
    return Pushed(make_runtime(PosedModel(contract), options=RuntimeOptions(**options)))


def lose_pose(pad):
    """Let the course of poses end for longer than a gap that is interpolated."""
    pad.runtime.pose(PadPose(0, 0), pad.number * PERIOD_NS)
    for _ in range(30):
        pad.push()


def expected(result, contract):
    return posed_pattern(contract.scale_window(result.window), result.poses)


class TestChoice:
    def test_a_pattern_is_made_from_all_taps_with_their_poses(self, session):
        pad = Pushed(make_runtime(session))
        for count, pose in enumerate(POSES, 1):
            result = pad.tap(pose, PRESS + 500 * count)
            assert result.taps_used == count and result.pose == pose
            np.testing.assert_allclose(result.poses, pose_rows(POSES[:count][::-1]), rtol=1e-6)
            peaks = [PRESS + 500 * (one + 1) for one in range(count)][::-1]
            assert result.window[:, 2].max(axis=(1, 2)).tolist() == peaks
            np.testing.assert_allclose(result.pattern, expected(result, session.contract), atol=1e-4)
        assert pad.kinds == [] and result.poses.dtype == np.float32
        assert result.poses[1, 3] == pytest.approx(np.hypot(0.1, 0.3)), "both poses may be wrong"

    def test_a_tap_has_the_pose_of_its_peak(self):
        pad = make_pad()
        for x_mm, press in ((0, PRESS), (1, 2 * PRESS), (2, PRESS), (3, 0)):
            pad.place(PadPose(x_mm, 0))
            pad.push(press)
        for x_mm in (4, 5):
            pad.place(PadPose(x_mm, 0))
            result = pad.push(PRESS)
            assert result.pose.x_mm == x_mm and result.poses[:, 0].tolist() == [0, 1 - x_mm]

    def test_a_pose_is_that_of_when_readings_were_on_the_bus(self):
        """Also that of an earlier tap; where the device states no time, of when they arrived."""
        pad = make_pad()
        for number in range(20):
            pad.runtime.pose(PadPose(number, 0), number * PERIOD_NS)
        for at, on_bus, share in ((6, 5.5, 1), (10, 7, 2), (11, 10, 0), (13, 12.5, 1), (14, None, 1)):
            device_ns = None if on_bus is None else round(on_bus * PERIOD_NS)
            result = pad.runtime.push(replace(pad.scan(share * PRESS, time_ns=at * PERIOD_NS), device_ns=device_ns))
            assert result.pose.x_mm == (at if on_bus is None else on_bus)
        assert result.poses[:, 0].tolist() == [0, 7 - 14]

    def test_a_scan_without_a_pose_is_used_alone_with_one_event_each(self):
        pad = make_pad()
        pad.tap()
        assert pad.kinds == [], "a sensor without poses is no fault"
        pad.tap(PadPose(0, 0))
        assert pad.kinds == ["tap_without_pose"], "of the earlier tap, once there are poses"
        lose_pose(pad)
        result = pad.tap()
        assert result.taps_used == 1 and result.pose is None and result.poses.tolist() == [[0] * 5]
        assert pad.kinds == ["tap_without_pose"] * 2
        assert pad.tap(PadPose(2, 0)).poses[:, 0].tolist() == [0, -2], "the tap in the middle has none"
        for _ in range(8):  # more than the window holds
            lose_pose(pad)
            pad.tap()
        # Taps of before have neither poses nor places: those after it are the only ones.
        assert [pad.tap(PadPose(x_mm, 0)).taps_used for x_mm in (1, 3)] == [1, 2]
        assert pad.kinds[2:] == ["tap_without_pose"] * 8, "one of each tap"

    def test_a_pose_that_comes_after_its_tap_counts(self):
        pad = make_pad()
        pad.place(PadPose(0, 0), sensor="another")
        pad.tap()
        pad.runtime.pose(PadPose(1, 0), 1 * PERIOD_NS)
        pad.runtime.pose(PadPose(3, 0), 3 * PERIOD_NS)
        assert pad.tap(PadPose(5, 0)).poses[:, 0].tolist() == [0, 2 - 5]

    def test_a_pose_of_no_time_is_refused(self):
        runtime = make_pad().runtime
        times_ns = (math.nan, 5, math.nan, 4, 6)  # as of a table with gaps
        assert [runtime.pose(PadPose(0, 0), time_ns) for time_ns in times_ns] == [False, True, False, False, True]

    def test_a_tap_beyond_reach_is_left_out_until_the_pad_comes_near(self):
        pad = make_pad(make_posed_contract(reach_mm=5.0))
        pad.tap(PadPose(0, 0))
        assert pad.tap(PadPose(3, 4)).taps_used == 2
        assert pad.tap(PadPose(5.1, 0)).poses[:, 0] == pytest.approx([0, -2.1])
        assert pad.kinds == ["tap_out_of_reach"]
        assert pad.tap(PadPose(1, 0)).taps_used == 4
        assert pad.kinds == ["tap_out_of_reach"]

    def test_of_taps_at_one_place_the_newest_counts_alone(self):
        """The error of a taxel is in all of them, and would count as seen several times."""
        pad = make_pad()
        for pose, expected_mm in (
            (PadPose(0, 0), [0]),
            (PadPose(0.3, 0.3), [0]),
            (PadPose(0.3, 0.3, 359), [0]),
            (PadPose(2.3, 0.3), [0, 2]),
            (PadPose(2.3, 0.3, 3), [0, 2]),  # at the corners 0.5 mm, root mean square over the pad 0.4
            (PadPose(2.3, 0.3, 8), [0, 0, 2]),
        ):
            result = pad.tap(pose)
            assert np.hypot(*result.poses[:, :2].T) == pytest.approx(np.abs(expected_mm), abs=1e-6)
        assert pad.kinds == []

    def test_two_sensors_with_different_numbers_of_taps_in_one_run(self, session):
        runtime = make_runtime(session, baselines=dict.fromkeys(("4", "6"), BASELINE))
        pads = [Pushed(runtime, "4"), Pushed(runtime, "6")]
        runtime.pose(PadPose(7, 7, 7), 0, "6", holds=True)
        for pose in POSES:
            pads[0].tap(pose)
        pads[1].number = pads[0].number
        pads[0].place(PadPose(1, 2, 3))
        results = inferred(runtime, [pad.scan(PRESS + 100 * index) for index, pad in enumerate(pads)])
        assert [result.taps_used for result in results] == [4, 1]
        assert [result.pose.x_mm for result in results] == [1, 7], "its own poses come before those of all"
        for result in results:
            np.testing.assert_allclose(result.pattern, expected(result, session.contract), atol=1e-4)

    def test_a_changed_relative_pose_is_inferred_again(self):
        pad = Pushed(make_runtime(model := PosedModel()))
        for x_mm in range(3):  # a single tap has none
            pad.place(PadPose(x_mm, 0))
            assert pad.push(PRESS).pose.x_mm == x_mm
        assert len(model.windows) == 1
        pad.push()
        pad.place(PadPose(1, 0, 0))
        first = pad.push(PRESS)
        for pose, runs_more in ((PadPose(1.02, 0, 0.1), 0), (PadPose(1.2, 0), 1), (PadPose(1.2, 0, 2), 2)):
            pad.place(pose)
            result = pad.push(PRESS)
            assert result.pose == pose and len(model.windows) == 2 + runs_more
            assert (result.reused_from == first.scan.number) == (runs_more == 0)
            np.testing.assert_allclose(result.pattern, expected(result, model.contract), atol=1e-4)

    @pytest.mark.parametrize(("taps", "used"), [(None, 1), (1, 1), (3, 3)])
    def test_without_poses_a_sensor_follows_the_schedule(self, taps, used):
        pad = make_pad(taps=taps)
        result = [pad.tap() for _ in range(4)][-1]
        assert result.taps_used == used and result.pose is None and pad.kinds == []
        np.testing.assert_array_equal(result.poses, scheduled_rows(used, 5.0))

    def test_the_most_taps_are_the_models_or_fewer(self):
        posed, of_three, plain = make_pad(taps=2), make_pad(make_posed_contract(taps=3)), Pushed()
        assert [posed.tap(PadPose(x, 0)).taps_used for x in range(4)] == [1, 2, 2, 2]
        assert [of_three.tap(PadPose(x, 0)).poses[:, 0].tolist() for x in range(5)][-1] == [0, -1, -2]
        plain = Pushed(make_runtime(options=RuntimeOptions(taps=2)))
        assert [plain.tap().taps_used for _ in range(4)] == [1, 2, 2, 2]
        with pytest.raises(UsageError, match="taps is 8, but model 'fake' takes 7 at most"):
            make_pad(taps=8)
        for wrong in (0, 1.5, "2"):
            with pytest.raises(UsageError, match=r"taps is .*, expected a whole number from 1"):
                RuntimeOptions(taps=wrong)


class TestChecks:
    def test_the_check_of_earlier_taps_takes_their_poses(self):
        pad = make_pad(make_checked_contract(make_posed_trust(2.5)))
        pad.tap(PadPose(4, 0))
        lose_pose(pad)
        pad.tap()  # without a pose, so it is left out below
        pad.tap(PadPose(2, 0))
        result = pad.tap(PadPose(0, 0))
        assert [share >= 0.5 for share in result.tap_mismatch] == [False, True]
        assert result.taps_used == 2 and result.poses[:, 0].tolist() == [0, 2] and len(result.window) == 2
        result = pad.tap(PadPose(4, 0))
        assert result.poses[:, 0].tolist() == [0, -4, -2], "the first tap is forgotten, the others are not"
        assert pad.kinds == ["tap_without_pose", "tap_dropped"]

    def test_a_posed_tap_that_does_not_belong_goes_alone(self):
        model = PosedModel(make_checked_contract(make_posed_trust(2.5)))
        pad = Pushed(make_runtime(model))
        for x_mm, more in ((1, 0), (2.55, 100), (2, 200)):  # 0.73 in the middle
            pad.tap(PadPose(x_mm, 0), PRESS + more)
        pad.place(PadPose(0, 0))
        light, again = pad.push(0.7 * PRESS), pad.push(0.7 * PRESS)
        assert light.poses[:, 0].tolist() == [0, 2, 1] and (light.taps_used, light.taps_dropped) == (3, 1)
        assert again.reused_from == light.scan.number and again.taps_dropped == 1
        for result in (light, again):
            np.testing.assert_allclose(model.windows[-1], model.contract.scale_window(result.window), rtol=1e-5)
        assert [window[2].max() for window in light.window] == [0.7 * PRESS, PRESS + 200, PRESS]
        assert "tap_dropped" not in pad.kinds, "a light press may only have begun"
        pad.push(PRESS)
        settled = pad.push(1.1 * PRESS)
        assert settled.poses[:, 0].tolist() == [0, 2, 1] and settled.taps_dropped == 0
        assert pad.kinds == ["tap_dropped"]


HALF_MM = USPA44.pitch_mm / 2
REACH_MM = 6.0
SURE = make_posed_contract(interval_factor=1.6)


def test_an_earlier_tap_is_not_touched_again_and_in_reach():
    assert next_shift_mm(np.array([[0.0, 0.0], [HALF_MM + 0.3, -0.2]]), REACH_MM) not in (None, (HALF_MM, 0.0))
    shift_mm = next_shift_mm(np.array([[0.0, 0.0], [-HALF_MM, 0.0]]), 3.4)
    assert shift_mm is not None and np.hypot(shift_mm[0] + HALF_MM, shift_mm[1]) <= 3.4
    assert next_shift_mm(np.zeros((1, 2)), 2.0) is None
    assert next_shift_mm(np.array([[0.0, 0.0], [5.0, 0.0], [-5.0, 0.0]]), 5.1) is None, "none is in reach of all"


def test_a_robot_that_follows_touches_no_place_twice():
    pad, places = make_pad(make_posed_contract(interval_factor=1.6, taps=5), idle_reset_s=0.2), set()
    pose = begun = PadPose(5, -3, 30)
    for _ in range(4):
        assert pad.tap(pose).next_tap is None
        proposed = pad.results[-1].next_tap
        seen = pose.seen_from(begun)
        places.add((round(seen.x_mm / HALF_MM, 6), round(seen.y_mm / HALF_MM, 6)))
        seen = proposed.target.seen_from(pose)
        assert (seen.x_mm, seen.y_mm, seen.turn_deg) == pytest.approx((proposed.dx_mm, proposed.dy_mm, 0), abs=1e-9)
        pose = proposed.target
    assert len(places) == 4 and all(x == round(x) and y == round(y) for x, y in places)
    pad.tap(pose)
    assert pad.results[-1].next_tap is None, "the model takes no further tap: a robot that follows stops"


def test_it_stays_until_the_next_tap_or_an_idle_time():
    pad, full = make_pad(SURE, idle_reset_s=0.2), make_pad(SURE, taps=1)
    assert full.tap(PadPose(0, 0)).taps_used == 1 and full.push().next_tap is None, "no further one is taken"
    pad.tap()
    assert pad.push().next_tap is None, "without a pose"
    pad.tap(PadPose(0, 0))
    proposed = pad.results[-1].next_tap
    assert pad.push().next_tap == proposed is not None
    assert pad.push(PRESS).next_tap is None
    pad.tap(PadPose(1, 0))
    assert pad.push().next_tap is not None
    assert [pad.push().next_tap for _ in range(30)][-1] is None


def test_it_is_from_the_strongest_scan_since_a_reset():
    pad = make_pad(SURE, idle_reset_s=0.2)
    for press, x_mm in ((0.6 * PRESS, 1), (PRESS, 2), (0.8 * PRESS, 3)):
        pad.place(PadPose(x_mm, 0))
        pad.push(press)
    proposed = pad.push().next_tap
    assert proposed.target.x_mm - proposed.dx_mm == pytest.approx(2)
    pad.push(PRESS)
    pad.runtime.reset()
    pad.place(PadPose(5, 0))
    assert [pad.push(share * PRESS).taps_used for share in (0.8, 0.7)] == [1, 1]
    proposed = pad.push().next_tap
    assert proposed is not None and proposed.target.x_mm - proposed.dx_mm == pytest.approx(5)


def test_a_tap_is_followed_if_its_strongest_pattern_is_believed():
    """Readings of x on the first taxel are unfamiliar to the checks."""
    for strange in ((0, PRESS), (PRESS, 0)):
        pad = make_pad(replace(make_checked_contract(make_posed_trust(2.5)), output_full_scale=10.0))
        pad.place(PadPose(0, 0))
        for press, x in zip((PRESS, 0.8 * PRESS), strange, strict=True):
            scan = pad.scan(press)
            scan.counts[0, 0, 0] += x
            pad.runtime.push(scan)
        assert (pad.push().next_tap is None) == (strange[0] > 0)

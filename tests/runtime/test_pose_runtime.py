"""Model that takes poses, in the runtime and alone: which taps a pattern is made from, and with which poses."""

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from edge_samples import BASELINE, PERIOD_NS, FakeModel, inferred, write_model
from pose_samples import PosedModel, make_posed_contract, posed_pattern, write_posed_model
from runtime_samples import PRESS, Pushed, make_runtime
from trust_samples import make_checked_contract, make_posed_trust

from edge.api import PadPose, UsageError, WindowError
from edge.inference.contract import pose_rows, scheduled_rows
from edge.inference.onnx_session import ModelSession
from edge.perception.contact_options import RuntimeOptions

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

    @pytest.mark.parametrize(("before_ns", "x_mm"), [(None, 11), (PERIOD_NS // 2, 10.5)])
    def test_the_pose_is_that_of_when_readings_were_on_the_bus(self, before_ns, x_mm):
        pad = make_pad()
        for number in range(20):
            pad.runtime.pose(PadPose(number, 0), number * PERIOD_NS)
        scan = pad.scan(PRESS, time_ns=11 * PERIOD_NS)
        if before_ns is not None:
            scan = replace(scan, device_ns=scan.time_ns - before_ns)
        assert pad.runtime.push(scan).pose.x_mm == x_mm

    def test_taps_without_a_pose_are_left_out_with_one_event_each(self):
        pad = make_pad()
        pad.tap()
        pad.tap()
        assert pad.kinds == [], "a sensor without poses is no fault"
        pad.tap(PadPose(0, 0))
        result = pad.tap(PadPose(1, 0))
        assert result.taps_used == 2 and result.poses[:, 0].tolist() == [0, -1]
        pad.tap(PadPose(2, 0))
        assert pad.kinds == ["tap_without_pose"] * 2

    def test_a_newest_scan_without_a_pose_is_used_alone(self):
        pad = make_pad()
        pad.tap(PadPose(0, 0))
        lose_pose(pad)
        result = pad.tap()
        assert result.taps_used == 1 and result.pose is None and result.poses.tolist() == [[0] * 5]
        assert pad.tap(PadPose(2, 0)).poses[:, 0].tolist() == [0, -2], "the tap in the middle has none"
        for _ in range(8):  # more than the window holds
            lose_pose(pad)
            pad.tap()
        # Taps of before have neither poses nor places: those after it are the only ones.
        assert [pad.tap(PadPose(x_mm, 0)).taps_used for x_mm in (1, 3)] == [1, 2]

    def test_a_pose_that_comes_after_its_tap_counts(self):
        pad = make_pad()
        pad.place(PadPose(0, 0), sensor="another")
        pad.tap()
        pad.runtime.pose(PadPose(1, 0), 1 * PERIOD_NS)
        pad.runtime.pose(PadPose(3, 0), 3 * PERIOD_NS)
        assert pad.tap(PadPose(5, 0)).poses[:, 0].tolist() == [0, 2 - 5]

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

    def test_a_model_without_poses_ignores_them(self):
        plain, moved = Pushed(make_runtime(FakeModel())), Pushed(make_runtime(FakeModel()))
        for x_mm in (0, 50):
            without, result = plain.tap(), moved.tap(PadPose(x_mm, 0))
            np.testing.assert_array_equal(result.pattern, without.pattern)
            assert result.pose.x_mm == x_mm and result.poses is None and without.pose is None
        assert result.taps_used == 2 and moved.kinds == []

    def test_a_new_object_forgets_taps_and_keeps_poses(self):
        pad = make_pad()
        pad.tap(PadPose(1, 0))
        pad.runtime.reset()
        result = pad.tap()
        assert result.taps_used == 1 and result.pose.x_mm == 1


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
        for x_mm, more in ((1, 0), (4, 100), (2, 200)):
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

    def test_taps_of_the_schedule_go_with_a_later_stranger(self):
        # Without poses every tap lies at 0 mm, so that a limit below that drops them all.
        pad = make_pad(make_checked_contract(make_posed_trust(-1.0)), taps=3)
        for _ in range(5):
            pad.tap()
        result = pad.push(PRESS)
        assert (result.taps_used, result.taps_dropped, len(result.window)) == (1, 1, 1)
        assert pad.push(PRESS).tap_mismatch is None, "they are forgotten for good"


def random_taps(taps, seed=0):
    """Return a window and its poses."""
    rng = np.random.default_rng(seed)
    poses = rng.normal(size=(taps, 5)).astype(np.float32)
    poses[0] = 0
    return rng.normal(size=(taps, 3, 4, 4)).astype(np.float32), poses


class TestSession:
    def test_any_number_of_taps_runs_in_any_order(self, session):
        for taps in range(1, 8):
            window, poses = random_taps(taps)
            np.testing.assert_allclose(session.run(window, poses=poses), posed_pattern(window, poses), atol=1e-5)
            for count in range(1, 8):  # and of any number of pads, more shapes than arrays are kept for
                windows, rows = zip(*[random_taps(taps, seed) for seed in range(count)], strict=True)
                made = session.run_together(windows, None, rows)
                np.testing.assert_allclose(made[-1], posed_pattern(windows[-1], rows[-1]), atol=1e-5)
        window, poses = random_taps(4)
        expected = session.run(window, poses=poses).copy()
        for order in permutations((1, 2, 3)):
            again = [0, *order]
            np.testing.assert_allclose(session.run(window[again], poses=poses[again]), expected, atol=1e-5)

    @pytest.mark.parametrize("batch", ["any", 1])
    def test_windows_of_several_lengths_run_together(self, tmp_path, batch):
        contract = make_posed_contract(batch=batch, interval_factor=1.6)
        session = ModelSession(write_posed_model(tmp_path / "several.onnx", contract))
        for lengths in ((4, 1, 7), (1, 3, 2), (4, 7, 1)):  # the last ones are where others lay before
            taps = [random_taps(length, seed) for seed, length in enumerate(lengths)]
            windows, poses = zip(*taps, strict=True)
            together = session.run_together(windows, None, poses).copy()
            deviations = session.deviation.copy()
            for index, (window, rows) in enumerate(taps):
                np.testing.assert_allclose(together[index], posed_pattern(window, rows), atol=1e-5)
                session.run(window, poses=rows)
                np.testing.assert_allclose(deviations[index], session.deviation, atol=1e-6)

    def test_without_poses_taps_follow_the_schedule(self, session):
        window, _ = random_taps(4)
        poses = scheduled_rows(4, 5.0)
        assert poses[:, 2].tolist() == [0, 5, 10, 15]
        np.testing.assert_allclose(poses[1:, 3:], [[0.2, 1.0]] * 3)
        for present in (4, 2):
            window[present:] = poses[present:] = 0
            np.testing.assert_array_equal(session.run(window).copy(), session.run(window, poses=poses))
        assert scheduled_rows(5, 100.0)[:, 2].tolist() == [0, 100, -160, -60, 40], "within half a turn"

    def test_poses_become_the_newest_taps_view_with_both_errors(self):
        rows = pose_rows([PadPose(10, 5, 90, 0.3, 3), PadPose(10, 7, 85, 0.4, 4)])
        assert not rows[0].any() and rows.dtype == np.float32
        np.testing.assert_allclose(rows[1], [2, 0, -5, 0.5, 5], atol=1e-6)

    @pytest.mark.parametrize(
        ("window", "poses", "match"),
        [
            ((8, 3, 4, 4), (8, 5), r"window is \(8, 3, 4, 4\) float32, expected \(1 to 7, 3, 4, 4\) float32"),
            ((0, 3, 4, 4), (0, 5), r"window is \(0, 3, 4, 4\)"),
            ((2, 3, 4, 5), (2, 5), r"window is \(2, 3, 4, 5\)"),
            ((2, 3, 4, 4), (3, 5), r"poses are \(3, 5\) float32, expected \(2, 5\) float32: dx_mm, .* of each tap"),
            ((2, 3, 4, 4), (2, 3), r"poses are \(2, 3\) float32, expected \(2, 5\)"),
        ],
    )
    def test_shapes_that_do_not_fit_are_refused_with_both(self, session, window, poses, match):
        with pytest.raises(WindowError, match=match):
            session.run(np.zeros(window, dtype=np.float32), poses=np.zeros(poses, dtype=np.float32))

    def test_poses_that_mean_nothing_are_refused(self, session, tmp_path):
        window, poses = random_taps(2)
        with pytest.raises(WindowError, match=r"newest tap's pose is \[1.0, .*expected zeros: give poses as that tap"):
            session.run(window, poses=poses + 1)
        with pytest.raises(WindowError, match="poses have values that are not finite"):
            session.run(window, poses=np.where(poses == 0, poses, np.float32(np.nan)))
        with pytest.raises(WindowError, match=r"poses are \(2, 5\) float64"):
            session.run(window, poses=poses.astype(float))
        session = ModelSession(write_model(tmp_path / "tiny.onnx"))
        with pytest.raises(WindowError, match="poses are given, but model 'tiny' takes none: leave them out"):
            session.run(np.zeros((4, 3, 4, 4), np.float32), poses=np.zeros((4, 5), np.float32))

"""Runtime with a model that takes poses: which taps a pattern is made from, and with which poses."""

import numpy as np
import pytest
from edge_samples import BASELINE, PERIOD_NS, FakeModel, inferred, make_contract, make_scan
from pose_samples import PosedModel, make_posed_contract, posed_pattern, write_posed_model
from runtime_samples import PRESS, make_runtime
from trust_samples import make_posed_trust, make_trust

from edge.errors import ModelError, UsageError
from edge.inference.contract import Contract
from edge.inference.onnx_session import ModelSession
from edge.inference.pose_input import pose_rows, scheduled_rows
from edge.perception.contact_options import RuntimeOptions
from firmware_bridge.poses.pad_pose import PadPose


@pytest.fixture
def session(tmp_path):
    return ModelSession(write_posed_model(tmp_path / "posed.onnx"))


class Pad:
    """Pad of one sensor that a robot moves and presses."""

    def __init__(self, runtime, sensor="4"):
        self.runtime, self.sensor, self.number = runtime, sensor, 0
        self.events = []

    def scan(self, press=0, **settings):
        scan = make_scan(self.number, press_counts=press, sensor=self.sensor, **settings)
        self.number += 1
        return scan

    def push(self, press=0, **settings):
        result = self.runtime.push(self.scan(press, **settings))
        self.events += [event.kind for event in result.events]
        return result

    def place(self, pose, **settings):
        """Hold the pad at a pose from now on, shortly before the next scan."""
        return self.runtime.pose(pose, (self.number + 1) * PERIOD_NS - 1000, holds=True, **settings)

    def lose_pose(self):
        """Let the course of poses end for longer than a gap that is interpolated."""
        self.runtime.pose(PadPose(0, 0), self.number * PERIOD_NS)
        for _ in range(30):
            self.push()

    def tap(self, pose=None, press=PRESS):
        """Press twice and release; return the result of the second scan."""
        if pose is not None:
            self.place(pose)
        self.push(press / 2)
        result = self.push(press)
        self.push()
        return result


def expected(result, contract):
    return posed_pattern(contract.scale_window(result.window), result.poses)


POSES = [PadPose(0, 0, 0), PadPose(2, 1, 5, 0.1, 2), PadPose(3, -1, 90, 0.3, 0.5)]


def test_a_pattern_is_made_from_all_taps_with_their_poses_in_the_newest_ones_axes(session):
    pad = Pad(make_runtime(session))
    for count, pose in enumerate(POSES, 1):
        result = pad.tap(pose, PRESS + 500 * count)
        assert result.taps_used == count and result.pose == pose
        np.testing.assert_allclose(result.poses, pose_rows(POSES[:count][::-1]), rtol=1e-6)
        assert result.window[:, 2].max(axis=(1, 2)).tolist() == [PRESS + 500 * (one + 1) for one in range(count)][::-1]
        np.testing.assert_allclose(result.pattern, expected(result, session.contract), atol=1e-4)
    assert pad.events == [] and result.poses.dtype == np.float32
    assert result.poses[1, 3] == pytest.approx(np.hypot(0.1, 0.3)), "both poses may be wrong"


def test_a_tap_has_the_pose_of_its_peak_and_the_newest_that_of_its_scan():
    pad = Pad(make_runtime(PosedModel()))
    for x_mm, press in ((0, PRESS), (1, 2 * PRESS), (2, PRESS), (3, 0)):
        pad.place(PadPose(x_mm, 0))
        pad.push(press)
    for x_mm in (4, 5):
        pad.place(PadPose(x_mm, 0))
        result = pad.push(PRESS)
        assert result.pose.x_mm == x_mm and result.poses[:, 0].tolist() == [0, 1 - x_mm]


def test_the_pose_is_that_of_the_moment_at_which_readings_were_on_the_bus():
    runtime = make_runtime(PosedModel())
    for number in range(20):
        runtime.pose(PadPose(number, 0), number * PERIOD_NS)
    scan = make_scan(10, press_counts=PRESS)
    late = type(scan)(*(getattr(scan, name) for name in ("sensor", "number", "time_ns", "counts", "fresh", "renewed")))
    assert runtime.push(late).pose.x_mm == 11
    object.__setattr__(late, "on_bus_ns", late.time_ns - PERIOD_NS // 2)
    assert runtime.push(late).pose.x_mm == 10.5


def test_taps_without_a_pose_are_left_out_with_one_event_each():
    model = PosedModel()
    pad = Pad(make_runtime(model))
    pad.tap()
    pad.tap()
    assert pad.events == [], "a sensor without poses is no fault"
    pad.tap(PadPose(0, 0))
    result = pad.tap(PadPose(1, 0))
    assert result.taps_used == 2 and result.poses[:, 0].tolist() == [0, -1]
    assert pad.events == ["tap_without_pose"] * 2
    pad.tap(PadPose(2, 0))
    assert pad.events == ["tap_without_pose"] * 2
    assert [len(window) for window in model.windows[-2:]] == [3, 3]


def test_a_newest_scan_without_a_pose_is_used_alone():
    pad = Pad(make_runtime(PosedModel()))
    pad.tap(PadPose(0, 0))
    pad.lose_pose()
    result = pad.tap()
    assert result.taps_used == 1 and result.pose is None and result.poses.tolist() == [[0] * 5]
    result = pad.tap(PadPose(2, 0))
    assert result.poses[:, 0].tolist() == [0, -2], "the tap in the middle has none"
    pad.push()
    assert pad.events == ["tap_without_pose"]


def test_taps_that_have_left_the_window_are_forgotten():
    runtime = make_runtime(PosedModel())
    pad = Pad(runtime)
    pad.tap(PadPose(0, 0))
    pad.lose_pose()
    for _ in range(20):
        pad.tap()
    assert pad.events.count("tap_without_pose") >= 19
    # Taps of before have neither poses nor places: those after it are the only ones.
    assert pad.tap(PadPose(1, 0)).taps_used == 1
    assert pad.tap(PadPose(3, 0)).taps_used == 2


def test_a_pose_that_comes_after_its_tap_counts():
    pad = Pad(make_runtime(PosedModel()))
    pad.place(PadPose(0, 0), sensor="another")
    pad.tap()
    pad.runtime.pose(PadPose(1, 0), 1 * PERIOD_NS)
    pad.runtime.pose(PadPose(3, 0), 3 * PERIOD_NS)
    result = pad.tap(PadPose(5, 0))
    assert result.poses[:, 0].tolist() == [0, 2 - 5]


def test_a_tap_beyond_reach_is_left_out_until_the_pad_comes_near_again():
    pad = Pad(make_runtime(PosedModel(make_posed_contract(reach_mm=5.0))))
    pad.tap(PadPose(0, 0))
    assert pad.tap(PadPose(3, 4)).taps_used == 2
    result = pad.tap(PadPose(5.1, 0))
    assert result.poses[:, 0] == pytest.approx([0, -2.1])
    assert pad.events == ["tap_out_of_reach"]
    assert pad.tap(PadPose(1, 0)).taps_used == 4
    assert pad.events == ["tap_out_of_reach"]


def test_of_taps_at_one_place_the_newest_counts_alone():
    """The error of a taxel is in all of them, and would count as seen several times."""
    pad = Pad(make_runtime(PosedModel()))
    for pose, expected_mm in (
        (PadPose(0, 0), [0]),
        (PadPose(0.3, 0.3), [0]),
        (PadPose(0.3, 0.3, 359), [0]),
        (PadPose(2.3, 0.3), [0, 2]),
        (PadPose(2.3, 0.3, 3), [0, 2]),  # at the corners .5 mm, root mean square over the pad .4
        (PadPose(2.3, 0.3, 8), [0, 0, 2]),
    ):
        result = pad.tap(pose)
        assert np.hypot(*result.poses[:, :2].T) == pytest.approx(np.abs(expected_mm), abs=1e-6)
    assert pad.events == []


def test_no_more_taps_than_the_model_takes_the_newest_of_them():
    pad = Pad(make_runtime(PosedModel(make_posed_contract(taps=3))))
    for number in range(5):
        result = pad.tap(PadPose(number, 0))
    assert result.poses[:, 0].tolist() == [0, -1, -2]


def test_two_sensors_with_different_numbers_of_taps_in_one_run(session):
    runtime = make_runtime(session, baselines=dict.fromkeys(("4", "6"), BASELINE))
    pads = [Pad(runtime, "4"), Pad(runtime, "6")]
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


def test_an_unchanged_reading_is_inferred_again_where_a_relative_pose_has_changed():
    model = PosedModel()
    pad = Pad(make_runtime(model))
    pad.tap(PadPose(0, 0))
    pad.place(PadPose(1, 0, 0))
    first = pad.push(PRESS)
    runs = len(model.windows)
    for pose, runs_more in ((PadPose(1.02, 0, 0.1), 0), (PadPose(1.2, 0), 1), (PadPose(1.2, 0, 2), 2)):
        pad.place(pose)
        result = pad.push(PRESS)
        assert result.pose == pose and len(model.windows) == runs + runs_more
        assert (result.reused_from == first.scan.number) == (runs_more == 0)
        np.testing.assert_allclose(result.pattern, expected(result, model.contract), atol=1e-4)


def test_a_single_tap_is_not_inferred_again_for_its_pose():
    model = PosedModel()
    pad = Pad(make_runtime(model))
    for x_mm in range(3):
        pad.place(PadPose(x_mm, 0))
        assert pad.push(PRESS).pose.x_mm == x_mm
    assert len(model.windows) == 1


@pytest.mark.parametrize(("taps", "used"), [(None, 1), (1, 1), (3, 3)])
def test_a_sensor_without_poses_follows_the_schedule_with_as_many_taps_as_asked_for(taps, used):
    pad = Pad(make_runtime(PosedModel(), options=RuntimeOptions(taps=taps)))
    for _ in range(4):
        result = pad.tap()
    assert result.taps_used == used and result.pose is None and pad.events == []
    np.testing.assert_array_equal(result.poses, scheduled_rows(used, 5.0))


def test_the_most_taps_hold_with_poses_and_for_models_without():
    pad = Pad(make_runtime(PosedModel(), options=RuntimeOptions(taps=2)))
    assert [pad.tap(PadPose(x, 0)).taps_used for x in range(4)] == [1, 2, 2, 2]
    pad = Pad(make_runtime(FakeModel(), options=RuntimeOptions(taps=2)))
    assert [pad.tap().taps_used for _ in range(4)] == [1, 2, 2, 2]


def test_more_taps_than_the_model_takes_are_refused():
    with pytest.raises(UsageError, match="taps is 8, but model 'fake' takes 7 at most"):
        make_runtime(PosedModel(), options=RuntimeOptions(taps=8))
    for wrong in (0, 1.5, "2"):
        with pytest.raises(UsageError, match=r"taps is .*, expected a whole number from 1"):
            RuntimeOptions(taps=wrong)


def test_a_model_without_poses_ignores_them_but_its_results_have_the_pads():
    plain, moved = Pad(make_runtime(FakeModel())), Pad(make_runtime(FakeModel()))
    for x_mm in (0, 50):
        without, result = plain.tap(), moved.tap(PadPose(x_mm, 0))
        np.testing.assert_array_equal(result.pattern, without.pattern)
        assert result.pose.x_mm == x_mm and result.poses is None and without.pose is None
    assert result.taps_used == 2 and moved.events == []


def test_a_new_object_forgets_taps_and_keeps_poses():
    pad = Pad(make_runtime(PosedModel()))
    pad.tap(PadPose(1, 0))
    pad.runtime.reset()
    result = pad.tap()
    assert result.taps_used == 1 and result.pose.x_mm == 1


def test_a_model_without_poses_is_run_without():
    model = FakeModel(make_contract())
    pad = Pad(make_runtime(model))
    pad.tap()
    result = pad.tap()
    assert result.poses is None and model.windows[-1].shape == (4, 3, 4, 4) and not model.windows[-1][2:].any()


def make_checked_contract(trust):
    pad_inputs = (("thickness_mm", 4.5, 0.5), ("counts_per_newton", 1000.0, 500.0))
    return make_posed_contract(pad_inputs=pad_inputs, takes_gains=True, traction_scale=2, trust=trust.to_json())


def test_the_check_of_earlier_taps_takes_their_poses_and_a_dropped_tap_is_forgotten():
    pad = Pad(make_runtime(PosedModel(make_checked_contract(make_posed_trust(2.5)))))
    pad.tap(PadPose(4, 0))
    pad.lose_pose()
    pad.tap()  # without a pose, so it is left out below
    pad.tap(PadPose(2, 0))
    result = pad.tap(PadPose(0, 0))
    assert [share >= 0.5 for share in result.tap_mismatch] == [False, True]
    assert result.taps_used == 2 and result.poses[:, 0].tolist() == [0, 2] and len(result.window) == 2
    result = pad.tap(PadPose(4, 0))
    assert result.poses[:, 0].tolist() == [0, -4, -2], "the first tap is forgotten, the others are not"
    assert pad.events == ["tap_without_pose", "tap_dropped"]


def test_a_tap_that_does_not_belong_goes_alone_where_taps_have_poses():
    model = PosedModel(make_checked_contract(make_posed_trust(2.5)))
    pad = Pad(make_runtime(model))
    for x_mm, more in ((1, 0), (4, 100), (2, 200)):
        pad.tap(PadPose(x_mm, 0), PRESS + more)
    pad.place(PadPose(0, 0))
    light = pad.push(0.7 * PRESS)
    again = pad.push(0.7 * PRESS)
    assert light.poses[:, 0].tolist() == [0, 2, 1] and (light.taps_used, light.taps_dropped) == (3, 1)
    assert again.reused_from == light.scan.number and again.taps_dropped == 1
    for result in (light, again):
        np.testing.assert_allclose(model.windows[-1], model.contract.scale_window(result.window), rtol=1e-5)
    assert [window[2].max() for window in light.window] == [0.7 * PRESS, PRESS + 200, PRESS]
    assert "tap_dropped" not in pad.events, "a light press may only have begun"
    pad.push(PRESS)
    settled = pad.push(1.1 * PRESS)
    assert settled.poses[:, 0].tolist() == [0, 2, 1] and settled.taps_dropped == 0
    assert pad.events == ["tap_dropped"]


def test_taps_of_the_schedule_go_with_the_stranger_that_came_after_them():
    # Without poses every tap lies at 0 mm, so that a limit below that drops them all.
    runtime = make_runtime(PosedModel(make_checked_contract(make_posed_trust(-1.0))), options=RuntimeOptions(taps=3))
    pad = Pad(runtime)
    for _ in range(5):
        pad.tap()
    result = pad.push(PRESS)
    assert (result.taps_used, result.taps_dropped, len(result.window)) == (1, 1, 1)
    assert pad.push(PRESS).tap_mismatch is None, "they are forgotten for good"


def test_checks_without_poses_do_not_fit_a_model_that_takes_them():
    metadata = make_checked_contract(make_trust()).to_metadata()
    with pytest.raises(ModelError, match=r"'trust' is damaged \(tap takes 100 features, expected 104\)"):
        Contract.from_metadata(metadata)
    Contract.from_metadata(make_checked_contract(make_posed_trust(1.0)).to_metadata())

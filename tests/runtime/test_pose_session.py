"""Session of a model that takes poses: any number of taps, in any order, each with its pose."""

import json
from itertools import permutations

import numpy as np
import pytest
from edge_samples import write_model
from pose_samples import make_posed_contract, posed_pattern, write_posed_model

from edge.errors import ModelError, WindowError
from edge.inference.contract import KEY_PREFIX, Contract
from edge.inference.familiarity import ERROR_UNITS, MOST_ERROR, PLACE_MM, pair_width, pose_tap_features, tap_features
from edge.inference.onnx_session import MOST_RUNS, ModelSession
from edge.inference.pose_input import pose_rows, scheduled_rows
from firmware_bridge.poses.pad_pose import PadPose


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    return ModelSession(write_posed_model(tmp_path_factory.mktemp("posed") / "posed.onnx"))


def random_taps(taps, seed=0):
    """Return a window and its poses."""
    rng = np.random.default_rng(seed)
    poses = rng.normal(size=(taps, 5)).astype(np.float32)
    poses[0] = 0
    return rng.normal(size=(taps, 3, 4, 4)).astype(np.float32), poses


@pytest.mark.parametrize("taps", range(1, 8))
def test_every_number_of_taps_runs(session, taps):
    window, poses = random_taps(taps)
    np.testing.assert_allclose(session.run(window, poses=poses), posed_pattern(window, poses), atol=1e-5)


def test_the_order_of_earlier_taps_is_free(session):
    window, poses = random_taps(4)
    expected = session.run(window, poses=poses).copy()
    for order in permutations((1, 2, 3)):
        again = [0, *order]
        np.testing.assert_allclose(session.run(window[again], poses=poses[again]), expected, atol=1e-5)
    exchanged = poses[[0, 2, 1, 3]]
    assert np.abs(session.run(window, poses=exchanged) - expected).max() > 0.1, "a tap keeps its own pose"


def test_windows_of_several_lengths_run_together(tmp_path):
    for batch in ("any", 1):
        contract = make_posed_contract(batch=batch, interval_factor=1.6)
        session = ModelSession(write_posed_model(tmp_path / f"{batch}.onnx", contract))
        for lengths in ((4, 1, 7), (1, 3, 2), (4, 7, 1)):  # the last ones are where others lay before
            taps = [random_taps(length, seed) for seed, length in enumerate(lengths)]
            windows, poses = zip(*taps, strict=True)
            together = session.run_together(windows, None, poses).copy()
            deviations = session.deviation.copy()
            for index, (window, rows) in enumerate(taps):
                np.testing.assert_allclose(together[index], posed_pattern(window, rows), atol=1e-5)
                session.run(window, poses=rows)
                np.testing.assert_allclose(deviations[index], session.deviation, atol=1e-6)


def test_without_poses_taps_follow_the_schedule_and_absent_ones_have_none(session):
    window, _ = random_taps(4)
    poses = scheduled_rows(4, 5.0)
    assert poses[:, 2].tolist() == [0, 5, 10, 15]
    np.testing.assert_allclose(poses[1:, 3:], [[0.2, 1.0]] * 3)
    np.testing.assert_array_equal(session.run(window).copy(), session.run(window, poses=poses))
    window[2:] = 0
    poses[2:] = 0
    np.testing.assert_array_equal(session.run(window).copy(), session.run(window, poses=poses))


def test_a_schedule_turns_within_half_a_turn():
    assert scheduled_rows(5, 100.0)[:, 2].tolist() == [0, 100, -160, -60, 40]


def test_poses_become_the_newest_taps_view_with_both_errors():
    newest, earlier = PadPose(10, 5, 90, 0.3, 3), PadPose(10, 7, 85, 0.4, 4)
    rows = pose_rows([newest, earlier])
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
def test_shapes_that_do_not_fit_are_refused_with_both(session, window, poses, match):
    with pytest.raises(WindowError, match=match):
        session.run(np.zeros(window, dtype=np.float32), poses=np.zeros(poses, dtype=np.float32))


def test_poses_that_mean_nothing_are_refused(session):
    window, poses = random_taps(2)
    with pytest.raises(WindowError, match=r"newest tap's pose is \[1.0, .*expected zeros: give poses as that tap sees"):
        session.run(window, poses=poses + 1)
    with pytest.raises(WindowError, match="poses have values that are not finite"):
        session.run(window, poses=np.where(poses == 0, poses, np.float32(np.nan)))
    with pytest.raises(WindowError, match=r"poses are \(2, 5\) float64"):
        session.run(window, poses=poses.astype(float))


def test_a_model_without_poses_refuses_them(tmp_path):
    session = ModelSession(write_model(tmp_path / "tiny.onnx"))
    window, poses = random_taps(4)
    with pytest.raises(WindowError, match="poses are given, but model 'tiny' takes none: leave them out"):
        session.run(window, poses=poses)


def test_arrays_are_kept_for_so_many_shapes_and_no_more(session):
    for count in range(1, 8):
        for taps in range(1, 8):
            windows, poses = zip(*[random_taps(taps, seed) for seed in range(count)], strict=True)
            made = session.run_together(windows, None, poses)
            np.testing.assert_allclose(made[-1], posed_pattern(windows[-1], poses[-1]), atol=1e-5)
    assert len(session._runs) == MOST_RUNS


def test_the_keys_come_back():
    contract = make_posed_contract()
    metadata = contract.to_metadata()
    assert Contract.from_metadata(metadata) == contract
    assert contract.window_shape == ("any", "taps", 3, 4, 4)
    assert contract.input_shapes == {"window": ("any", "taps", 3, 4, 4), "poses": ("any", "taps", 5)}


@pytest.mark.parametrize("reach_mm", [0, -1, None, "10", True])
def test_a_model_that_takes_poses_has_a_reach(reach_mm):
    metadata = make_posed_contract().to_metadata() | {f"{KEY_PREFIX}reach_mm": json.dumps(reach_mm)}
    with pytest.raises(
        ModelError, match=r"'reach_mm' is .*, expected a number from 1e-06 for a model that takes poses"
    ):
        Contract.from_metadata(metadata)


def test_a_graph_without_the_poses_of_its_contract_is_refused(tmp_path):
    metadata = make_posed_contract(taps=4, batch=1).to_metadata()
    with pytest.raises(
        ModelError, match=r"states window .*\[1, 'taps', 3, 4, 4\], poses tensor\(float\) \[1, 'taps', 5\]"
    ):
        ModelSession(write_model(tmp_path / "tiny.onnx", metadata=metadata))


def test_features_of_pairs_hold_the_pose_in_place_of_the_turns():
    window, poses = random_taps(3)
    poses[1:] = [[2.5, -5, 90, 0.5, 10], [0, 0, -30, 100, 1e5]]
    features, before = pose_tap_features(window, poses), tap_features(window)
    assert features.shape == (2, pair_width(48, poses=True)) and before.shape == (2, pair_width(48, poses=False))
    np.testing.assert_array_equal(features[:, :98], before[:, :98])
    np.testing.assert_allclose(features[0, 98:100], [2.5 / PLACE_MM, -5 / PLACE_MM])
    np.testing.assert_allclose(features[:, 100:102], [[0, 1], [np.sqrt(3) / 2, -0.5]], atol=1e-6)
    np.testing.assert_allclose(features[:, 102:], [[0.5, 10] / ERROR_UNITS, [MOST_ERROR] * 2])

"""Export of networks that take poses: any number of taps in one graph."""

import numpy as np
import onnx
import pytest
import torch
from export_samples import POSED_PRESSES, TAPS, made_once, posed_models, some_frames

from edge.inference.bundled import INT8_SUFFIX
from edge.inference.contract import ANY_BATCH
from edge.inference.onnx_session import ModelSession
from export.to_onnx import export
from export.verify import verify
from train.learning.checkpoint import network_of
from train.physics.pad_draws import KNOWN
from train.surfaces.poses import REACH_MM


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return made_once(tmp_path_factory, posed_models)


def windows_and_poses(count=3):
    rng = np.random.default_rng(3)
    windows = [rng.normal(0, 0.5, (taps, 3, 4, 4)).astype(np.float32) for taps in range(1, count + 1)]
    poses = [rng.normal(0, (2, 2, 20, 0, 0), (len(window), 5)).astype(np.float32) for window in windows]
    for one in poses:
        one[:, 3:], one[0] = (0.2, 1.0), 0
    return windows, poses


def test_the_contract_states_poses_and_reach(folder):
    contract = ModelSession(folder / "fused.onnx").contract
    assert (contract.taps, contract.takes_poses, contract.reach_mm) == (TAPS, True, REACH_MM)
    assert contract.window_shape == (ANY_BATCH, "taps", 3, 4, 4)
    assert set(contract.test_error) == {"1", "2", "3", "4"}, "with one to four taps of the paper's schedule"
    assert set(contract.interval_levels) == {"50", "80", "90", "95"} and contract.read_trust() is not None


def test_every_number_of_taps_gives_what_the_network_gives(folder):
    session, net = ModelSession(folder / "fused.onnx"), network_of(onnx.load(folder / "fused.onnx"))
    pad = np.zeros(KNOWN, dtype=np.float32)
    for window, poses in zip(*windows_and_poses(), strict=True):
        with torch.inference_mode():
            expected = net(*(torch.from_numpy(one[None]) for one in (window, pad, poses)))
        assert np.allclose(session.run(window, pad, poses), expected[0][0].numpy(), atol=1e-5)
        assert session.deviation is not None
        assert np.allclose(session.deviation, expected[1][0].numpy(), rtol=2e-3, atol=1e-5)


def test_windows_of_different_numbers_of_taps_run_together(folder):
    session = ModelSession(folder / "fused.onnx")
    windows, poses = (list(reversed(given)) for given in windows_and_poses())
    windows, poses = ([given[0], given[2], *given[1:]] for given in (windows, poses))  # a single tap amid others
    alone = [
        [np.array(made) for made in (session.run(window, poses=pose), session.deviation, session.traction)]
        for window, pose in zip(windows, poses, strict=True)
    ]
    together = session.run_together(windows, poses=poses).copy()
    assert np.allclose(together, [pattern for pattern, *_ in alone], atol=1e-5)
    assert session.deviation is not None and session.traction is not None
    assert np.allclose(session.traction, [traction for *_, traction in alone], atol=1e-3)
    assert np.allclose(session.deviation, [deviation for _, deviation, _ in alone], rtol=2e-3, atol=1e-5)
    assert not np.allclose(alone[0][0], session.run(windows[0][:1]), atol=1e-4), "the earlier tap matters"


@pytest.mark.night
def test_in_integers_it_is_near_the_float(folder, tmp_path):
    export(folder / "fused.pt", tmp_path, some_frames(), calibration=POSED_PRESSES)
    integers, session = ModelSession(tmp_path / f"fused{INT8_SUFFIX}.onnx"), ModelSession(folder / "fused.onnx")
    for window, pose in zip(*windows_and_poses(), strict=True):
        pattern = session.run(window, poses=pose)
        assert np.abs(integers.run(window, poses=pose) - pattern).max() < 0.2 * np.abs(pattern).max()


def test_single_taps_are_verified_too(folder):
    rows = list(verify(folder / "fused.onnx", some_frames()))
    assert {"test set", "one tap"} <= {row.windows for row in rows} and not [row for row in rows if row.broken]


def test_a_single_tap_reads_no_memory_that_nobody_wrote(folder):
    """Without earlier taps products go over nothing, which onnxruntime may leave as the memory was."""
    session = ModelSession(folder / "fused.onnx")
    window = windows_and_poses()[0][0]
    expected = session.run(window).copy()
    assert np.array_equal(session.run(np.concatenate([window, np.zeros_like(window)])), expected), "an absent tap"
    for count in (1, 2, 4, 8):
        for size in range(4, 20):
            for _ in range(50):
                np.full(2**size, np.nan, dtype=np.float32)  # memory that is free again
            assert np.allclose(session.run_together([window] * count), expected, atol=1e-6)

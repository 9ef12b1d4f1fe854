import shutil

import numpy as np
import pytest
from press_samples import make_press_set

from edge.evaluation.classical_methods import fitted_methods
from edge.evaluation.test_set import judge, load_frozen_set
from edge.inference.bundled import BUNDLE_DIR
from firmware_bridge.recording.formats import load_recording
from train.data.world import World, solve_pad
from train.demo import demo_recording
from train.freeze import KINDS, fit_classical, fit_kinds, fit_taxels, freeze, main
from train.surfaces.named_surfaces import SURFACES


@pytest.fixture(scope="module")
def frozen():
    return freeze(SURFACES[:2])


def test_the_frozen_set_is_made_as_the_bundled_one(frozen):
    """Its first figures have outlines of an earlier release, and draws depend on how many sequences there are."""
    bundled = load_frozen_set(BUNDLE_DIR / "frozen.npz")
    taps, frames = len(frozen.surface), len(frozen)
    assert frozen.surface.tolist() == bundled.surface[:taps].tolist() == ["C"] * 4 + ["F"] * 4
    np.testing.assert_allclose(frozen.angle_deg, bundled.angle_deg[:taps], rtol=1e-6)
    np.testing.assert_allclose(frozen.force_n, bundled.force_n[:frames], rtol=1e-3)
    np.testing.assert_allclose(frozen.indentation_mm, bundled.indentation_mm[:frames], rtol=1e-3)
    assert np.corrcoef(frozen.newest.ravel(), bundled.newest[:frames].ravel())[0, 1] > 0.998
    assert np.abs(frozen.unit_patterns - bundled.unit_patterns[:taps].astype(np.float32)).mean() < 0.01
    assert (frozen.touched != bundled.touched[:taps]).mean() < 0.015
    for ours, theirs in zip(frozen.earlier.reshape(-1, 48), bundled.earlier[:taps].reshape(-1, 48), strict=True):
        assert np.corrcoef(ours, theirs)[0, 1] > 0.998, "each tap is turned back one more step"


def test_classical_methods_beat_nothing_and_are_in_order(frozen, presses, tmp_path):
    np.savez(tmp_path / "classical.npz", allow_pickle=False, **fit_classical(presses, windows=2000))
    methods = fitted_methods(tmp_path / "classical.npz", frozen.scale)
    newest = frozen.newest.astype(np.float32)
    psnr = {name: judge(method(newest), frozen, 0.5)["psnr_db"].mean() for name, method in methods.items()}
    nothing = judge(np.zeros_like(frozen.patterns()), frozen, 0.5)["psnr_db"].mean()
    assert set(psnr) == {"bilinear", "bicubic", "linear map"}
    assert nothing < psnr["bilinear"] < psnr["linear map"]


def test_the_demo_is_made_as_the_bundled_one(tmp_path):
    """But for rounding, in which processors differ: tests of the program hold what the bundled one shows."""
    made, bundled = demo_recording(), dict(np.load(BUNDLE_DIR / "demo.npz"))
    assert set(made) == set(bundled)
    for name, array in bundled.items():
        if array.dtype.kind in "Ub":
            assert np.array_equal(made[name], array), name
        else:
            apart = np.abs(made[name].astype(float) - array)
            assert apart.mean() < 1e-3 or apart.max() <= 1, name
    np.savez(tmp_path / "demo.npz", allow_pickle=False, **made)
    assert load_recording(tmp_path / "demo.npz").poses


@pytest.mark.night
def test_the_command_keeps_a_frozen_set_that_is_there(tmp_path):
    with pytest.raises(SystemExit, match=r"^freeze: .*no such file"):
        main([str(tmp_path), "--data", str(tmp_path / "absent.npz")])
    shutil.copy(BUNDLE_DIR / "frozen.npz", tmp_path)
    make_press_set(600).save(tmp_path / "seen.npz")
    before = (tmp_path / "frozen.npz").stat()
    main([str(tmp_path), "--data", str(tmp_path / "seen.npz")])
    names = [f"{name}.npz" for name in ("classical", "demo", "frozen", "grip", "seen", "taxels")]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    assert (tmp_path / "frozen.npz").stat() == before


def test_kinds_of_contact_are_separated_at_any_scale():
    rng = np.random.default_rng(0)
    shapes = rng.uniform(100, 1000, (2, 48)) * [[1], [0.2]]
    shapes[1, :40] = 0
    readings = np.concatenate([np.outer(rng.uniform(0.5, 5, 300), shape) for shape in shapes])
    noisy = (readings + rng.normal(0, 2, readings.shape)).astype(np.float32)
    found = fit_kinds(noisy.reshape(-1, 3, 4, 4), kinds=2)
    angles = [
        [shape @ covariance @ shape / (shape @ shape * np.trace(covariance)) for shape in shapes]
        for covariance in found
    ]
    np.testing.assert_allclose(sorted(angles, reverse=True), np.eye(2), atol=0.15)


@pytest.fixture(scope="module")
def presses():
    figures = dict.fromkeys(SURFACES[:2], 1.0)
    return solve_pad(World(count=64, per_pad=64, families=figures, spread=0.0, seed=9), 0)


def test_taxels_covary_as_their_readings_do(presses):
    covariances = fit_taxels(presses, windows=400)["covariances"]
    assert covariances.shape == (KINDS, 48, 48) and covariances.dtype == np.float32
    np.testing.assert_allclose(covariances, covariances.transpose(0, 2, 1), rtol=1e-4, atol=1e-6)
    # The press is mostly in z, since some are dragged, and of one strength in all of them.
    traces = np.trace(covariances, axis1=1, axis2=2)
    np.testing.assert_allclose(traces, 48, rtol=0.01)
    in_z = np.trace(covariances[:, 32:, 32:], axis1=1, axis2=2) / traces
    assert in_z.min() > 0.38 and in_z.mean() > 0.6
    np.testing.assert_array_equal(covariances, fit_taxels(presses, windows=400)["covariances"])

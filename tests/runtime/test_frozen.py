"""The frozen test set, and the files that come with the package."""

from dataclasses import replace

import numpy as np
import pytest
from edge_samples import write_model

from edge.errors import ModelError, UsageError
from edge.evaluation.test_set import FrozenSet, FrozenSetError, load_frozen_set
from edge.inference import bundled


@pytest.fixture
def small():
    rng = np.random.default_rng(0)
    return FrozenSet(
        newest=rng.integers(-50, 50, (6, 3, 4, 4)).astype(np.int16),
        earlier=rng.integers(-50, 50, (2, 3, 3, 4, 4)).astype(np.int16),
        tap=np.array([0, 0, 0, 1, 1, 1], dtype=np.int16),
        indentation_mm=np.linspace(0.1, 0.6, 6).astype(np.float32),
        force_n=np.linspace(1, 6, 6).astype(np.float32),
        unit_patterns=np.stack([np.eye(40), np.full((40, 40), 0.5)]).astype(np.float16),
        touched=np.stack([np.eye(40) > 0, np.zeros((40, 40), dtype=bool)]),
        surface=np.array(["C", "F"]),
        angle_deg=np.array([0, 30], dtype=np.float32),
        full_scale_mm=0.5,
    )


class TestSet:
    def test_windows_are_newest_first_and_absent_taps_are_zero(self, small):
        windows = small.windows(4)
        assert windows.shape == (6, 4, 3, 4, 4)
        assert (windows[4, 0] == small.newest[4]).all() and (windows[4, 2] == small.earlier[1, 1]).all()
        given_two = small.windows(4, given=2)
        assert (given_two[:, :2] == windows[:, :2]).all() and not given_two[:, 2:].any()
        assert small.windows(1).shape == (6, 1, 3, 4, 4)
        for taps in (0, 8):
            with pytest.raises(FrozenSetError, match=f"windows of {taps} taps asked for, the frozen test set has"):
                small.windows(taps)

    def test_truth_is_the_unit_pattern_times_the_indentation(self, small):
        assert np.allclose(small.patterns()[5], 0.5 * 0.6)
        assert np.allclose(small.patterns()[1].diagonal(), small.indentation_mm[1])
        assert small.touching()[0].sum() == 40 and not small.touching()[5].any() and small.scale == 10

    def test_a_file_gives_back_the_set_and_a_bad_one_replaces_none(self, small, tmp_path):
        path = tmp_path / "set.npz"
        small.save(path)
        with pytest.raises(FrozenSetError):
            replace(small, full_scale_mm=0.0).save(path)
        assert load_frozen_set(path).sha256() == small.sha256() and list(tmp_path.iterdir()) == [path]
        for change in ({"indentation_mm": small.indentation_mm + np.float32(1e-6)}, {"surface": np.array(["C", "G"])}):
            assert replace(small, **change).sha256() != small.sha256(), "the hash sees every array"
        with pytest.raises(FrozenSetError, match="No such file"):
            load_frozen_set(tmp_path / "none.npz")
        np.savez(path, newest=small.newest)
        with pytest.raises(FrozenSetError, match="earlier"):
            load_frozen_set(path)

    def test_the_bundled_one_is_the_one_that_is_frozen(self):
        frozen = load_frozen_set(bundled.BUNDLE_DIR / "frozen.npz")
        assert len(frozen) == 1152 and len(set(frozen.surface.tolist())) == 18
        assert float(frozen.patterns().max()) <= frozen.full_scale_mm


@pytest.fixture
def models(bundle, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("mtsr4", "stsr"):
        write_model(bundle / f"{name}.onnx")
    return bundle


class TestBundle:
    @pytest.mark.parametrize("name", ["mtsr4", "mtsr4.onnx", "{models}/mtsr4.onnx", "{models}/mtsr4"])
    def test_a_name_without_precision_is_the_best_file_there_is(self, models, name):
        write_model(models / "mtsr4-int8.onnx")
        asked = name.format(models=models)
        assert bundled.find_model(asked) == models / "mtsr4.onnx"
        (models / "mtsr4.onnx").unlink()
        assert bundled.find_model(asked) == models / "mtsr4-int8.onnx"
        assert [path.stem for path in bundled.bundled_models()] == ["mtsr4-int8", "stsr"]

    def test_a_file_wins_over_a_bundled_name_and_no_directory_does(self, models, tmp_path):
        (tmp_path / "mtsr4").mkdir()
        (tmp_path / "stsr").write_text("mine")
        assert bundled.find_model("mtsr4") == models / "mtsr4.onnx" and bundled.find_model("stsr").read_text() == "mine"

    def test_what_is_missing_is_told(self, models):
        for name in ("mtsr9", "mtsr4.onn", "", "none/mtsr4.onnx"):
            with pytest.raises(ModelError, match=r"no model.*bundled: mtsr4.onnx, stsr.onnx"):
                bundled.find_model(name)
        with pytest.raises(UsageError, match=r"demo.npz is missing"):
            bundled.demo_recording()

import pytest
from edge_samples import write_model

from edge.errors import ModelError, UsageError
from edge.inference import bundled as bundle


@pytest.fixture
def models(tmp_path, monkeypatch):
    monkeypatch.setattr(bundle, "BUNDLE_DIR", tmp_path / "bundled")
    bundle.BUNDLE_DIR.mkdir()
    for name in ("mtsr4", "stsr"):
        write_model(bundle.BUNDLE_DIR / f"{name}.onnx")
    return bundle.BUNDLE_DIR


def test_bundled_models_are_found_with_and_without_ending(models):
    assert bundle.find_model("mtsr4") == bundle.find_model("mtsr4.onnx") == models / "mtsr4.onnx"
    assert [path.stem for path in bundle.bundled_models()] == ["mtsr4", "stsr"]


@pytest.mark.parametrize("name", ["mtsr4", "mtsr4.onnx", "{models}/mtsr4.onnx", "{models}/mtsr4"])
def test_a_name_without_precision_is_the_best_file_there_is(models, name):
    write_model(models / "mtsr4-int8.onnx")
    asked = name.format(models=models)
    assert bundle.find_model(asked) == models / "mtsr4.onnx"
    (models / "mtsr4.onnx").unlink()
    assert bundle.find_model(asked) == models / "mtsr4-int8.onnx"


def test_a_file_wins_over_a_bundled_name(models, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mtsr4").write_text("mine")
    assert bundle.find_model("mtsr4").read_text() == "mine"


def test_a_directory_is_no_model_file(models, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mtsr4").mkdir()
    assert bundle.find_model("mtsr4") == models / "mtsr4.onnx"


@pytest.mark.parametrize("name", ["mtsr", "mtsr4.onn", "", "none/mtsr4.onnx"])
def test_no_such_model_lists_the_bundled_ones(models, name):
    with pytest.raises(ModelError, match=r"no model.*bundled: mtsr4.onnx, stsr.onnx"):
        bundle.find_model(name)


def test_the_demo_recording_is_found_or_missed_clearly(models):
    with pytest.raises(UsageError, match=r"demo.npz is missing"):
        bundle.demo_recording()
    (models / "demo.npz").write_bytes(b"")
    assert bundle.demo_recording() == models / "demo.npz"

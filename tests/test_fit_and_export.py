import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import onnx
import pytest
import torch

from edge.bundle import BUNDLE_DIR
from edge.frozen import load_frozen_set
from edge.session import ModelSession
from export.errors import CheckpointError, ParityError
from export.to_onnx import check_parity, export, extreme_windows, load_checkpoint, main, to_model
from firmware_bridge.geometry import USPA44
from train.compact_net import CompactNet
from train.fit import Stage, TrainingConfig, fit

TINY = TrainingConfig(
    sequences=64,
    batch=16,
    channels=8,
    blocks=1,
    base=Stage(2, 4, 1e-3, (0.5, 0.5)),
    stages=(Stage(2, 2, 1e-3, (0.5, 0.5)), Stage(1, 2, 1e-3, (1.0,))),
)


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory):
    folder = tmp_path_factory.mktemp("checkpoints")
    fit(TINY, folder)
    return folder


@pytest.fixture(scope="module")
def frozen():
    return load_frozen_set(BUNDLE_DIR / "frozen.npz")


def test_a_run_is_repeatable_and_its_configuration_lies_beside_the_weights(checkpoints, tmp_path):
    fit(TINY, tmp_path)
    for name in ("stsr", "mtsr2"):
        first = torch.load(checkpoints / f"{name}.pt", weights_only=True)
        second = torch.load(tmp_path / f"{name}.pt", weights_only=True)
        assert all(torch.equal(first[key], second[key]) for key in first)
        report = json.loads((checkpoints / f"{name}.json").read_text())
        assert report["training_sha256"] == TINY.sha256()
        assert report["config"]["seed"] == TINY.seed
        assert 0 < report["contact_level"] < 1
        assert np.isfinite(report["validation_psnr_db"])


def test_every_setting_changes_the_hash():
    changes = [{"seed": 2}, {"sequences": 65}, {"nuisances": replace(TINY.nuisances, noise_counts=3.0)}]
    changes.append({"layer": replace(TINY.layer, poisson=0.48)})
    changes.append({"stages": TINY.stages[:1]})
    changes.append({"base": replace(TINY.base, steps=5)})
    assert len({replace(TINY, **change).sha256() for change in changes} | {TINY.sha256()}) == 7


def test_training_lowers_the_error(tmp_path):
    def error(steps):
        fit(
            replace(TINY, channels=16, base=Stage(1, steps, 3e-3, (1.0,)), stages=(Stage(1, 1, 1e-4, (1.0,)),)),
            tmp_path,
        )
        return json.loads((tmp_path / "stsr.json").read_text())["validation_psnr_db"]

    assert error(60) > error(1) + 3


def test_an_exported_model_is_one_file_that_keeps_its_contract(checkpoints, frozen, tmp_path):
    line = export(checkpoints / "mtsr2.pt", tmp_path, frozen)
    assert [path.name for path in tmp_path.iterdir()] == ["mtsr2.onnx"]
    assert "dB" in line
    session = ModelSession(tmp_path / "mtsr2.onnx")
    contract = session.contract
    assert (contract.taps, contract.scale, contract.sensor) == (2, 10, "uSPa44")
    assert contract.training_sha256 == TINY.sha256()
    assert contract.test_set_sha256 == frozen.sha256()
    assert set(contract.test_error) == {"1", "2"}
    assert contract.window_shape == (1, 6, 4, 4)
    net, _ = load_checkpoint(checkpoints / "mtsr2.pt")
    window = contract.scale_window(frozen.windows(2)[100])
    with torch.inference_mode():
        expected = net(torch.from_numpy(window).reshape(1, 6, 4, 4))[0].numpy()
    assert np.allclose(session.run(window), expected, atol=1e-6)


def test_exporting_again_gives_the_same_bytes_without_traces_of_the_machine(checkpoints, frozen, tmp_path):
    export(checkpoints / "stsr.pt", tmp_path, frozen)
    first = (tmp_path / "stsr.onnx").read_bytes()
    export(checkpoints / "stsr.pt", tmp_path, frozen)
    assert (tmp_path / "stsr.onnx").read_bytes() == first
    assert b".py" not in first
    assert not any(init.external_data for init in onnx.load_from_string(first).graph.initializer)


def test_a_graph_that_computes_something_else_is_not_written(checkpoints, frozen, tmp_path, monkeypatch):
    other = CompactNet(1, 10, 8, 1).eval()
    monkeypatch.setattr("export.to_onnx.to_model", lambda _net, geometry: to_model(other, geometry))
    with pytest.raises(ParityError, match="differ by"):
        export(checkpoints / "stsr.pt", tmp_path, frozen)
    assert not list(tmp_path.iterdir())


def test_parity_holds_on_extreme_windows(checkpoints):
    import onnxruntime

    net, _ = load_checkpoint(checkpoints / "mtsr2.pt")
    session = onnxruntime.InferenceSession(to_model(net, USPA44).SerializeToString())
    assert check_parity(net, session, extreme_windows(2, USPA44), 0.5) < 1e-5


def test_what_is_no_checkpoint_is_refused(checkpoints, tmp_path):
    with pytest.raises(CheckpointError, match="No such file"):
        load_checkpoint(tmp_path / "none.pt")
    (tmp_path / "broken.json").write_text((checkpoints / "stsr.json").read_text())
    (tmp_path / "broken.pt").write_bytes((checkpoints / "mtsr2.pt").read_bytes())
    with pytest.raises(CheckpointError, match="size mismatch"):
        load_checkpoint(tmp_path / "broken.pt")
    with pytest.raises(SystemExit, match=r"export: .*none\.pt"):
        main([str(tmp_path / "none.pt"), "--out", str(tmp_path)])


def test_the_commands_run_as_the_readme_says():
    for module in ("train.fit", "train.freeze", "export.to_onnx"):
        done = subprocess.run([sys.executable, "-m", module, "--help"], capture_output=True, text=True, check=True)
        assert module in done.stdout

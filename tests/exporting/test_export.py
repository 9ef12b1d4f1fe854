import json
from dataclasses import replace

import numpy as np
import onnx
import pytest
import torch
from dataset_samples import make_sequences
from onnx import numpy_helper

from edge.errors import ModelError
from edge.evaluation.evaluate import judge, judge_model, mean_error
from edge.evaluation.test_set import FrozenSet
from edge.inference.contract import ANY_BATCH, CONTRACT_VERSION, Contract
from edge.inference.onnx_session import ModelSession
from export import to_onnx
from export.errors import ExportError, ParityError
from export.graphs.graph import to_model
from export.graphs.parity import GraphRun, differences, read_windows
from export.to_onnx import export, main
from firmware_bridge.pad_geometry import USPA44
from train.errors import CheckpointError
from train.freeze import freeze
from train.learning.checkpoint import Training, fit_network, infer, load_network
from train.learning.interval_calibration import half_width_mm, interval_coverage
from train.learning.training_loop import Recipe
from train.networks.registry import build
from train.physics.sensor_noise import Nuisances

COMPACT = Training(
    "sure", "compact-mtsr2", Recipe(steps=2, batch=4, given=(0.5, 0.5)), options={"channels": 16, "blocks": 1}
)


def frozen_at(scale: int, taps: int = 4) -> FrozenSet:
    """Six presses, not those of the training."""
    return freeze(make_sequences(taps=taps, seed=1), Nuisances.none(), seed=1, scale=scale)


def at_frames(frozen: FrozenSet, frames) -> FrozenSet:
    """Some of its frames."""
    names = ("newest", "tap", "indentation_mm", "force_n")
    return replace(frozen, **{name: getattr(frozen, name)[frames] for name in names})


@pytest.fixture(scope="module")
def frozen():
    return frozen_at(10)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A compact network at the test set's scale, as training leaves it, and what was exported of it."""
    folder = tmp_path_factory.mktemp("checkpoints")
    fit_network(COMPACT, make_sequences(taps=2), frozen_at(10), folder)
    export(folder / "sure.pt", folder, frozen_at(10))
    return folder


@pytest.fixture(scope="module")
def batched(folder, frozen, tmp_path_factory):
    """Folders of the same network, exported for 3 windows in one run and for any number."""
    folders = {}
    for batch in (3, ANY_BATCH):
        folders[batch] = tmp_path_factory.mktemp("batched")
        export(folder / "sure.pt", folders[batch], frozen, batch=batch)
    return folders


@pytest.fixture
def traced(folder, monkeypatch):
    """The exported graph in place of one that is traced again, which takes seconds."""

    def to_model(net, geometry, batch=1):
        model = onnx.load(folder / "sure.onnx")
        del model.metadata_props[:]
        return model

    monkeypatch.setattr(to_onnx, "to_model", to_model)


@pytest.fixture(scope="module")
def session(folder):
    return ModelSession(folder / "sure.onnx")


def save_untrained(path, name, scale, **options):
    """A checkpoint of first weights, which is enough to be exported."""
    torch.manual_seed(0)
    net = build(name, scale, **options)
    torch.save(net.state_dict(), path)
    report = {"network": name, "scale": scale, "options": options, "contact_level": 0.5, "training_sha256": "ab" * 32}
    path.with_suffix(".json").write_text(json.dumps(report))
    return path


def test_an_exported_network_keeps_its_contract(folder, session, frozen):
    contract, report = session.contract, json.loads((folder / "sure.json").read_text())
    assert (contract.version, contract.taps, contract.scale, contract.sensor) == (CONTRACT_VERSION, 2, 10, "uSPa44")
    assert (contract.counts_per_unit, contract.angle_step_deg) == ((500.0, 500.0, 1000.0), 5.0)
    assert contract.training_sha256 == report["training_sha256"] == COMPACT.sha256(report["data_sha256"])
    assert contract.contact_level == report["contact_level"]
    assert contract.test_set_sha256 == frozen.sha256() and contract.output_full_scale == frozen.full_scale_mm


def test_the_runtime_computes_what_was_trained_both_outputs(folder, session, frozen):
    net, _ = load_network(folder / "sure.pt")
    windows = frozen.windows(2)
    patterns, deviations = infer(net, windows)
    assert deviations is not None and net.deviation_scale != 1
    for window, pattern, deviation in list(zip(windows, patterns, deviations, strict=True))[::10]:
        np.testing.assert_allclose(session.run(session.contract.scale_window(window)), pattern, atol=1e-6)
        np.testing.assert_allclose(session.deviation, deviation, rtol=1e-5)


def test_the_contract_tells_error_and_coverage_for_every_number_of_taps(folder, session, frozen):
    told = session.contract.test_error
    net, _ = load_network(folder / "sure.pt")
    for given in (1, 2):
        patterns, deviations = infer(net, frozen.windows(2, given))
        measured = judge(patterns, frozen, session.contract.contact_level, half_width_mm(deviations))
        assert told[str(given)] == pytest.approx(mean_error(measured), abs=2e-4)
        covered = interval_coverage(frozen.patterns(), patterns, deviations)
        assert told[str(given)]["coverage_90"] == pytest.approx(covered, abs=2e-4)
    assert set(told) == {"1", "2"} and told["1"] != told["2"]
    assert 0 < told["2"]["coverage_90"] < 1


def test_deviations_are_judged_in_the_same_runs_as_patterns(session, frozen):
    class Counted:
        name, contract, runs = session.name, session.contract, 0

        def run(self, window):
            self.runs += 1
            return session.run(window)

        deviation = property(lambda self: session.deviation)

    counted = Counted()
    errors = judge_model(counted, frozen)
    assert counted.runs == len(frozen) == len(errors["coverage_90"])
    assert len(set(errors["coverage_90"].tolist())) > 1, "every frame has its own deviations"


def test_exporting_again_gives_the_same_bytes_without_traces_of_the_machine(folder, frozen, tmp_path):
    line = export(folder / "sure.pt", tmp_path, frozen)
    assert [path.name for path in tmp_path.iterdir()] == ["sure.onnx"]
    assert line.startswith("sure.onnx: 0.") and "dB" in line and "interval covers" in line
    content = (tmp_path / "sure.onnx").read_bytes()
    assert content == (folder / "sure.onnx").read_bytes()
    assert b".py" not in content and b"/tmp" not in content
    assert not any(init.external_data for init in onnx.load_from_string(content).graph.initializer)


def test_a_model_is_replaced_by_one_that_loads_and_stays_as_bak(folder, frozen, tmp_path, traced, monkeypatch):
    path = tmp_path / "sure.onnx"
    path.write_bytes(b"the one before")
    refused = ModelError("it does not load")
    with monkeypatch.context() as unloadable, pytest.raises(ModelError, match="it does not load"):
        unloadable.setattr("export.graphs.writing.load_session", lambda draft: (_ for _ in ()).throw(refused))
        export(folder / "sure.pt", tmp_path, frozen)
    assert path.read_bytes() == b"the one before" and [one.name for one in tmp_path.iterdir()] == ["sure.onnx"]
    export(folder / "sure.pt", tmp_path, frozen)
    assert path.read_bytes() == (folder / "sure.onnx").read_bytes()
    assert (tmp_path / "sure.onnx.bak").read_bytes() == b"the one before"


def test_a_seed_size_network_of_another_scale_has_one_output_and_is_not_judged(frozen, tmp_path):
    path = save_untrained(tmp_path / "peer.pt", "stsr", 4)
    line = export(path, tmp_path, at_frames(frozen, slice(0, 96, 30)))
    assert "x4, not evaluated, the test set is of x10, parity" in line
    session = ModelSession(tmp_path / "peer.onnx")
    assert session.contract.pattern_shape == (16, 16) and session.contract.interval_factor is None
    assert session.contract.test_error == {}
    window = session.contract.scale_window(frozen.windows(1)[40])
    with torch.inference_mode():
        expected = load_network(path)[0](torch.from_numpy(window).reshape(1, 3, 4, 4))[0]
    assert expected.max() > 0
    np.testing.assert_allclose(session.run(window), expected, rtol=1e-4, atol=1e-6)
    assert session.deviation is None


@pytest.mark.parametrize("head", ["leave", "uncertainty", "traction"])
def test_a_graph_that_computes_something_else_is_not_written(folder, frozen, tmp_path, monkeypatch, head):
    model = onnx.load(folder / "sure.onnx")
    factor = 1.2 if head == "uncertainty" else 1.001  # regions move deviations by more than additions do
    for weight in model.graph.initializer:
        if weight.name.startswith(head) and weight.name.endswith(".bias"):
            weight.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(weight) * np.float32(factor), weight.name))
    monkeypatch.setattr(to_onnx, "to_model", lambda net, geometry, batch=1: model)
    output = {"leave": "pattern", "uncertainty": "deviation", "traction": "traction"}[head]
    with pytest.raises(ParityError, match=f"differ by .* in the {output}"):
        export(folder / "sure.pt", tmp_path, frozen)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("batch", [3, ANY_BATCH])
def test_a_batch_is_one_run_of_many_windows(folder, frozen, batched, batch):
    model = onnx.load(batched[batch] / "sure.onnx")
    contract = Contract.from_metadata({entry.key: entry.value for entry in model.metadata_props})
    assert contract.batch == batch and contract.window_shape == (batch, 6, 4, 4)
    windows = read_windows(frozen, contract)[:7]
    single = GraphRun(onnx.load(folder / "sure.onnx"))
    for together, alone in zip(GraphRun(model)(windows), single(windows), strict=True):
        np.testing.assert_allclose(together, alone, rtol=1e-5, atol=1e-7)


def test_the_runtime_takes_any_batch_and_refuses_another_than_one(folder, frozen, batched, tmp_path):
    session, contract = ModelSession(batched[ANY_BATCH] / "sure.onnx"), ModelSession(folder / "sure.onnx").contract
    windows = [contract.scale_window(window) for window in frozen.windows(2)[:3]]
    together = session.run_together(windows).copy()
    np.testing.assert_allclose(together, [session.run(window).copy() for window in windows], rtol=1e-5, atol=1e-7)
    with pytest.raises(ModelError, match=r"'batch' is 3, .* export it with --batch any"):
        ModelSession(batched[3] / "sure.onnx")
    with pytest.raises(ExportError, match="a batch of 0 asked for"):
        export(folder / "sure.pt", tmp_path, frozen, batch=0)


@pytest.mark.parametrize("taps", [1, 7])  # of two it is exported above, and in between no code is another
@pytest.mark.parametrize("kind", ["", "compact-"])
def test_networks_of_both_families_are_exported(tmp_path, taps, kind):
    name = f"{kind}mtsr{taps}" if taps > 1 else f"{kind}stsr"
    options = {"channels": 16, "blocks": 1} if kind else {}
    seven = at_frames(freeze(make_sequences(taps=7, seed=1), Nuisances.none(), seed=1, scale=10), slice(0, 96, 30))
    export(save_untrained(tmp_path / "one.pt", name, 4, **options), tmp_path, seven)
    assert ModelSession(tmp_path / "one.onnx").contract.taps == taps


@pytest.mark.parametrize("scale", [4, 6, 8, 20])  # 10 is that of every other test
def test_every_scale_is_exported(frozen, tmp_path, scale):
    path = save_untrained(tmp_path / "one.pt", "compact-mtsr2", scale, channels=16, blocks=1)
    assert f"x{scale}" in export(path, tmp_path, frozen)
    assert ModelSession(tmp_path / "one.onnx").contract.pattern_shape == (4 * scale, 4 * scale)


def test_batch_normalisation_is_folded_into_the_convolutions(frozen, tmp_path):
    net = build("mtsr2", 4).eval()
    for module in net.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            torch.nn.init.uniform_(module.running_mean, -1, 1)
            torch.nn.init.uniform_(module.running_var, 0.5, 2)
    model = to_model(net, USPA44)
    assert "BatchNormalization" not in {node.op_type for node in model.graph.node}
    windows = np.random.default_rng(0).normal(size=(3, 6, 4, 4)).astype(np.float32)
    run = GraphRun(model)
    with torch.inference_mode():
        expected = net(torch.from_numpy(windows)).numpy()
    (found,) = differences(run.outputs, [expected], run(windows), 0.5)
    assert found.relative < 1e-5


def test_what_is_no_checkpoint_is_refused(folder, frozen, tmp_path):
    with pytest.raises(CheckpointError, match="No such file"):
        export(tmp_path / "none.pt", tmp_path, frozen)
    report = json.loads((folder / "sure.json").read_text())
    del report["contact_level"]
    (tmp_path / "old.pt").write_bytes((folder / "sure.pt").read_bytes())
    (tmp_path / "old.json").write_text(json.dumps(report))
    with pytest.raises(CheckpointError, match=r"no 'contact_level'"):
        export(tmp_path / "old.pt", tmp_path, frozen)
    assert not list(tmp_path.glob("*.onnx"))


def test_the_command_ends_in_one_line(frozen, tmp_path, monkeypatch):
    frozen.save(tmp_path / "frozen.npz")
    monkeypatch.setattr(to_onnx, "BUNDLE_DIR", tmp_path)
    with pytest.raises(SystemExit, match=r"^export: .*none\.pt"):
        main([str(tmp_path / "none.pt"), "--out", str(tmp_path)])


def test_the_command_writes_integers_and_says_what_they_cost(frozen, tmp_path, monkeypatch, capsys):
    frozen.save(tmp_path / "frozen.npz")
    make_sequences(count=40).save(tmp_path / "taps.npz")
    monkeypatch.setattr(to_onnx, "BUNDLE_DIR", tmp_path)
    monkeypatch.setattr(to_onnx, "held_out", lambda split: make_sequences(count=6, seed=2))
    monkeypatch.setattr(to_onnx, "MOST_LOSS_DB", -100.0)
    path = save_untrained(tmp_path / "one.pt", "compact-mtsr2", 10, channels=16, blocks=1)
    with pytest.raises(
        SystemExit, match=r"^export: quantisation costs too much in one-int8\.onnx .*: use the float32 model"
    ):
        main([str(path), "--out", str(tmp_path), "--int8", str(tmp_path / "taps.npz")])
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith("one-int8.onnx") and "convolutions in int8" in line
    assert ModelSession(tmp_path / "one-int8.onnx").contract.arithmetic == "int8"


@pytest.mark.parametrize("option", [["--all-integers"], ["--trust", "x"], ["--intervals", "x"]])
def test_options_that_do_not_fit_are_a_usage_error(option):
    with pytest.raises(SystemExit) as end:
        main(["one.pt", *option])
    assert end.value.code == 2


def test_a_folder_that_is_a_file_ends_in_one_line(tmp_path):
    (tmp_path / "taken").write_text("")
    with pytest.raises(SystemExit, match=r"^export: .*taken: File exists"):
        main(["one.pt", "--out", str(tmp_path / "taken")])


def test_the_command_is_as_written(capsys):
    with pytest.raises(SystemExit) as end:
        main(["--help"])
    assert end.value.code == 0 and "python -m export.to_onnx" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("psnr_db", "coverage", "said"),
    [
        (34.95, 0.9, []),
        (34.8, 0.9, [f"more than {to_onnx.MOST_LOSS_DB} dB"]),
        (34.95, 0.84, ["an interval changed by more than 2%"]),
    ],
)
def test_what_integers_cost_too_much_is_said(psnr_db, coverage, said):
    in_float = {"psnr_db": 35.0, "coverage_90": 0.9}
    facts = to_onnx._cost(in_float, {"psnr_db": psnr_db, "coverage_90": coverage})
    assert facts[0] == f"{35 - psnr_db:.3f} dB lost to quantisation" and facts[1:] == said

"""Export of networks that take no poses: contract, parity, intervals, files, and the command."""

import json

import numpy as np
import onnx
import pytest
import torch
from export_samples import (
    PRESSES,
    SURE,
    export_with_intervals,
    made_once,
    published_model,
    save_checkpoint,
    small_models,
    some_frames,
)
from onnx import numpy_helper

from edge.errors import ModelError
from edge.evaluation.test_set import infer_with_intervals, judge, mean_error
from edge.inference.contract import ANY_BATCH, CONTRACT_VERSION
from edge.inference.intervals import regions
from edge.inference.onnx_session import ModelSession
from export import to_onnx
from export.errors import ParityError
from export.parity import GraphRun, differences, read_windows
from export.to_onnx import export, main
from train.errors import CheckpointError
from train.learning.checkpoint import infer, load_network, network_of, origin_of
from train.learning.interval_fit import half_width_mm, interval_coverage, readings_of_presses
from train.networks.compact import CompactNet
from train.networks.registry import build


@pytest.fixture(scope="module")
def frozen():
    return some_frames()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return made_once(tmp_path_factory, small_models)


@pytest.fixture(scope="module")
def session(folder):
    return ModelSession(folder / "plain" / "sure.onnx")


@pytest.fixture
def traced(folder, monkeypatch):
    """The exported graph in place of one that is traced again, which takes seconds."""

    def to_model(net, pad):
        model = onnx.load(folder / "plain" / "sure.onnx")
        del model.metadata_props[:]
        return model

    monkeypatch.setattr(to_onnx, "to_model", to_model)


def test_an_exported_network_keeps_its_contract(folder, session, frozen):
    contract, report = session.contract, json.loads((folder / "sure.json").read_text())
    assert (contract.version, contract.taps, contract.scale, contract.sensor) == (CONTRACT_VERSION, 2, 10, "uSPa44")
    assert (contract.counts_per_unit, contract.angle_step_deg) == ((500.0, 500.0, 1000.0), 5.0)
    assert contract.training_sha256 == report["training_sha256"] == SURE.sha256(report["data_sha256"])
    assert contract.contact_level == report["contact_level"] and contract.interval_levels == {}
    assert contract.test_set_sha256 == frozen.sha256() and contract.output_full_scale == frozen.full_scale_mm


def test_the_runtime_computes_what_was_trained_both_outputs(folder, session, frozen):
    net, _ = load_network(folder / "sure.pt")
    windows = frozen.windows(2)
    patterns, deviations = infer(net, windows)
    assert deviations is not None and net.deviation_scale != 1 and patterns.max() > 0
    for window, pattern, deviation in list(zip(windows, patterns, deviations, strict=True))[::5]:
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


@pytest.mark.parametrize("name", ["sure", pytest.param("sure-int8", marks=pytest.mark.night)])
def test_intervals_hold_on_the_presses_that_set_them(folder, name, tmp_path):
    if name != "sure":
        export_with_intervals(folder / "sure.pt", tmp_path, PRESSES)
    session = ModelSession((folder if name == "sure" else tmp_path) / f"{name}.onnx")
    for given in (1, 2):
        assert_intervals_hold(session, given)
    levels = session.contract.interval_levels
    assert list(levels) == ["50", "80", "90", "95"]
    assert all(low <= high for low, high in zip(levels["50"], levels["95"], strict=True))


def assert_intervals_hold(session, given):
    held: dict[int, list[bool]] = {}
    for one in readings_of_presses(PRESSES, 2):
        for window, pad, truth in zip(one.with_taps(given), one.pads, one.truth, strict=True):
            pattern = session.run(window.reshape(2, 3, 4, 4), pad)
            region = regions(pattern[None], session.contract.contact_level, 4)[0]
            inside = np.abs(pattern - truth) <= half_width_mm(session.deviation)
            for number in np.unique(region):
                held.setdefault(int(number), []).extend(inside[region == number].tolist())
    assert len(held) > 1
    assert [float(np.mean(share)) for share in held.values()] == pytest.approx([0.9] * len(held), abs=0.02)


def test_the_network_of_the_graph_has_the_correction_which_leaves_patterns_as_they_are(folder, session, frozen):
    model = onnx.load(folder / "sure.onnx")
    net, corrected = network_of(model), ModelSession(folder / "sure.onnx")
    assert origin_of(model)["options"]["intervals"] is True
    assert isinstance(net, CompactNet) and net.intervals is not None
    windows = np.stack([corrected.contract.scale_window(one) for one in frozen.windows(2)[::8]])
    deviations = net(torch.from_numpy(windows).flatten(1, 2))[1].detach().numpy()
    for window, expected in zip(windows, deviations, strict=True):
        corrected.run(window)
        np.testing.assert_allclose(corrected.deviation, expected, rtol=1e-4)
    patterns = [infer_with_intervals(one, frozen)[0] for one in (corrected, session)]
    np.testing.assert_allclose(*patterns, atol=1e-7)


def test_a_file_has_no_traces_of_the_machine_and_no_weights_elsewhere(folder):
    content = (folder / "sure.onnx").read_bytes()
    assert b".py" not in content and b"/tmp" not in content
    assert not any(init.external_data for init in onnx.load_from_string(content).graph.initializer)


@pytest.mark.night
def test_exporting_again_gives_the_same_bytes(folder, frozen, tmp_path):
    line = export(folder / "sure.pt", tmp_path, frozen)
    assert line.startswith("sure.onnx: 0.") and "dB" in line and "interval covers" in line
    assert (tmp_path / "sure.onnx").read_bytes() == (folder / "plain" / "sure.onnx").read_bytes()


def test_a_model_is_replaced_by_one_that_loads_and_stays_as_bak(folder, frozen, tmp_path, traced, monkeypatch):
    path = tmp_path / "sure.onnx"
    path.write_bytes(b"the one before")
    refused = ModelError("it does not load")
    with monkeypatch.context() as unloadable, pytest.raises(ModelError, match="it does not load"):
        unloadable.setattr("export.to_onnx.load_session", lambda draft: (_ for _ in ()).throw(refused))
        export(folder / "sure.pt", tmp_path, frozen)
    assert path.read_bytes() == b"the one before" and [one.name for one in tmp_path.iterdir()] == ["sure.onnx"]
    export(folder / "sure.pt", tmp_path, frozen)
    assert path.read_bytes() == (folder / "plain" / "sure.onnx").read_bytes()
    assert (tmp_path / "sure.onnx.bak").read_bytes() == b"the one before"


@pytest.mark.parametrize("head", ["leave", "uncertainty", "traction"])
def test_a_graph_that_computes_something_else_is_not_written(folder, frozen, tmp_path, monkeypatch, head):
    model = onnx.load(folder / "plain" / "sure.onnx")
    factor = 1.2 if head == "uncertainty" else 1.001  # regions move deviations by more than additions do
    for weight in model.graph.initializer:
        if weight.name.startswith(head) and weight.name.endswith(".bias"):
            weight.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(weight) * np.float32(factor), weight.name))
    monkeypatch.setattr(to_onnx, "to_model", lambda net, pad: model)
    output = {"leave": "pattern", "uncertainty": "deviation", "traction": "traction"}[head]
    with pytest.raises(ParityError, match=f"differ by .* in the {output}"):
        export(folder / "sure.pt", tmp_path, frozen)
    assert not list(tmp_path.iterdir())


def test_any_batch_is_one_run_of_many_windows(folder, frozen):
    session = ModelSession(folder / "sure.onnx")
    assert session.contract.batch == ANY_BATCH and session.contract.window_shape == (ANY_BATCH, 6, 4, 4)
    windows = [session.contract.scale_window(window) for window in frozen.windows(2)[:3]]
    together = session.run_together(windows).copy()
    np.testing.assert_allclose(together, [session.run(window).copy() for window in windows], rtol=1e-5, atol=1e-7)


def test_a_published_network_of_another_scale_has_one_output_and_is_not_judged(frozen, tmp_path_factory):
    """Its batch normalisation is folded into the convolutions."""
    folder = made_once(tmp_path_factory, published_model)
    model, session = onnx.load(folder / "peer.onnx"), ModelSession(folder / "peer.onnx")
    assert "BatchNormalization" not in {node.op_type for node in model.graph.node}
    assert session.contract.pattern_shape == (8, 8) and session.contract.interval_factor is None
    assert session.contract.test_error == {} and session.deviation is None
    windows = read_windows(frozen, session.contract)[:3]
    with torch.inference_mode():
        expected = load_network(folder / "peer.pt")[0](torch.from_numpy(windows)).numpy()
    assert expected.max() > 0
    (found,) = differences(["pattern"], [expected], GraphRun(model)(windows), 0.5)
    assert found.relative < 1e-5


@pytest.mark.parametrize(("name", "scale"), [("compact-stsr", 20), ("compact-mtsr7", 6)])
def test_one_and_seven_taps_are_exported_at_any_scale(tmp_path, name, scale):
    frozen = some_frames(taps=7)
    options = {"channels": 16, "blocks": 1}
    path = save_checkpoint(tmp_path / "one.pt", build(name, scale, **options), name, **options)
    assert f"x{scale}, not evaluated, the test set is of x10, parity" in export(path, tmp_path, frozen)
    contract = ModelSession(tmp_path / "one.onnx").contract
    assert contract.pattern_shape == (4 * scale, 4 * scale) and contract.taps == (7 if "7" in name else 1)


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


def test_the_command_writes_integers_and_says_what_they_cost(folder, frozen, tmp_path, traced, monkeypatch, capsys):
    frozen.save(tmp_path / "frozen.npz")
    PRESSES.save(tmp_path / "taps.npz")
    monkeypatch.setattr(to_onnx, "BUNDLE_DIR", tmp_path)
    monkeypatch.setattr(to_onnx, "paper_taps", lambda split: None)
    monkeypatch.setattr(to_onnx, "confidence_sets", lambda validation, scale: [frozen])
    monkeypatch.setattr(to_onnx, "MOST_LOSS_DB", -100.0)
    with pytest.raises(
        SystemExit, match=r"^export: quantisation costs too much in sure-int8\.onnx .*: use the float32 model"
    ):
        main([str(folder / "sure.pt"), "--out", str(tmp_path), "--int8", str(tmp_path / "taps.npz")])
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith("sure-int8.onnx: ") and "of 16 convolutions in int8" in line and "dB lost" in line
    contract = ModelSession(tmp_path / "sure-int8.onnx").contract
    assert contract.arithmetic == "int8" and set(contract.test_error) == {"1", "2"} == set(contract.confidence)
    with pytest.raises(SystemExit, match=r"^export: .*none\.pt"):
        main([str(tmp_path / "none.pt"), "--out", str(tmp_path)])


def test_options_that_do_not_fit_are_a_usage_error():
    with pytest.raises(SystemExit) as end:
        main(["one.pt", "--intervals", "x"])
    assert end.value.code == 2


def test_a_folder_that_is_a_file_ends_in_one_line(tmp_path):
    (tmp_path / "taken").write_text("")
    with pytest.raises(SystemExit, match=r"^export: .*taken: File exists"):
        main(["one.pt", "--out", str(tmp_path / "taken")])


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

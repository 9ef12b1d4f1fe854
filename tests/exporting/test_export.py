"""Export of networks: contract, parity, intervals, files, the command, and the error of a pattern by its doubt."""

import json
from dataclasses import replace

import numpy as np
import onnx
import pytest
import torch
from edge_samples import make_contract
from onnx import numpy_helper
from press_samples import make_press_set

from edge.evaluation.test_set import judge, load_frozen_set, mean_error
from edge.inference.bundled import BUNDLE_DIR, find_model
from edge.inference.contract import ANY_BATCH, CONTRACT_VERSION
from edge.inference.intervals import WORTH_A_TAP, doubt, expect, is_confidence, regions
from edge.inference.onnx_session import ModelSession
from export import to_onnx
from export.graph import ParityError
from export.parity import check_parity
from export.to_onnx import BINS, doubts_and_errors, export, fit_confidence, main
from train.data.frozen_presses import freeze_presses, load_frozen_presses
from train.learning.checkpoint import Training, fit_network, infer, load_network, network_of, origin_of
from train.learning.interval_fit import half_width_mm, interval_coverage, readings_of_presses
from train.learning.training_loop import Recipe
from train.networks.compact import CompactNet
from train.networks.named_networks import build
from train.physics.pad_draws import KNOWN
from train.surfaces.poses import REACH_MM
from train.trust import load_trust

OPTIONS = {"channels": 16, "blocks": 1, "known": KNOWN}
PRESSES = make_press_set(count=64, taps=2)
SURE = Training("sure", "fusion-mtsr2", Recipe(steps=2, batch=4, given=(0.5, 0.5)), options=OPTIONS)
INTERVALS = {"validation": PRESSES, "intervals": PRESSES, "steps": 50}
BEFORE = b"the one before"


@pytest.fixture(scope="module")
def frozen():
    """A few presses, which are not those of any training."""
    return freeze_presses(make_press_set(24, taps=2, seed=1), 1).as_frozen_set()


@pytest.fixture(scope="module")
def folder(tmp_path_factory, frozen):
    """A small network as training leaves it in sure.pt, and sure.onnx with intervals and checks."""
    folder = tmp_path_factory.mktemp("models")
    fit_network(SURE, PRESSES, frozen, folder)
    net, _ = load_network(folder / "sure.pt")
    torch.manual_seed(0)
    with torch.no_grad():
        for name in ("receive", "revise"):  # two steps are too few for earlier taps to matter
            for free in net.get_submodule(name).parameters():
                torch.nn.init.normal_(free, 0, 0.1)
        net.get_parameter("log_reach")[0] += 0.1  # a graph holds equal numbers once
        # The exporter folds weights of 0, and without a lift most patterns would be zero everywhere.
        for weight in net.get_submodule("context").parameters():
            torch.nn.init.normal_(weight, 0, 0.05)
        net.get_parameter("leave.2.bias_free").add_(0.02)
    torch.save(net.state_dict(), folder / "sure.pt")
    (folder / "sure.onnx").write_bytes(BEFORE)
    export(folder / "sure.pt", folder, frozen, trust=load_trust(find_model("stsr-int8")), **INTERVALS)
    return folder


def save_checkpoint(path, net, name, **options):
    """Write weights as they are, which is enough to be exported."""
    torch.save(net.state_dict(), path)
    report = {"network": name, "scale": net.scale, "options": options}
    path.with_suffix(".json").write_text(json.dumps(report | {"contact_level": 0.5, "training_sha256": "ab" * 32}))
    return path


@pytest.fixture(scope="module")
def session(folder):
    return ModelSession(folder / "sure.onnx")


@pytest.fixture(scope="module")
def net(folder):
    """The network of the graph, which has the correction of intervals."""
    return network_of(onnx.load(folder / "sure.onnx"))


def test_a_file_keeps_its_contract_and_no_traces_of_the_machine(folder, session, frozen):
    contract, report = session.contract, json.loads((folder / "sure.json").read_text())
    assert (contract.version, contract.taps, contract.scale, contract.sensor) == (CONTRACT_VERSION, 2, 10, "uSPa44")
    assert (contract.counts_per_unit, contract.angle_step_deg) == ((500.0, 500.0, 1000.0), 5.0)
    assert contract.training_sha256 == report["training_sha256"] == SURE.sha256(report["data_sha256"])
    assert contract.contact_level == report["contact_level"] and set(contract.confidence) == {"1", "2"}
    assert contract.test_set_sha256 == frozen.sha256() and contract.output_full_scale == frozen.full_scale_mm
    assert (contract.takes_poses, contract.reach_mm) == (True, REACH_MM) and contract.read_trust() is not None
    assert contract.window_shape == (ANY_BATCH, "taps", 3, 4, 4)
    content = (folder / "sure.onnx").read_bytes()
    assert b".py" not in content and b"/tmp" not in content
    assert not any(init.external_data for init in onnx.load_from_string(content).graph.initializer)
    assert (folder / "sure.onnx.bak").read_bytes() == BEFORE


def test_the_runtime_computes_what_was_trained(folder, session, net, frozen):
    windows = frozen.windows(2)
    plain, uncorrected = infer(load_network(folder / "sure.pt")[0], windows)
    patterns, deviations = infer(net, windows)
    assert isinstance(net, CompactNet) and net.intervals is not None and net.deviation_scale != 1
    assert origin_of(onnx.load(folder / "sure.onnx"))["options"]["intervals"] is True
    np.testing.assert_allclose(plain, patterns, atol=1e-7)
    assert patterns.max() > 0 and not np.allclose(uncorrected, deviations)
    for window, pattern, deviation in list(zip(windows, patterns, deviations, strict=True))[::5]:
        np.testing.assert_allclose(session.run(session.contract.scale_window(window)), pattern, atol=1e-6)
        np.testing.assert_allclose(session.deviation, deviation, rtol=1e-4)


def test_the_contract_states_errors_by_number_of_taps(session, net, frozen):
    told = session.contract.test_error
    for given in (1, 2):
        patterns, deviations = infer(net, frozen.windows(2, given))
        measured = judge(patterns, frozen, session.contract.contact_level, half_width_mm(deviations))
        covered = interval_coverage(frozen.patterns(), patterns, deviations)
        assert told[str(given)]["psnr_db"] == pytest.approx(mean_error(measured)["psnr_db"], abs=2e-4)
        assert told[str(given)]["coverage_90"] == pytest.approx(covered, abs=0.02)
    assert set(told) == {"1", "2"} and told["1"] != told["2"]


@pytest.mark.parametrize("name", ["sure", pytest.param("sure-int8", marks=pytest.mark.night)])
def test_intervals_hold_on_the_presses_that_set_them(folder, frozen, name, tmp_path):
    if name != "sure":
        export(folder / "sure.pt", tmp_path, frozen, calibration=PRESSES, **INTERVALS)
    session = ModelSession((folder if name == "sure" else tmp_path) / f"{name}.onnx")
    for given in (1, 2):
        held: dict[int, list[bool]] = {}
        for one in readings_of_presses(PRESSES, 2):
            for window, pad, truth in zip(one.with_taps(given), one.pads, one.truth, strict=True):
                pattern = session.run(window.reshape(2, 3, 4, 4), pad)
                region = regions(pattern[None], session.contract.contact_level, 4)[0]
                inside = np.abs(pattern - truth) <= half_width_mm(session.deviation)
                for number in np.unique(region):
                    held.setdefault(int(number), []).extend(inside[region == number].tolist())
        shares = [float(np.mean(share)) for share in held.values() if len(share) > 100]  # fewer pixels tell little
        assert len(shares) > 1 and shares == pytest.approx([0.9] * len(shares), abs=0.02)
    levels = session.contract.interval_levels
    assert list(levels) == ["50", "80", "90", "95"]
    # Far from a contact most errors of integers are zero, for which there is a least width.
    assert levels["90"][:3] == pytest.approx([float(half_width_mm(1.0))] * 3, rel=0.02)
    assert all(low <= high for low, high in zip(levels["50"], levels["95"], strict=True))


@pytest.mark.parametrize("head", ["leave", "uncertainty", "traction"])
def test_a_graph_that_computes_something_else_is_no_parity(folder, session, net, frozen, head):
    model = onnx.load(folder / "sure.onnx")
    factor = 1.2 if head == "uncertainty" else 1.001  # regions move deviations by more than additions do
    for weight in model.graph.initializer:
        if weight.name.startswith(head) and weight.name.endswith(".bias"):
            weight.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(weight) * np.float32(factor), weight.name))
    output = {"leave": "pattern", "uncertainty": "deviation", "traction": "traction"}[head]
    with pytest.raises(ParityError, match=f"differ by .* in the {output}"):
        check_parity(net, model, frozen, session.contract)


def test_a_published_network_has_one_output_and_no_checks(frozen, tmp_path):
    """Its batch normalisation is folded; a pattern of another surface's taps would be believed."""
    net = build("mtsr2", 2)
    with torch.no_grad():
        list(net.parameters())[-1].fill_(1.0)  # or no pattern would be above zero
        for name, held in net.named_buffers():
            if held.is_floating_point():
                torch.nn.init.uniform_(held, *((0.5, 2) if name.endswith("var") else (-1, 1)))
    path = save_checkpoint(tmp_path / "peer.pt", net, "mtsr2")
    line, _ = export(path, tmp_path, frozen, trust=load_trust(find_model("stsr-int8")))
    assert "x2, not evaluated, the test set is of x10, parity" in line
    session = ModelSession(tmp_path / "peer.onnx")
    contract = session.contract
    assert contract.pattern_shape == (8, 8) and contract.taps == 2 and contract.read_trust() is None
    assert contract.interval_factor is None and contract.test_error == {} and session.deviation is None
    assert session.run(np.ones((2, 3, 4, 4), np.float32)).max() > 0
    assert "BatchNormalization" not in {node.op_type for node in onnx.load(tmp_path / "peer.onnx").graph.node}


def test_the_command_writes_integers_and_says_what_they_cost(tmp_path, limits, capsys):
    PRESSES.pick(np.arange(32)).save(tmp_path / "taps.npz")
    limits(to_onnx, MOST_LOSS_DB=-100.0, MOST_COVERAGE_CHANGE=-1.0)
    net = build("compact-stsr", 10, **OPTIONS)
    net.get_parameter("leave.2.bias_free").data += 0.02  # or no pattern would be above zero
    words = [str(save_checkpoint(tmp_path / "one.pt", net, "compact-stsr", **OPTIONS)), "--out", str(tmp_path)]
    words += [word for name in ("--validation", "--test", "--int8") for word in (name, str(tmp_path / "taps.npz"))]
    told = r"one-int8\.onnx \(more than .* dB and an interval changed by more than .*\): use the float32 model"
    with pytest.raises(SystemExit, match=f"^export: quantisation costs too much in {told}"):
        main(words)
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith("one-int8.onnx: ") and "dB lost" in line
    contract = ModelSession(path := tmp_path / "one-int8.onnx").contract
    assert contract.arithmetic == "int8" and set(contract.test_error) == {"1"} == set(contract.confidence)
    assert contract.test_set_sha256 != load_frozen_set(BUNDLE_DIR / "frozen.npz").sha256(), "it is of --test"
    path.write_bytes(b"better")
    with pytest.raises(SystemExit, match=r"one-int8\.onnx \(more than .* dB and .*; the file that was there stays\)"):
        main(words)
    assert path.read_bytes() == b"better" and not [*tmp_path.glob("*.bak")]


def test_what_cannot_be_exported_ends_in_one_line(folder, tmp_path):
    PRESSES.save(tmp_path / "taps.npz")
    coarse = {name: getattr(PRESSES, name)[:, ::5, ::5] for name in ("patterns", "touching")}
    replace(PRESSES, **coarse).save(tmp_path / "coarse.npz")
    (tmp_path / "taken").write_text("")
    (tmp_path / "old.pt").write_bytes((folder / "sure.pt").read_bytes())
    of_an_earlier_release = (folder / "sure.json").read_text().replace('"contact_level"', '"level"')
    (tmp_path / "old.json").write_text(of_an_earlier_release)
    sure, none, old = str(folder / "sure.pt"), str(tmp_path / "none.pt"), str(tmp_path / "old.pt")
    for checkpoints, presses, out, told in (
        ([sure], "taps", "taken", "taken: File exists"),
        ([sure, none], "taps", "", r"none\.pt is no checkpoint .*No such file"),
        ([old], "taps", "", "no 'contact_level'"),
        ([sure], "coarse", "", "sure.pt is at x10 of a uSPa44, the validation presses are not"),
    ):
        files = ["--validation", str(tmp_path / f"{presses}.npz"), "--out", str(tmp_path / out)]
        with pytest.raises(SystemExit, match=rf"^export: [^\n]*{told}[^\n]*$"):
            main([*checkpoints, *files])
    assert not [*tmp_path.glob("*.onnx")]


def test_a_single_tap_reads_no_memory_that_nobody_wrote(folder):
    """Without earlier taps products go over nothing, which onnxruntime may leave as the memory was."""
    session = ModelSession(folder / "sure.onnx")
    window = np.random.default_rng(3).normal(0, 0.5, (1, 3, 4, 4)).astype(np.float32)
    expected = session.run(window).copy()
    assert np.array_equal(session.run(np.concatenate([window, np.zeros_like(window)])), expected), "an absent tap"
    for count in (1, 2, 4, 8):
        for size in range(4, 20):
            for _ in range(50):
                np.full(2**size, np.nan, dtype=np.float32)  # memory that is free again
            assert np.allclose(session.run_together([window] * count), expected, atol=1e-6)


TABLE = {
    "1": {"doubt": [0.1, 0.3], "error": [0.2, 0.4], "gain": [0.0, 0.1]},
    "2": {"doubt": [0.1, 0.3], "error": [0.1, 0.3], "gain": []},
}


def test_the_error_is_interpolated_between_doubts():
    pattern = np.full((40, 40), 0.5, dtype=np.float32)
    for about, share, another in ((0.05, 0.2, False), (0.139, 0.239, False), (0.2, 0.3, True), (0.6, 0.8, True)):
        rmse, worth_it = expect(TABLE, 1, *doubt(pattern, about * pattern))
        assert rmse == pytest.approx(0.5 * share, rel=1e-4) and worth_it is another and WORTH_A_TAP == 0.02
    assert expect(TABLE, 3, 0.2, 0.5) is None and expect({}, 1, 0.2, 0.5) is None
    assert expect(TABLE, 2, 0.2, 0.5) == (pytest.approx(0.1), None)
    assert doubt(0 * pattern, 0 * pattern + 1) == (np.inf, 0.0) and expect(TABLE, 1, np.inf, 0.0) is None


def test_other_values_are_no_table():
    assert is_confidence(TABLE, 2) and is_confidence({}, 4)
    wrong = [("doubt", [0.3, 0.1]), ("doubt", [0.0, 0.1]), ("doubt", []), ("error", [0.1]), ("gain", [0.1, True])]
    rows = [{"1": {**TABLE["1"], name: values}} for name, values in wrong]
    for value in (None, {"1": None}, {"5": TABLE["1"]}, {"one": TABLE["1"]}, {"1": {"doubt": [0.1]}}, *rows):
        assert not is_confidence(value, 4), value


class Oracle:
    """Model of a truth that is off by a share equal to its deviation, less with each tap."""

    name, contract = "oracle", make_contract(taps=2, interval_factor=1.6, counts_per_unit=(1.0, 1.0, 1.0))

    def __init__(self, frozen):
        shares = np.random.default_rng(1).uniform(0.05, 0.5, len(frozen.newest))
        readings = [one.tobytes() for one in frozen.newest]
        self._known = dict(zip(readings, zip(frozen.patterns(), shares, strict=True), strict=True))

    def run(self, window):
        truth, share = self._known[window[0].astype(np.int16).tobytes()]
        pattern = truth * np.float32(1 + share * (1 - share * bool(window[1].any())))
        self.deviation = np.full_like(pattern, share * np.sqrt(np.mean(pattern**2)))
        return pattern


def test_the_table_finds_error_and_gain_by_doubt():
    frozen = load_frozen_set(BUNDLE_DIR / "frozen.npz")
    table = fit_confidence(Oracle(frozen), frozen)
    assert set(table) == {"1", "2"} and len(table["1"]["doubt"]) == BINS and table["2"]["gain"] == []
    assert is_confidence(table, 2)
    for about, error, gain in zip(*table["1"].values(), strict=True):
        assert error == pytest.approx(about / (1 + about), rel=0.02)
        assert gain == pytest.approx(about, rel=0.05)


@pytest.mark.parametrize("name", ["stsr-int8", "stsr-small-int8", "mtsr-int8"])
def test_the_expected_error_is_near_the_true_one(name):
    """The table is of other presses of the wide world; measured 1.05 to 1.09 of the true error, small ones 1.20.

    Quarters have .91 to 1.18, small ones to 1.38; correlation .66 to .72.
    """
    session = ModelSession(find_model(name))
    about, error, size = doubts_and_errors(session, 1, load_frozen_presses().as_frozen_set())
    told = session.contract.confidence["1"]
    expected = np.interp(about, told["doubt"], told["error"]) * size
    of_all, of_quarter = (0.25, 0.45) if "small" in name else (0.1, 0.25)
    assert expected.mean() == pytest.approx(error.mean(), rel=of_all)
    assert np.corrcoef(expected, error)[0, 1] > 0.6
    for part in np.array_split(np.argsort(expected), 4):
        assert expected[part].mean() == pytest.approx(error[part].mean(), rel=of_quarter)

"""Every model computes what its network computes, and nearly so in integers."""

from functools import cache

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import numpy_helper
from press_samples import make_press_set

from edge.evaluation.test_set import load_frozen_set
from edge.inference.bundled import BUNDLE_DIR, bundled_models, find_model
from edge.inference.contract import Contract
from edge.inference.onnx_session import ModelSession
from export.graph import ExportError, ParityError
from export.int8 import calibration_batch, integer_nodes, quantised
from export.parity import differences, extreme_windows, read_windows
from export.to_onnx import MOST_LOSS_DB
from export.verify import judged, main, verify
from train.errors import CheckpointError
from train.learning.checkpoint import network_of

MODELS = [path.stem for path in bundled_models()]
IN_FLOAT = [name for name in MODELS if not name.endswith("-int8")]
IN_INTEGERS = [name for name in MODELS if name.endswith("-int8")]


@cache
def frozen():
    return load_frozen_set(BUNDLE_DIR / "frozen.npz")


IN_GATE = 6
"""One frame in so many is compared; of float32, which is the same on each window, a sixth of these."""


@cache
def rows(name, one_in):
    """Compare a model with its network on one frame of so many of the frozen set."""
    return list(verify(find_model(name), frozen() if one_in == 1 else frozen().thinned(one_in)))


def graph_of(name):
    model = onnx.load(find_model(name))
    return model, Contract.from_metadata({entry.key: entry.value for entry in model.metadata_props})


@pytest.mark.parametrize("whole", [False, pytest.param(True, marks=pytest.mark.night)])
@pytest.mark.parametrize("name", MODELS)
def test_every_bundled_model_keeps_every_bound(name, whole):
    found = rows(name, 1 if whole else IN_GATE if name in IN_INTEGERS else 6 * IN_GATE)
    assert [row for row in found if row.broken] == []
    assert [row.windows for row in found] == ["test set", *["one tap"] * name.startswith("mtsr"), "extreme"]


@pytest.mark.parametrize("one_in", [IN_GATE, pytest.param(1, marks=pytest.mark.night)])
@pytest.mark.parametrize("name", IN_INTEGERS)
def test_integers_cost_no_more_than_they_may(name, one_in):
    (lost_db,) = (-row.psnr_change_db for row in rows(name, one_in) if row.psnr_change_db is not None)
    assert -0.1 < lost_db <= MOST_LOSS_DB
    session, in_float = (ModelSession(find_model(each)) for each in (name, name.removesuffix("-int8")))
    taps = str(session.contract.taps)
    said_db = in_float.contract.test_error[taps]["psnr_db"] - session.contract.test_error[taps]["psnr_db"]
    assert said_db == pytest.approx(lost_db, abs=2e-3 if one_in == 1 else 2e-2)
    assert (session.contract.arithmetic, in_float.contract.arithmetic) == ("int8", "float32")


@pytest.mark.parametrize("name", IN_FLOAT)
def test_the_network_is_made_again_from_its_graph(name):
    model, contract = graph_of(name)
    net = network_of(model)
    assert (net.taps, net.scale, net.training) == (contract.taps, contract.scale, False)
    model.graph.initializer[0].name = "folded"
    with pytest.raises(CheckpointError, match=r"does not hold .* only its checkpoint does"):
        network_of(model)
    del model.metadata_props[:]
    with pytest.raises(CheckpointError, match=r"'tactile\.origin' is missing"):
        network_of(model)


def test_a_model_that_computes_something_else_breaks_the_bound(tmp_path, capsys):
    model, _ = graph_of("stsr-small")
    (last,) = [node for node in model.graph.node if "pattern" in node.output]
    last.output[0] = "less"
    model.graph.initializer.append(numpy_helper.from_array(np.float32(1.01), "more"))
    model.graph.node.append(onnx.helper.make_node("Mul", ["less", "more"], ["pattern"]))
    (tmp_path / "off.onnx").write_bytes(model.SerializeToString())
    with pytest.raises(SystemExit, match=r"verify: \d+ of \d+ comparisons break a bound"):
        main([str(tmp_path / "off.onnx"), "--out", str(tmp_path / "parity.md")])
    printed = capsys.readouterr().out
    assert "pattern differs by" in printed and "more than 1e-05" in printed
    assert printed.strip() in (tmp_path / "parity.md").read_text()


@pytest.mark.parametrize(
    ("pattern_factor", "deviation_factor", "said"),
    [
        (1.0, 0.0, "a deviation is not above zero"),
        (0.5, 1.0, "pattern differs by 5.0e-01, more than 0.25"),
        (0.98, 1.0, "dB lost, more than 0.1"),
        (1.0, 1.0, ""),
    ],
)
def test_integers_that_say_something_else_break_the_bound(pattern_factor, deviation_factor, said):
    _, contract = graph_of("stsr-small-int8")
    ones = np.ones((2, 40, 40), np.float32)
    expected = [0.5 * ones, 0.1 * ones, np.ones((2, 3, 8, 8), np.float32)]
    factors = (pattern_factor, deviation_factor, 1.0)
    given = [one * np.float32(factor) for one, factor in zip(expected, factors, strict=True)]
    _, change_db, broken = judged("test set", contract, expected, given, 0.501 * ones)
    assert said in broken and bool(said) == bool(broken) and (pattern_factor < 1) == (change_db < 0)


def test_a_difference_is_a_share_of_the_larger_scale_and_finite():
    small, large = np.full((1, 4, 4), 0.1, np.float32), np.full((1, 4, 4), 10.0, np.float32)
    for size, expected in ((small, 0.02), (large, 0.001)):
        found = differences(["pattern"], [size], [size + np.float32(0.01)], 0.5)
        assert found == {"pattern": pytest.approx(expected, rel=1e-4)}
    for spoil in (np.nan, np.inf):
        bad = small + np.float32(spoil)
        for expected, given, told in ((small, bad, "the pattern is"), (bad, small, "torch gives a pattern that is")):
            with pytest.raises(ParityError, match=f"{told} not finite"):
                differences(["pattern"], [expected], [given], 0.5)
    with pytest.raises(ParityError, match="outputs of shape"):
        differences(["pattern"], [small], [small[0]], 0.5)


def test_windows_are_of_every_force_and_stiff_ones_beside():
    _, contract = graph_of("mtsr")
    step = read_windows(frozen(), contract)
    assert step.shape[1:] == (21, 4, 4) and 50 < len(step) < 250 < len(read_windows(frozen(), contract, None))
    stiff = extreme_windows(contract)
    bits = stiff["denormals"].view(np.uint32)  # a comparison would take them for zeros
    assert not stiff["zeros"].any() and bits.min() > 0 and bits.max() < 0x00800000
    assert not stiff["4 of 7 taps"][:, 12:].any() and stiff["4 of 7 taps"][:, 3:12].any()


@pytest.mark.parametrize(
    ("files", "complaint"),
    [
        ({}, r"stsr-int8\.onnx: cannot be read: No such file"),
        ({"stsr-int8": b"\xff\xff\xff"}, r"stsr-int8\.onnx: not an ONNX model"),
        ({"stsr-int8": b""}, r"stsr-int8\.onnx: contract key 'version'"),
        (
            {"stsr-int8": find_model("stsr-int8").read_bytes(), "stsr": find_model("stsr-small").read_bytes()},
            r"stsr-int8\.onnx: .*stsr\.onnx is of another training than the model",
        ),
        (
            {"stsr-int8": find_model("stsr-int8").read_bytes()},
            r"the float32 model stsr\.onnx is not in the folder of its int8 model",
        ),
    ],
)
def test_what_cannot_be_compared_ends_in_one_line(tmp_path, files, complaint):
    for name, content in files.items():
        (tmp_path / f"{name}.onnx").write_bytes(content)
    with pytest.raises(SystemExit, match=rf"^verify: [^\n]*{complaint}"):
        main([str(tmp_path / "stsr-int8.onnx")])


def test_a_report_that_cannot_be_written_is_told_first(tmp_path):
    (tmp_path / "taken").write_text("")
    with pytest.raises(SystemExit, match=r"^verify: [^\n]*taken: File exists$"):
        main([str(find_model("stsr-small")), "--out", str(tmp_path / "taken/parity.md")])


def test_the_largest_grid_is_in_integers_but_for_outputs(tmp_path):
    """The same windows give the same bytes; what has no convolutions is refused."""
    model, contract = graph_of("stsr-small")
    seen = calibration_batch(make_press_set(64, taps=1), contract)
    before = model.SerializeToString(deterministic=True)
    integers, again = (quantised(model, seen).SerializeToString(deterministic=True) for _ in range(2))
    assert model.SerializeToString(deterministic=True) == before
    assert again == integers
    weights = {node.name: node.input[1] for node in model.graph.node if node.op_type == "Conv"}
    chosen = {weights[name] for name in integer_nodes(model) if name in weights}
    trunk = {f"trunk.{block}.body.{layer}.weight" for block in range(4) for layer in (0, 2)}
    assert chosen == trunk | {"leave.0.weight", "uncertainty.0.weight"}
    options = onnxruntime.SessionOptions()
    options.optimized_model_filepath = str(tmp_path / "optimised.onnx")
    onnxruntime.InferenceSession(integers, options, providers=["CPUExecutionProvider"])
    run = [node.op_type for node in onnx.load(tmp_path / "optimised.onnx").graph.node]
    assert run.count("QLinearConv") == 10
    ends = [[onnx.helper.make_tensor_value_info(name, 1, [1, 6, 4, 4])] for name in ("window", "pattern")]
    graph = onnx.helper.make_graph([onnx.helper.make_node("Relu", ["window"], ["pattern"])], "none", *ends)
    with pytest.raises(ExportError, match=r"no convolution .* without --int8"):
        quantised(onnx.helper.make_model(graph), seen)


def test_ranges_are_of_light_contacts_and_all_numbers_of_taps():
    (_, contract), presses = graph_of("mtsr"), make_press_set(64, taps=7)
    windows = calibration_batch(presses, contract).window.numpy()
    assert windows.shape == (64, 21, 4, 4)
    assert np.array_equal(windows, calibration_batch(presses, contract).window.numpy())
    size = np.abs(windows[:, :3]).max(axis=(1, 2, 3))
    assert size.min() < 0.3 * size.max()
    given = (np.abs(windows[:, 3:]).max(axis=(1, 2, 3)) > 0).mean()
    assert 0.2 < given < 0.9
    with pytest.raises(ExportError, match="31 sequences to take ranges of, expected 32 or more"):
        calibration_batch(presses.pick(np.arange(31)), contract)

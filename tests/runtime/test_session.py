import json

import numpy as np
import onnx
import onnxruntime
import pytest
from edge_samples import make_contract, tiny_deviation, tiny_pattern, write_model
from onnx import TensorProto

from edge.errors import ModelError, WindowError
from edge.inference.contract import ANY_BATCH, CONTRACT_VERSION, KEY_PREFIX, Contract
from edge.inference.onnx_session import ModelSession


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    return ModelSession(write_model(tmp_path_factory.mktemp("model") / "tiny.onnx"))


def random_window(seed=0, taps=4):
    return np.random.default_rng(seed).normal(size=(taps, 3, 4, 4)).astype(np.float32)


@pytest.mark.parametrize("taps", [1, 2, 4])
def test_runs_what_the_graph_says_newest_tap_first(tmp_path, taps):
    session = ModelSession(write_model(tmp_path / "tiny.onnx", make_contract(taps=taps)))
    window = random_window(taps=taps)
    pattern = session.run(window)
    assert pattern.shape == (40, 40) and pattern.dtype == np.float32
    np.testing.assert_allclose(pattern, tiny_pattern(window), atol=1e-6)


def test_name_and_contract_are_the_models(session):
    assert session.name == "tiny"
    assert session.contract == make_contract()


def test_output_is_one_read_only_array_bound_once(session):
    first = session.run(random_window(1))
    kept = first.copy()
    second = session.run(random_window(2))
    assert np.shares_memory(first, second) and not np.array_equal(kept, second)
    with pytest.raises(ValueError, match="read-only"):
        first[0, 0] = 1


@pytest.mark.parametrize("batch", [1, ANY_BATCH])
def test_windows_run_together_give_what_each_gives_alone(tmp_path, batch):
    contract = make_contract(batch=batch, interval_factor=1.6)
    session = ModelSession(write_model(tmp_path / "several.onnx", contract))
    windows = [random_window(seed) for seed in range(3)]
    alone = [(session.run(window).copy(), session.deviation.copy()) for window in windows]
    for count in (3, 1, 2):
        together = session.run_together(windows[:count])
        assert together.shape == session.deviation.shape == (count, 40, 40)
        for index in range(count):
            np.testing.assert_array_equal(together[index], alone[index][0])
            np.testing.assert_array_equal(session.deviation[index], alone[index][1])


def test_one_bad_window_among_several_is_refused(session):
    with pytest.raises(WindowError, match="not finite"):
        session.run_together([random_window(1), np.full((4, 3, 4, 4), np.nan, dtype=np.float32)])


def test_a_graph_of_several_windows_and_no_fewer_is_refused(tmp_path):
    contract = make_contract(batch=3)
    with pytest.raises(ModelError, match=r"'batch' is 3, .*: export it with --batch any"):
        ModelSession(write_model(tmp_path / "three.onnx", contract))


def test_non_contiguous_windows_are_right(session):
    window = random_window(3)
    strided = np.asfortranarray(window)
    np.testing.assert_array_equal(session.run(window).copy(), session.run(strided))


@pytest.fixture(scope="module")
def sure_session(tmp_path_factory):
    """Session of a model that gives deviations."""
    return ModelSession(write_model(tmp_path_factory.mktemp("sure") / "sure.onnx", make_contract(interval_factor=1.6)))


def test_the_deviation_is_that_of_the_last_run(sure_session):
    for seed in (1, 2):
        window = random_window(seed)
        pattern = sure_session.run(window)
        np.testing.assert_allclose(pattern, tiny_pattern(window), atol=1e-6)
        deviation = sure_session.deviation
        assert deviation.shape == (40, 40) and deviation.dtype == np.float32
        np.testing.assert_allclose(deviation, tiny_deviation(tiny_pattern(window)), atol=1e-6)
    assert deviation is sure_session.deviation
    with pytest.raises(ValueError, match="read-only"):
        deviation[0, 0] = 1


def test_a_model_without_deviation_has_none(session):
    session.run(random_window())
    assert session.deviation is None


@pytest.mark.parametrize("doubt", [0.0, -0.01, np.nan, np.inf])
def test_a_deviation_that_is_not_finite_and_above_zero_is_never_given_out(tmp_path, doubt):
    path = write_model(tmp_path / "odd.onnx", make_contract(interval_factor=1.6), doubt=doubt)
    with pytest.raises(ModelError, match="'odd' gave a deviation that is not finite and above zero"):
        ModelSession(path)


def test_one_bad_pixel_of_the_deviation_is_enough(tmp_path):
    path = write_model(tmp_path / "far.onnx", make_contract(interval_factor=1.6), doubt=10.0)
    session, window = ModelSession(path), np.zeros((4, 3, 4, 4), dtype=np.float32)
    window[0, 2, 1, 1] = 1e38
    with pytest.raises(ModelError, match="'far' gave a deviation that"):
        session.run(window)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_window_that_is_not_finite_is_refused(session, bad):
    window = random_window()
    window[3, 1, 2, 2] = bad
    with pytest.raises(WindowError, match="not finite"):
        session.run(window)


@pytest.mark.parametrize(
    "window",
    [
        np.zeros((1, 12, 4, 4), dtype=np.float32),
        np.zeros((3, 3, 4, 4), dtype=np.float32),
        np.zeros((4, 3, 4, 4), dtype=np.float64),
        np.zeros((4, 3, 4, 4), dtype=np.int32),
    ],
)
def test_a_window_of_wrong_shape_or_type_is_refused_with_both(session, window):
    with pytest.raises(WindowError, match=r"window is .*expected \(4, 3, 4, 4\) float32"):
        session.run(window)


def test_an_output_that_is_not_finite_is_never_given_out(tmp_path):
    session = ModelSession(write_model(tmp_path / "loud.onnx", gain=3e38))
    window = np.full((4, 3, 4, 4), 1e3, dtype=np.float32)
    with pytest.raises(ModelError, match="'loud' gave a pattern that is not finite"):
        session.run(window)


def test_denormals_become_zero(session):
    window = np.full((4, 3, 4, 4), 1000, dtype=np.uint32).view(np.float32)
    assert session.run(window).tobytes() == bytes(4 * 40 * 40)


BROKEN_VALUES = {
    "version": 1,
    "batch": 0,
    "taps": 0,
    "scale": "10",
    "tap_order": "oldest first",
    "angle_step_deg": None,
    "counts_per_unit": [1, 2],
    "output_unit": "",
    "output_full_scale": -1,
    "contact_level": 1.5,
    "sensor": 4,
    "rows": 4.0,
    "cols": -4,
    "pitch_mm": 0,
    "arithmetic": "int4",
    "interval_factor": 0,
    "confidence": {"1": {"doubt": [0.1], "error": [0.1], "gain": [0.1, 0.2]}},
    "training_sha256": None,
    "test_set_sha256": "",
    "test_error": [],
    "pad_inputs": [["thickness", 4.5, 1.0]],
    "takes_gains": 1,
    "traction_scale": 2.0,
    "trust": {"forward": {}},
    "interval_levels": {"90": [1.6, 1.6, 1.6]},
    "takes_poses": 1,
    "reach_mm": -1,
}


def test_every_contract_key_is_broken_below():
    assert set(BROKEN_VALUES) == set(Contract.__slots__)


@pytest.mark.parametrize("key", BROKEN_VALUES)
@pytest.mark.parametrize("how", ["missing", "not JSON", "wrong"])
def test_a_broken_contract_is_refused_naming_key_and_file(tmp_path, key, how):
    metadata = make_contract().to_metadata()
    if how == "missing":
        del metadata[KEY_PREFIX + key]
    else:
        metadata[KEY_PREFIX + key] = "{" if how == "not JSON" else json.dumps(BROKEN_VALUES[key])
    path = write_model(tmp_path / "broken.onnx", metadata=metadata)
    with pytest.raises(ModelError, match=f"broken.onnx: .*'{key}'"):
        ModelSession(path)


@pytest.mark.parametrize("levels", [{"90": [1, 1, 1, 0]}, {"100": [1] * 4}, {"most": [1] * 4}, {"90": [1, 1, 1, "1"]}])
def test_interval_levels_are_positive_factors_of_percentages(levels):
    metadata = make_contract(interval_levels=levels).to_metadata()
    with pytest.raises(ModelError, match=r"'interval_levels' is .* for each percentage a positive number"):
        Contract.from_metadata(metadata)


def test_interval_levels_are_kept():
    levels = {"50": [0.5, 0.6, 0.5, 0.4], "90": [1.6, 1.6, 1.6, 1.6]}
    metadata = make_contract(interval_levels=levels).to_metadata()
    assert Contract.from_metadata(metadata).interval_levels == levels


@pytest.mark.parametrize("version", [1, CONTRACT_VERSION - 1, CONTRACT_VERSION + 1])
def test_of_a_contract_of_another_version_the_version_is_named_not_what_it_lacks(tmp_path, version):
    metadata = make_contract(version=version).to_metadata()
    del metadata[KEY_PREFIX + "interval_factor"]
    expected = rf"'version' is {version}, expected {CONTRACT_VERSION}: export the model again"
    with pytest.raises(ModelError, match=expected):
        ModelSession(write_model(tmp_path / "old.onnx", metadata=metadata))


@pytest.mark.parametrize(
    ("graph", "message"),
    [
        ({"input_name": "input"}, r"graph input is input tensor\(float\) \[1, 12, 4, 4\], .* window tensor"),
        ({"output_name": "out"}, r"graph output is out tensor\(float\) \[1, 40, 40\], .* pattern tensor"),
        (
            {"with_deviation": True},
            r"output is pattern .*, deviation tensor\(float\) \[1, 40, 40\], but .* states pattern [^,]*, 40, 40\]$",
        ),
        (
            {"with_deviation": False, "contract": make_contract(interval_factor=1.6)},
            r"output is pattern tensor\(float\) \[1, 40, 40\], but its contract states pattern .*, deviation tensor",
        ),
        ({"element_type": TensorProto.DOUBLE}, r"graph input is window tensor\(double\)"),
        ({"input_shape": ["n", 12, 4, 4]}, r"graph input is window tensor\(float\) \['n', 12, 4, 4\]"),
        ({"input_shape": [2, 12, 4, 4]}, r"graph input is window tensor\(float\) \[2, 12, 4, 4\]"),
    ],
)
def test_a_graph_that_breaks_its_contract_is_refused_naming_the_tensor(tmp_path, graph, message):
    with pytest.raises(ModelError, match=message):
        ModelSession(write_model(tmp_path / "graph.onnx", **graph))


def test_a_contract_for_other_shapes_is_refused(tmp_path):
    metadata = make_contract(taps=2).to_metadata()
    with pytest.raises(ModelError, match=r"input is window.*12, 4, 4.*contract states.*6, 4, 4"):
        ModelSession(write_model(tmp_path / "a.onnx", metadata=metadata))
    metadata = make_contract(scale=5).to_metadata()
    with pytest.raises(ModelError, match=r"output is pattern.*1, 40, 40.*contract states.*1, 20, 20"):
        ModelSession(write_model(tmp_path / "b.onnx", metadata=metadata))


def test_no_file_a_directory_and_no_permission_are_refused(tmp_path):
    with pytest.raises(ModelError, match=r"none.onnx: cannot be read: No such file"):
        ModelSession(tmp_path / "none.onnx")
    with pytest.raises(ModelError, match=r"cannot be read: Is a directory"):
        ModelSession(tmp_path)


@pytest.mark.parametrize(("ir", "opset", "version"), [(99, None, "IR version: 99"), (None, 99, "Opset 99")])
def test_a_model_of_a_newer_onnx_is_refused_with_what_to_do(tmp_path, ir, opset, version):
    model = onnx.load(write_model(tmp_path / "new.onnx"))
    model.ir_version = ir or model.ir_version
    model.opset_import[0].version = opset or model.opset_import[0].version
    onnx.save(model, tmp_path / "new.onnx")
    remedy = rf"of a newer ONNX, {version}, than onnxruntime [\d.]+ reads: export it again .* or install a newer"
    with pytest.raises(ModelError, match=remedy):
        ModelSession(tmp_path / "new.onnx")


@pytest.mark.parametrize("content", [b"", b"not a model", bytes(range(256)) * 40])
def test_what_is_no_onnx_is_refused(tmp_path, content):
    path = tmp_path / "text.onnx"
    path.write_bytes(content)
    with pytest.raises(ModelError, match=r"text.onnx: not a model that onnxruntime can load"):
        ModelSession(path)


def test_a_cut_model_is_refused(tmp_path):
    path = write_model(tmp_path / "cut.onnx")
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ModelError, match=r"cut.onnx"):
        ModelSession(path)


@pytest.mark.parametrize("side_file", [True, False])
def test_weights_in_a_side_file_are_refused_even_in_reach(tmp_path, monkeypatch, side_file):
    model = onnx.load(write_model(tmp_path / "tiny.onnx"))
    onnx.save(model, tmp_path / "side.onnx", save_as_external_data=True, location="side.data", size_threshold=1000)
    if not side_file:
        (tmp_path / "side.data").unlink()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ModelError, match=r"side.onnx: keeps its weights in a side file, expected one file"):
        ModelSession(tmp_path / "side.onnx")


def test_one_thread_sequential_without_spinning(session):
    options = session._session.get_session_options()
    assert options.intra_op_num_threads == options.inter_op_num_threads == 1
    assert options.execution_mode == onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    assert options.get_session_config_entry("session.intra_op.allow_spinning") == "0"
    assert options.get_session_config_entry("session.set_denormal_as_zero") == "1"
    assert session._session.get_providers() == ["CPUExecutionProvider"]


@pytest.mark.parametrize("changes", [{"scale": 64}, {"traction_scale": 1}])
def test_a_contract_at_the_edge_of_what_is_lawful_is_read(changes):
    contract = make_contract(**changes)
    assert Contract.from_metadata(contract.to_metadata()) == contract

"""Session of a model: what it computes, which inputs and outputs it refuses, and which files are no model."""

import numpy as np
import onnx
import onnxruntime
import pytest
from edge_samples import make_contract, tiny_deviation, tiny_pattern, write_model
from onnx import TensorProto
from pose_samples import make_posed_contract

from edge.errors import ModelError, WindowError
from edge.inference.contract import ANY_BATCH
from edge.inference.onnx_session import ModelSession, session_options

SURE = make_contract(interval_factor=1.6)


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    return ModelSession(write_model(tmp_path_factory.mktemp("model") / "tiny.onnx"))


def random_window(seed=0, taps=4):
    return np.random.default_rng(seed).normal(size=(taps, 3, 4, 4)).astype(np.float32)


@pytest.mark.parametrize("taps", [1, 2, 4])
def test_runs_what_the_graph_says_newest_tap_first(tmp_path, taps):
    session = ModelSession(write_model(tmp_path / "tiny.onnx", make_contract(taps=taps)))
    assert session.name == "tiny" and session.contract == make_contract(taps=taps)
    window = random_window(taps=taps)
    pattern = session.run(window)
    assert pattern.shape == (40, 40) and pattern.dtype == np.float32 and session.deviation is None
    np.testing.assert_allclose(pattern, tiny_pattern(window), atol=1e-6)
    kept = pattern.copy()
    np.testing.assert_array_equal(session.run(np.asfortranarray(window)), kept)


def test_outputs_are_read_only_arrays_bound_once(tmp_path):
    session = ModelSession(write_model(tmp_path / "sure.onnx", SURE))
    first = session.run(random_window(1))
    kept, deviation = first.copy(), session.deviation
    for seed in (1, 2):
        second, expected = session.run(random_window(seed)), tiny_pattern(random_window(seed))
        np.testing.assert_allclose(second, expected, atol=1e-6)
        np.testing.assert_allclose(session.deviation, tiny_deviation(expected), atol=1e-6)
    assert np.shares_memory(deviation, session.deviation)
    assert np.shares_memory(first, second) and not np.array_equal(kept, second)
    for array in (first, deviation):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = 1


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


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_window_that_is_not_finite_is_refused(session, bad):
    window = random_window()
    window[3, 1, 2, 2] = bad
    with pytest.raises(WindowError, match="not finite"):
        session.run(window)
    with pytest.raises(WindowError, match="not finite"):
        session.run_together([random_window(1), window])


@pytest.mark.parametrize(
    ("shape", "kind"),
    [((1, 12, 4, 4), "float32"), ((3, 3, 4, 4), "float32"), ((4, 3, 4, 4), "float64"), ((4, 3, 4, 4), "int32")],
)
def test_a_window_of_wrong_shape_or_type_is_refused_with_both(session, shape, kind):
    with pytest.raises(WindowError, match=r"window is .*expected \(4, 3, 4, 4\) float32"):
        session.run(np.zeros(shape, dtype=kind))


def test_an_output_that_is_not_finite_is_never_given_out(tmp_path):
    session = ModelSession(write_model(tmp_path / "loud.onnx", gain=3e38))
    with pytest.raises(ModelError, match="'loud' gave a pattern that is not finite"):
        session.run(np.full((4, 3, 4, 4), 1e3, dtype=np.float32))
    for doubt in (0.0, -0.01, np.nan, np.inf):
        with pytest.raises(ModelError, match="'odd' gave a deviation that is not finite and above zero"):
            ModelSession(write_model(tmp_path / "odd.onnx", SURE, doubt=doubt))
    session = ModelSession(write_model(tmp_path / "far.onnx", SURE, doubt=10.0))
    window = np.zeros((4, 3, 4, 4), dtype=np.float32)
    window[0, 2, 1, 1] = 1e38  # one pixel of the deviation is enough
    with pytest.raises(ModelError, match="'far' gave a deviation that"):
        session.run(window)


def test_the_callers_arithmetic_stays_as_it_was(session):
    smallest = np.array([5e-324, 1e-310])
    session.run(np.full((4, 3, 4, 4), 1000, dtype=np.uint32).view(np.float32))
    assert (smallest * 1.0 > 0).all()


def test_one_thread_sequential_without_spinning():
    options = session_options()
    assert options.intra_op_num_threads == options.inter_op_num_threads == 1
    assert options.execution_mode == onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    assert options.get_session_config_entry("session.intra_op.allow_spinning") == "0"


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
            {"with_deviation": False, "contract": SURE},
            r"output is pattern tensor\(float\) \[1, 40, 40\], but its contract states pattern .*, deviation tensor",
        ),
        ({"element_type": TensorProto.DOUBLE}, r"graph input is window tensor\(double\)"),
        ({"input_shape": ["n", 12, 4, 4]}, r"graph input is window tensor\(float\) \['n', 12, 4, 4\]"),
        ({"input_shape": [2, 12, 4, 4]}, r"graph input is window tensor\(float\) \[2, 12, 4, 4\]"),
        (
            {"metadata": make_contract(taps=2).to_metadata()},
            r"input is window.*12, 4, 4.*contract states.*6, 4, 4",
        ),
        (
            {"metadata": make_contract(scale=5).to_metadata()},
            r"output is pattern.*1, 40, 40.*contract states.*1, 20, 20",
        ),
        (
            {"metadata": make_posed_contract(taps=4, batch=1).to_metadata()},
            r"states window .*\[1, 'taps', 3, 4, 4\], poses tensor\(float\) \[1, 'taps', 5\]",
        ),
        ({"contract": make_contract(batch=3)}, r"'batch' is 3, .*: export it again"),
        ({"metadata": {}}, r"graph\.onnx: contract key 'version' is missing"),
    ],
)
def test_a_graph_that_breaks_its_contract_is_refused_naming_what(tmp_path, graph, message):
    with pytest.raises(ModelError, match=message):
        ModelSession(write_model(tmp_path / "graph.onnx", **graph))


def test_no_file_a_directory_and_what_is_no_onnx_are_refused(tmp_path):
    with pytest.raises(ModelError, match=r"none.onnx: cannot be read: No such file"):
        ModelSession(tmp_path / "none.onnx")
    with pytest.raises(ModelError, match=r"cannot be read: Is a directory"):
        ModelSession(tmp_path)
    path = write_model(tmp_path / "cut.onnx")
    for content in (b"", b"not a model", bytes(range(256)) * 40, path.read_bytes()[:-100]):
        path.write_bytes(content)
        with pytest.raises(ModelError, match=r"cut.onnx: "):
            ModelSession(path)


@pytest.mark.parametrize(("ir", "opset", "version"), [(99, None, "IR version: 99"), (None, 99, "Opset 99")])
def test_a_model_of_a_newer_onnx_is_refused_with_what_to_do(tmp_path, ir, opset, version):
    model = onnx.load(write_model(tmp_path / "new.onnx"))
    model.ir_version = ir or model.ir_version
    model.opset_import[0].version = opset or model.opset_import[0].version
    onnx.save(model, tmp_path / "new.onnx")
    remedy = rf"of a newer ONNX, {version}, than onnxruntime [\d.]+ reads: export it again .* or install a newer"
    with pytest.raises(ModelError, match=remedy):
        ModelSession(tmp_path / "new.onnx")

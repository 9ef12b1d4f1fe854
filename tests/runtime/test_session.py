"""Session of a model: what it computes, which inputs and outputs it refuses, and which files are no model."""

from itertools import permutations

import numpy as np
import onnx
import pytest
from edge_samples import make_contract, make_pad_contract, tiny_pattern, write_model
from onnx import TensorProto
from pose_samples import make_posed_contract, posed_pattern, write_posed_model

from edge.api import PadPose
from edge.errors import ModelError, WindowError
from edge.inference.contract import pose_rows, scheduled_rows
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


def test_windows_run_together_give_what_each_gives_alone(tmp_path):
    session = ModelSession(write_model(tmp_path / "several.onnx", SURE))
    windows = [random_window(seed) for seed in range(3)]
    alone = [(session.run(window).copy(), session.deviation.copy()) for window in windows]
    for count in (3, 1, 2):
        together = session.run_together(windows[:count])
        assert together.shape == session.deviation.shape == (count, 40, 40)
        for index in range(count):
            np.testing.assert_array_equal(together[index], alone[index][0])
            np.testing.assert_array_equal(session.deviation[index], alone[index][1])


def test_a_window_not_finite_or_of_another_shape_is_refused(session):
    window = random_window()
    window[3, 1, 2, 2] = np.inf
    with pytest.raises(WindowError, match="not finite"):
        session.run_together([random_window(1), window])
    for wrong in (window[:3], window.astype(float)):
        with pytest.raises(WindowError, match=r"window is .*expected \(4, 3, 4, 4\) float32"):
            session.run(wrong)


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


def test_one_thread_without_spinning():
    options = session_options()
    assert options.intra_op_num_threads == options.inter_op_num_threads == 1
    assert options.get_session_config_entry("session.intra_op.allow_spinning") == "0"


@pytest.mark.parametrize(
    ("graph", "stated", "message"),
    [
        (make_contract(), make_contract(taps=2), r"input is window.*12, 4, 4.*contract states.*6, 4, 4"),
        (make_contract(), make_contract(scale=5), r"output is pattern.*40, 40.*contract states.*20, 20"),
        (SURE, make_contract(), r", deviation tensor\(float\) .*, 40, 40\], but .* states pattern [^,]*, 40, 40\]$"),
        (make_contract(), make_posed_contract(taps=4), r"states window .*, 'taps', 3, 4, 4\], poses .*, 'taps', 5\]"),
        (make_pad_contract(), make_pad_contract(traction_scale=3), r"3, 8, 8\], but .*, 3, 12, 12\]"),
    ],
)
def test_a_graph_that_breaks_its_contract_is_refused_naming_what(tmp_path, graph, stated, message):
    with pytest.raises(ModelError, match=message):
        ModelSession(write_model(tmp_path / "graph.onnx", graph, metadata=stated.to_metadata()))


def test_another_name_or_type_and_a_lack_of_a_contract_are_refused(tmp_path):
    path = tmp_path / "graph.onnx"
    with pytest.raises(ModelError, match=r"graph\.onnx: contract key 'version' is missing"):
        ModelSession(write_model(path, metadata={}))
    model = onnx.load(write_model(path))
    window = model.graph.input[0]
    window.type.tensor_type.elem_type = TensorProto.DOUBLE
    onnx.save(model, path)
    with pytest.raises(ModelError, match=r"graph input is window tensor\(double\)"):
        ModelSession(path)
    window.type.tensor_type.elem_type, window.name, model.graph.node[0].input[0] = TensorProto.FLOAT, "input", "input"
    onnx.save(model, path)
    with pytest.raises(ModelError, match=r"graph input is input tensor\(float\) \['any', 12, 4, 4\], .* window tensor"):
        ModelSession(path)


def test_no_file_and_a_directory_are_refused(tmp_path):
    with pytest.raises(ModelError, match=r"none.onnx: cannot be read: No such file"):
        ModelSession(tmp_path / "none.onnx")
    with pytest.raises(ModelError, match=r"cannot be read: Is a directory"):
        ModelSession(tmp_path)


def random_taps(taps, seed=0):
    """Return a window and its poses."""
    rng = np.random.default_rng(seed)
    poses = rng.normal(size=(taps, 5)).astype(np.float32)
    poses[0] = 0
    return rng.normal(size=(taps, 3, 4, 4)).astype(np.float32), poses


@pytest.fixture(scope="module")
def posed(tmp_path_factory):
    return ModelSession(write_posed_model(tmp_path_factory.mktemp("posed") / "posed.onnx"))


class TestPoses:
    def test_any_number_of_taps_runs_in_any_order(self, posed):
        for taps in range(1, 8):
            window, poses = random_taps(taps)
            np.testing.assert_allclose(posed.run(window, poses=poses), posed_pattern(window, poses), atol=1e-5)
        window, poses = random_taps(4)
        expected = posed.run(window, poses=poses).copy()
        for order in permutations((1, 2, 3)):
            again = [0, *order]
            np.testing.assert_allclose(posed.run(window[again], poses=poses[again]), expected, atol=1e-5)

    def test_windows_of_several_lengths_run_together(self, tmp_path):
        session = ModelSession(write_posed_model(tmp_path / "m.onnx", make_posed_contract(interval_factor=1.6)))
        windows, poses = zip(*(random_taps(length, seed) for seed, length in enumerate((4, 1, 7))), strict=True)
        made = zip(session.run_together(windows, None, poses).copy(), session.deviation.copy(), strict=True)
        for window, rows, (pattern, deviation) in zip(windows, poses, made, strict=True):
            np.testing.assert_allclose(pattern, posed_pattern(window, rows), atol=1e-5)
            session.run(window, poses=rows)
            np.testing.assert_allclose(deviation, session.deviation, atol=1e-6)

    def test_without_poses_taps_follow_the_schedule(self, posed):
        window, _ = random_taps(4)
        poses = scheduled_rows(4, 5.0)
        assert poses[:, 2].tolist() == [0, 5, 10, 15]
        np.testing.assert_allclose(poses[1:, 3:], [[0.2, 1.0]] * 3)
        for present in (4, 2):
            window[present:] = poses[present:] = 0
            np.testing.assert_array_equal(posed.run(window).copy(), posed.run(window, poses=poses))
        assert scheduled_rows(5, 100.0)[:, 2].tolist() == [0, 100, -160, -60, 40], "within half a turn"

    def test_poses_become_the_newest_taps_view_with_both_errors(self):
        rows = pose_rows([PadPose(10, 5, 90, 0.3, 3), PadPose(10, 7, 85, 0.4, 4)])
        assert not rows[0].any() and rows.dtype == np.float32
        np.testing.assert_allclose(rows[1], [2, 0, -5, 0.5, 5], atol=1e-6)

    @pytest.mark.parametrize(
        ("taps", "poses", "match"),
        [
            (8, np.zeros((8, 5)), r"window is \(8, 3, 4, 4\) float32, expected \(1 to 7, 3, 4, 4\) float32"),
            (0, np.zeros((0, 5)), r"window is \(0, 3, 4, 4\)"),
            (2, np.zeros((3, 5)), r"poses are \(3, 5\) float32, expected \(2, 5\) float32: dx_mm, .* of each tap"),
            (2, np.ones((2, 5)), r"newest tap's pose is \[1.0, .*expected zeros: give poses as that tap"),
            (2, np.array([[0] * 5, [np.nan] * 5]), "poses have values that are not finite"),
        ],
    )
    def test_windows_and_poses_that_mean_nothing_are_refused(self, posed, taps, poses, match):
        with pytest.raises(WindowError, match=match):
            posed.run(np.zeros((taps, 3, 4, 4), np.float32), poses=poses.astype(np.float32))

    def test_poses_of_another_type_or_for_another_model_are_refused(self, posed, session):
        with pytest.raises(WindowError, match=r"poses are \(2, 5\) float64"):
            posed.run(np.zeros((2, 3, 4, 4), np.float32), poses=np.zeros((2, 5)))
        with pytest.raises(WindowError, match="poses are given, but model 'tiny' takes none: leave them out"):
            session.run(np.zeros((4, 3, 4, 4), np.float32), poses=np.zeros((4, 5), np.float32))

"""Files and models made to harm: each is refused in one line, before it costs time or memory."""

import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from edge_samples import make_contract, save_graph, write_model
from hostile_samples import archive, npy, one_line, recording_arrays, stored
from onnx import TensorProto, helper

from edge.errors import EdgeError, ModelError
from edge.evaluation.test_set import load_frozen_set
from edge.inference import onnx_guard
from edge.inference.onnx_guard import check_plain, read_model
from edge.inference.onnx_session import ModelSession
from firmware_bridge.errors import NpzError, RecordingError
from firmware_bridge.in_place import read_bounded
from firmware_bridge.recording import csv_reader
from firmware_bridge.recording import npz_recording as recording
from firmware_bridge.recording.csv_reader import csv_header
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.recording.npz_recording import read_npz
from firmware_bridge.zeroing.baseline import load_baselines
from train.data.presses import load_presses
from train.errors import DatasetError


class Harm:
    """Leaves a file where it was unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_a_file_without_end_is_read_up_to_the_limit():
    with pytest.raises(OSError, match="larger than the 1,000 bytes"):
        read_bounded(Path("/dev/zero"), 1000)
    for read, error in ((load_baselines, RecordingError), (read_model, ModelError)):
        with pytest.raises(error, match=r"/dev/zero: cannot be read: larger than the [0-9,]+ bytes"):
            read(Path("/dev/zero"))


@pytest.mark.parametrize("how", ["pickle", "array of objects", "npy"])
@pytest.mark.parametrize(
    ("name", "read", "error"),
    [
        ("finger.npz", load_recording, RecordingError),
        ("frozen.npz", load_frozen_set, EdgeError),
        ("presses.npz", load_presses, DatasetError),
    ],
)
def test_no_reader_of_arrays_runs_what_is_pickled(tmp_path, name, read, error, how):
    """Nor do checkpoints: tests/training/test_training.py."""
    path, harm = tmp_path / name, tmp_path / "harm"
    if how == "pickle":
        path.write_bytes(pickle.dumps(Harm(harm)))
    elif how == "npy":
        with path.open("wb") as file:
            np.save(file, np.array([Harm(harm)], dtype=object), allow_pickle=True)
    else:
        names = (*recording_arrays(), "newest", "schema", "facts", "surfaces")
        np.savez(path, **dict.fromkeys(names, np.array([Harm(harm)], dtype=object)))
    with pytest.raises(error) as raised:
        read(path)
    assert one_line(raised) and not harm.exists()


def with_member(name: str, old: bytes, new: bytes) -> bytes:
    """Return a recording of which one member has other bytes, which numpy does not write."""
    spoilt = npy(recording_arrays()[name]).replace(old, new, 1)
    others = {other: npy(value) for other, value in recording_arrays().items() if other != name}
    return stored({name: spoilt} | others)


BOMB = archive(compressed=True, **recording_arrays() | {"counts": np.zeros((300_000, 3, 4, 4), np.int8)})


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (BOMB, r"arrays of 14,400,\d+ bytes, expected at most 1,048,576"),
        (
            with_member("counts", b"(2, 3, 4, 4), }       ", b"(9999999999, 3, 4, 4)}"),
            "states 1919999999808 bytes and holds",
        ),
        (with_member("counts", b"(2, 3, 4, 4)", f"({1 << 32}, {1 << 32})".encode()), "counts.npy|not a whole"),
        (with_member("sensor", b"4\0\0\0", b"\0\0\x11\0"), "not Unicode"),
        (with_member("sensor", b"4\0\0\0", b"\0\xd8\0\0"), "not Unicode"),
        (with_member("sensor", b"'shape': (2,)", b"'shape': ((((("), "not a whole"),
        (stored({f"{number:060000d}": b"" for number in range(20)}), r"a piece of 1,\d+,\d+ bytes, expected at most"),
        (stored({"counts": npy(np.zeros(3))}, zipfile.ZIP_BZIP2), "compressed in another way"),
    ],
    ids=range(8),
)
def test_archives_made_to_harm(tmp_path, limits, bounded_memory, content, complaint):
    if content is BOMB:
        assert len(content) < 50_000
        limits(recording, MOST_NPZ_BYTES=1 << 20)
    (tmp_path / "finger.npz").write_bytes(content)
    with pytest.raises(RecordingError, match=complaint) as raised:
        load_recording(tmp_path / "finger.npz")
    assert one_line(raised)


def test_of_an_archive_what_is_asked_for_alone_is_read(tmp_path):
    path = tmp_path / "two.npz"
    np.savez(path, wanted=np.arange(3), other=np.array([object()], dtype=object))
    assert read_npz(path, ["wanted", "absent"], 1000)["wanted"].tolist() == [0, 1, 2]
    with pytest.raises(NpzError, match="plain arrays"):
        read_npz(path, ["other"], 1000)


def test_a_csv_line_without_end_and_a_file_larger_than_is_read(tmp_path, bounded_memory, limits):
    path = tmp_path / "finger.csv"
    with path.open("wb") as file:
        file.write((",".join(csv_header()) + "\n").encode())
        file.truncate(1 << 32)
    with pytest.raises(RecordingError, match="line 2: a line longer than 16384 bytes"):
        load_recording(path)
    limits(csv_reader, MOST_CSV_BYTES=1000)
    path.write_text(",".join(csv_header()) + "\n" + (",".join(["1"] * 48) + "\n") * 10)
    with pytest.raises(RecordingError, match=r"larger than 1,000 bytes, expected a smaller one"):
        load_recording(path)


# Models, before onnxruntime sees them.


def in_graph(tensor: bytes) -> bytes:
    """A model of nothing but these weights, which may be messages in a row."""
    return bytes([7 << 3 | 2, len(tensor) + 2, 5 << 3 | 2, len(tensor)]) + tensor


def of_graph(**parts: Any) -> bytes:
    return onnx.ModelProto(graph=onnx.GraphProto(**parts)).SerializeToString()


INNER = helper.make_graph([], "inner", [], [])
OUTSIDE = TensorProto(name="w", data_location=TensorProto.EXTERNAL).SerializeToString()
SEVEN = in_graph(OUTSIDE)
"""A model as bytes, which begin with the tag of a graph, 0x3a."""
REFUSED = [
    # Protocol Buffers join messages that come twice, and of numbers the last one counts.
    (in_graph(OUTSIDE + TensorProto(data_location=TensorProto.DEFAULT).SerializeToString()), "side file"),
    (of_graph(node=[helper.make_node("If", ["x"], ["y"], then_branch=INNER)]), "graphs within its graph|operator 'If'"),
    (of_graph(node=[helper.make_node("Relu", ["x"], ["y"], body=INNER)]), "graphs within its graph"),
    (onnx.ModelProto(functions=[onnx.FunctionProto(name="f")]).SerializeToString(), "graphs within its graph"),
    (of_graph(sparse_initializer=[onnx.SparseTensorProto(dims=[1 << 40])]), "sparse"),
    # The encoding is read as onnxruntime reads it: a tag may be written longer than it must.
    (b"\xba\x00" + SEVEN[1:], "side file"),
    *((broken + SEVEN[1:], "damaged") for broken in (b"\xba\x80\x80\x80\x80\x00", b"\xba\x80\x80\x80\x10")),
    *((broken, "damaged") for broken in (b"\x3b", b"\x02\x00")),
    (b"\x08\x01" * 1001, "more than 1000 fields"),
]


def outside(tmp_path, location: str, where: str) -> Path:
    """A model whose weights lie elsewhere, in an initializer or in a node's attribute."""
    tensor = TensorProto(name="w", data_type=1, dims=[4], data_location=TensorProto.EXTERNAL)
    tensor.external_data.add(key="location", value=location)
    take = [helper.make_node("Constant", [], ["w"], value=tensor)] if where == "attribute" else []
    nodes = [*take, helper.make_node("Add", ["x", "w"], ["y"])]
    ends = [helper.make_tensor_value_info(name, 1, [4]) for name in "xy"]
    graph = helper.make_graph(nodes, "g", ends[:1], ends[1:], [] if take else [tensor])
    path = tmp_path / "models" / "m.onnx"
    path.parent.mkdir()
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=10)
    path.write_bytes(model.SerializeToString())
    return path


@pytest.mark.parametrize("where", ["initializer", "attribute"])
@pytest.mark.parametrize("location", ["../../etc/passwd", "{}/secret", "link", "beside", ""])
def test_weights_in_another_file_never_reach_onnxruntime(tmp_path, monkeypatch, location, where):
    (tmp_path / "secret").write_bytes(bytes(16))
    path = outside(tmp_path, location.format(tmp_path), where)
    (path.parent / "link").symlink_to(tmp_path / "secret")
    (path.parent / "beside").write_bytes(bytes(16))
    monkeypatch.setattr("onnxruntime.InferenceSession", lambda *_, **__: pytest.fail("it was asked"))
    with pytest.raises(ModelError, match=r"m.onnx: keeps its weights in a side file, expected one file") as raised:
        ModelSession(path)
    assert one_line(raised)


@pytest.mark.parametrize(("model", "words"), REFUSED)
def test_what_is_no_plain_graph_is_refused(model, words, limits):
    limits(onnx_guard, MOST_FIELDS=1000)
    with pytest.raises(ModelError, match=words):
        check_plain(model)


def test_names_that_are_not_text_are_one_line_and_no_stdout(tmp_path, capfd):
    path = write_model(tmp_path / "tiny.onnx")
    for name in (b"Squeeze", b"tactile.sensor", b"window"):
        content = path.read_bytes()
        (tmp_path / "odd.onnx").write_bytes(content.replace(name, b"\xe5" * len(name)))
        with pytest.raises(ModelError) as raised:
            ModelSession(tmp_path / "odd.onnx")
        assert one_line(raised)
    assert capfd.readouterr().out == ""


def test_weights_that_are_larger_than_their_file(tmp_path):
    path = write_model(tmp_path / "huge.onnx")
    model = onnx.load(path)
    model.graph.initializer[0].dims[0] = 1 << 40
    onnx.save(model, path)
    with pytest.raises(ModelError, match=r"huge\.onnx: not a model that onnxruntime can load: .*weights") as raised:
        ModelSession(path)
    assert one_line(raised)


def test_an_array_that_no_machine_holds(tmp_path):
    contract = make_contract(taps=1)
    nodes = [
        helper.make_node("ConstantOfShape", ["shape"], ["huge"]),
        helper.make_node("ReduceSum", ["huge"], ["sum"], keepdims=0),
        helper.make_node("ReduceMax", ["window"], ["newest"], axes=[2, 3]),
        helper.make_node("ReduceMax", ["newest"], ["most"], axes=[1], keepdims=0),  # of each window
        helper.make_node("Add", ["most", "sum"], ["more"]),
        helper.make_node("Add", ["blank", "more"], ["pattern"]),
    ]
    blank = np.zeros((1, *contract.pattern_shape), np.float32)
    constants = {"shape": np.array([1 << 30, 1 << 20]), "blank": blank}
    path = save_graph(tmp_path / "huge.onnx", nodes, contract, constants, contract.to_metadata())
    with pytest.raises(ModelError, match=r"huge\.onnx: .*allocate") as raised:
        ModelSession(path)
    assert one_line(raised)

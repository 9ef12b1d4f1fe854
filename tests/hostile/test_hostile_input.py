"""Files and models made to harm: each is refused in one line, before it costs time or memory."""

import io
import pickle
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hostile_samples import archive, npy, one_line, recording_arrays, stored

from edge.errors import EdgeError, ModelError
from edge.evaluation.test_set import load_frozen_set
from edge.inference.onnx_guard import read_model
from firmware_bridge.errors import NpzError, RecordingError
from firmware_bridge.in_place import read_bounded
from firmware_bridge.recording import csv_reader
from firmware_bridge.recording import npz_recording as recording
from firmware_bridge.recording.csv_reader import CSV_HEADER
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
    for read, error in ((load_baselines, RecordingError), (load_recording, RecordingError), (read_model, ModelError)):
        with pytest.raises(error):
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


def zipped(kind: int = zipfile.ZIP_STORED, **members: bytes) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", kind) as whole:
        for name, content in members.items():
            whole.writestr(name, content)
    return file.getvalue()


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
        (zipped(**{f"{number:060000d}": b"" for number in range(20)}), r"a piece of 1,\d+,\d+ bytes, expected at most"),
        (zipped(zipfile.ZIP_BZIP2, **{"counts.npy": npy(np.zeros(3))}), "compressed in another way"),
        (zipped(zipfile.ZIP_LZMA, **{"counts.npy": npy(np.zeros(3))}), "compressed in another way"),
    ],
    ids=range(9),
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


def test_a_csv_line_without_end(tmp_path, bounded_memory):
    path = tmp_path / "finger.csv"
    with path.open("wb") as file:
        file.write((",".join(CSV_HEADER) + "\n").encode())
        file.truncate(1 << 32)
    with pytest.raises(RecordingError, match="line 2: a line longer than 16384 bytes"):
        load_recording(path)


def test_a_csv_file_larger_than_is_read(tmp_path, limits):
    limits(csv_reader, MOST_CSV_BYTES=1000)
    path = tmp_path / "finger.csv"
    path.write_text(",".join(CSV_HEADER) + "\n" + (",".join(["1"] * 48) + "\n") * 10)
    with pytest.raises(RecordingError, match=r"larger than 1,000 bytes, expected a smaller one"):
        load_recording(path)

"""Files and models made to harm: each is refused in one line, before it costs time or memory."""

import io
import json
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
from train.errors import CheckpointError, DatasetError
from train.learning.checkpoint import load_network


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


class TestPickles:
    def readers(self):
        yield "finger.npz", load_recording, RecordingError
        yield "frozen.npz", load_frozen_set, EdgeError
        yield "presses.npz", load_presses, DatasetError

    @pytest.mark.parametrize("how", ["pickle", "array of objects", "npy"])
    def test_no_reader_of_arrays_runs_what_is_pickled(self, tmp_path, how):
        for name, read, error in self.readers():
            path, harm = tmp_path / name, tmp_path / "harm"
            if how == "pickle":
                path.write_bytes(pickle.dumps(Harm(harm)))
            elif how == "npy":
                with path.open("wb") as file:
                    np.save(file, np.array([Harm(harm)], dtype=object), allow_pickle=True)
            else:
                objects = np.array([Harm(harm)], dtype=object)
                names = (*recording_arrays(), "newest", "schema", "facts", "surfaces")
                np.savez(path, **dict.fromkeys(names, objects))
            with pytest.raises(error) as raised:
                read(path)
            assert one_line(raised) and not harm.exists()

    def test_nor_do_checkpoints(self, tmp_path):
        harm = tmp_path / "harm"
        path = tmp_path / "stsr.pt"
        path.write_bytes(pickle.dumps(Harm(harm)))
        report = {"network": "compact-stsr", "scale": 10, "options": {}}
        path.with_suffix(".json").write_text(json.dumps(report))
        with pytest.raises(CheckpointError) as raised:
            load_network(path)
        assert one_line(raised) and not harm.exists()


class TestArchives:
    def refused(self, tmp_path, content: bytes, complaint: str) -> None:
        path = tmp_path / "finger.npz"
        path.write_bytes(content)
        with pytest.raises(RecordingError, match=complaint) as raised:
            load_recording(path)
        assert one_line(raised)

    def test_a_bomb(self, tmp_path, limits, bounded_memory):
        limits(recording, MOST_NPZ_BYTES=1 << 20)
        bomb = archive(compressed=True, **recording_arrays() | {"counts": np.zeros((300_000, 3, 4, 4), np.int8)})
        assert len(bomb) < 50_000
        self.refused(tmp_path, bomb, r"arrays of 14,400,\d+ bytes, expected at most 1,048,576")

    def test_an_array_larger_than_its_member(self, tmp_path, bounded_memory):
        header = npy(np.zeros((1, 3, 4, 4), np.int32)).replace(b"(1, 3", b"(9999999999, 3").replace(b" " * 9, b"", 1)
        self.refused(tmp_path, stored({"counts": header} | members("counts")), "states 1919999999808 bytes and holds")

    def test_a_table_of_contents_that_is_large(self, tmp_path, bounded_memory):
        file = io.BytesIO()
        with zipfile.ZipFile(file, "w") as whole:
            for number in range(20):
                whole.writestr(f"{number:060000d}", b"")
        self.refused(tmp_path, file.getvalue(), r"a piece of 1,\d+,\d+ bytes, expected at most 1,048,576")

    @pytest.mark.parametrize("kind", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
    def test_other_compressions(self, tmp_path, kind):
        file = io.BytesIO()
        with zipfile.ZipFile(file, "w", kind) as whole:
            whole.writestr("counts.npy", npy(np.zeros(3)))
        self.refused(tmp_path, file.getvalue(), "compressed in another way")

    @pytest.mark.parametrize(
        ("name", "old", "new", "complaint"),
        [
            ("counts", b"(2, 3, 4, 4)", f"({1 << 32}, {1 << 32})".encode(), "counts.npy|not a whole"),  # wraps round
            ("sensor", b"4\0\0\0", b"\0\0\x11\0", "not Unicode"),
            ("sensor", b"4\0\0\0", b"\0\xd8\0\0", "not Unicode"),
            ("sensor", b"'shape': (2,)", b"'shape': (((((", "not a whole"),
        ],
    )
    def test_a_member_that_numpy_does_not_write(self, tmp_path, name, old, new, complaint):
        spoilt = npy(recording_arrays()[name]).replace(old, new)
        self.refused(tmp_path, stored({name: spoilt} | members(name)), complaint)

    def test_what_is_asked_for_alone_is_read(self, tmp_path):
        path = tmp_path / "two.npz"
        np.savez(path, wanted=np.arange(3), other=np.array([object()], dtype=object))
        assert read_npz(path, ["wanted", "absent"], 1000)["wanted"].tolist() == [0, 1, 2]
        with pytest.raises(NpzError, match="plain arrays"):
            read_npz(path, ["other"], 1000)


def members(without: str) -> dict[str, bytes]:
    return {name: npy(value) for name, value in recording_arrays().items() if name != without}


class TestText:
    def test_a_csv_line_without_end(self, tmp_path, bounded_memory):
        path = tmp_path / "finger.csv"
        with path.open("wb") as file:
            file.write((",".join(CSV_HEADER) + "\n").encode())
            file.truncate(1 << 32)
        with pytest.raises(RecordingError, match="line 2: a line longer than 16384 bytes"):
            load_recording(path)

    def test_a_csv_file_larger_than_is_read(self, tmp_path, limits):
        limits(csv_reader, MOST_CSV_BYTES=1000)
        path = tmp_path / "finger.csv"
        path.write_text(",".join(CSV_HEADER) + "\n" + (",".join(["1"] * 48) + "\n") * 10)
        with pytest.raises(RecordingError, match=r"larger than 1,000 bytes, expected a smaller one"):
            load_recording(path)

import copyreg
import functools
import io
import os
import pickle
import sys
from collections import OrderedDict

import numpy as np
import pytest
from numpy.lib import format as npy

from train.data.authors_files import FRAMES_KEPT, kept_frames, load_authors_taps
from train.data.plain_pickle import load_plain, plain_value
from train.errors import DatasetError

RAN = []


def press(frames=60, peak=1.0, seed=0):
    """Readings (frames, 48) of a press that rises to its peak at three quarters and falls."""
    course = np.interp(np.arange(frames), [0, 0.75 * frames, frames - 1], [0, peak, 0])
    return course[:, None] * np.random.default_rng(seed).uniform(50, 150, 48)


def records(count=4, **changes):
    made = np.empty((count, 1), dtype=object)  # their code takes each record out of a row of one
    for i in range(count):
        made[i, 0] = {"sample_idx": i * 20, "depth": np.full((20, 20), i / 10), "LRs": press(seed=i)} | changes
    return made


def write(path, array, protocol=4, old_names=False):
    """An npy file of an object array, pickled with any protocol, numpy's modules called as before numpy 2 or not."""
    file = io.BytesIO()
    npy.write_array_header_1_0(file, {"descr": "|O", "fortran_order": False, "shape": array.shape})
    body = pickle.dumps(array, protocol)
    if old_names:
        body = rename(body)
    path.write_bytes(file.getvalue() + body)
    return path


def rename(body: bytes) -> bytes:
    """The same pickle with numpy._core called numpy.core; lengths of short strings are counted anew."""
    for name in (b"numpy._core.multiarray", b"numpy._core.numeric"):
        new = name.replace(b"_core", b"core")
        body = body.replace(b"\x8c" + bytes([len(name)]) + name, b"\x8c" + bytes([len(new)]) + new)
        body = body.replace(b"c" + name + b"\n", b"c" + new + b"\n")
    # Frames (protocol 4 and later) say their length: unpicklers take longer ones for cut short, so take them out.
    start = body.find(b"\x95")
    return body if start < 0 or start > 2 else body[:start] + body[start + 9 :]


@pytest.mark.parametrize("old_names", [False, True])
@pytest.mark.parametrize("protocol", range(6))
def test_files_of_every_protocol_load(tmp_path, protocol, old_names):
    made = records()
    taps = load_authors_taps(write(tmp_path / "C.npy", made, protocol, old_names))
    assert len(taps) == 4
    assert taps.counts.shape == (4, FRAMES_KEPT, 3, 4, 4)
    assert taps.position.tolist() == [0, 2, 4, 6]  # records 0, 20, 40, 60 of nine rotations each
    assert taps.angle_deg.tolist() == [0, 10, 20, 30]
    for i in range(4):
        assert np.array_equal(taps.depth[i], made[i, 0]["depth"])
        assert np.array_equal(taps.counts[i], kept_frames(made[i, 0]["LRs"]))


def test_a_file_as_numpy_saves_it_and_other_forms_of_the_same(tmp_path):
    plain = records()
    np.save(tmp_path / "a.npy", plain)
    np.save(tmp_path / "b.npy", plain[:, 0])
    listed = records()
    for i in range(4):
        record = listed[i, 0]
        record["LRs"] = list(record["LRs"]) if i % 2 else record["LRs"].tolist()
        record["depth"] = np.asfortranarray(record["depth"]).astype(">f8")
        record["sample_idx"] = np.int64(record["sample_idx"])
        record["something"] = ["else", 1.5, None, True, {"in": np.float32(2)}]
    np.save(tmp_path / "c.npy", listed)
    first, second, third = (load_authors_taps(tmp_path / f"{name}.npy") for name in "abc")
    assert (first.counts == second.counts).all()
    assert (first.counts == third.counts).all()
    assert all((a == b).all() for a, b in zip(first.depth, third.depth, strict=True))


def test_taxels_interleave_their_axes_and_rows_count_from_the_bottom():
    readings = np.zeros((1, 48))
    readings[0] = np.arange(48)
    scan = kept_frames(readings)[0]
    for taxel in range(16):
        row, col = divmod(taxel, 4)
        assert scan[:, 3 - row, col].tolist() == [3 * taxel, 3 * taxel + 1, 3 * taxel + 2]


def test_frames_are_kept_from_three_tenths_of_the_largest_sum_up_to_it():
    readings = press(frames=400)
    force = kept_frames(readings)[:, 2].sum(axis=(1, 2))
    whole = readings[:, 2::3].sum(axis=1)
    assert force[-1] == pytest.approx(whole.max())
    assert 0.3 * whole.max() <= force[0] < 0.31 * whole.max()
    assert np.allclose(np.diff(force), np.diff(force).mean(), rtol=0.05)
    short = kept_frames(press(frames=8))
    assert short.shape == (FRAMES_KEPT, 3, 4, 4)
    assert (np.diff(short[:, 2].sum(axis=(1, 2))) >= 0).all()
    for nothing in (np.zeros((5, 48)), -press(), np.zeros((0, 48))):
        with pytest.raises(ValueError, match="no frame has a positive sum"):
            kept_frames(nothing)


class Hostile:
    """Pickles as a call of a function with arguments."""

    def __init__(self, function, *arguments, state=None):
        self.call = (function, arguments) if state is None else (function, arguments, state)

    def __reduce__(self):
        return self.call


def ran(*arguments):
    RAN.append(arguments)


HOSTILE = {
    "os.system": lambda path: Hostile(os.system, f"touch {path}"),
    "eval": lambda path: Hostile(eval, f"open({str(path)!r}, 'w')"),
    "exec": lambda path: Hostile(exec, f"open({str(path)!r}, 'w')"),
    "getattr": lambda path: Hostile(getattr, dict, "fromkeys"),
    "our own": lambda path: Hostile(ran, path),
    "partial": lambda path: Hostile(functools.partial, ran, path),
    "numpy.load": lambda path: Hostile(np.load, str(path), None, True),
    "numpy.fromfile": lambda path: Hostile(np.fromfile, "/etc/hostname", "u1"),
    "numpy.memmap": lambda path: Hostile(np.memmap, str(path), "u1", "w+", 0, (1,)),
    "numpy.testing": lambda path: Hostile(np.testing.measure, f"open({str(path)!r}, 'w')"),
    "import": lambda path: Hostile(__import__, "antigravity"),
    "copyreg": lambda path: Hostile(copyreg._reconstructor, OrderedDict, object, None),
    "a class": lambda path: OrderedDict(a=1),
    "nested": lambda path: {"depth": [{"deep": Hostile(os.system, f"touch {path}")}]},
    "as state": lambda path: Hostile(np.dtype, "f8", state=Hostile(os.system, f"touch {path}")),
    "set": lambda path: {Hostile(os.system, f"touch {path}")},
    "complex": lambda path: 1j,
    "datetime array": lambda path: np.zeros(2, "M8[s]"),
    "structured array": lambda path: np.zeros(2, [("a", "f8")]),
    "dtype with metadata": lambda path: np.zeros(2, np.dtype("f8", metadata={"a": 1})).astype(
        np.dtype("f8", metadata={"a": 1})
    ),
    "subclass": lambda path: np.ma.masked_array([1.0]),
}


@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
@pytest.mark.parametrize("attack", HOSTILE)
def test_a_hostile_pickle_is_refused_before_it_runs(tmp_path, attack, protocol):
    RAN.clear()
    proof = tmp_path / "proof"
    before = set(sys.modules)
    for array in (records(2, depth=HOSTILE[attack](proof)), np.array([[HOSTILE[attack](proof)]], dtype=object)):
        path = write(tmp_path / "C.npy", array, protocol)
        with pytest.raises(DatasetError) as raised:
            load_authors_taps(path)
        assert "\n" not in str(raised.value)
    assert not proof.exists()
    assert not RAN
    assert "antigravity" not in set(sys.modules) - before


def test_the_refusal_names_what_was_named(tmp_path):
    path = write(tmp_path / "C.npy", records(1, depth=Hostile(os.system, "true")), 4)
    with pytest.raises(DatasetError, match=r"C\.npy .* names (posix|nt)\.system, which no array needs"):
        load_authors_taps(path)


def op(*parts: bytes) -> io.BytesIO:
    return io.BytesIO(b"\x80\x04" + b"".join(parts) + b".")


DTYPE = b"cnumpy\ndtype\n"
ARRAY = b"cnumpy._core.multiarray\n_reconstruct\n"
NDARRAY = b"cnumpy\nndarray\n"
F8 = DTYPE + b"(X\x02\x00\x00\x00f8tR"
OBJECT = DTYPE + b"(X\x02\x00\x00\x00O8tR"
BARE = ARRAY + b"(" + NDARRAY + b"K\x00tR"
LIES = {
    "a function with a state": ARRAY + b"}X\x01\x00\x00\x00aK\x01sb",
    "a dtype with fields": F8 + b"(K\x03X\x01\x00\x00\x00<N(K\x01t}K\x08K\x01K\x10tb",
    "ndarray called": NDARRAY + b"(K\x05tR",
    "ndarray made new": NDARRAY + b")\x81",
    "an array of a function": ARRAY + b"(" + DTYPE + b"K\x00tR",
    "fewer bytes than the shape": BARE + b"(K\x01(K\x09t" + F8 + b"\x89C\x08" + bytes(8) + b"tb",
    "an overflowing shape": BARE + b"(K\x01(I4294967296\nI4294967296\nt" + F8 + b"\x89C\x00tb",
    "a negative shape": BARE + b"(K\x01(I-1\nI-1\nt" + F8 + b"\x89C\x08" + bytes(8) + b"tb",
    "fewer objects than the shape": BARE + b"(K\x01(K\x09t" + OBJECT + b"\x89]tb",
    "objects made of bytes": BARE + b"(K\x01(K\x01t" + OBJECT + b"\x89C\x08" + bytes(8) + b"tb",
    "a number made of an object": b"cnumpy._core.multiarray\nscalar\n(" + OBJECT + b"](K\x01etR",
    "a codec of its own": b"c_codecs\nencode\n(X\x01\x00\x00\x00aX\x05\x00\x00\x00rot13tR",
    "an inner name": b"cnumpy\nndarray.tofile\n",
    "a persistent object": b"X\x01\x00\x00\x00aQ",
    "an extension": b"\x82\x01",
    "a string of no length": DTYPE + b"(X\x02\x00\x00\x00U0tR",
}


@pytest.mark.parametrize("lie", LIES)
def test_lies_that_numpy_would_believe_are_refused_and_leave_nothing_behind(tmp_path, lie):
    with pytest.raises((pickle.UnpicklingError, ValueError)):
        load_plain(op(LIES[lie]))
    assert len(load_authors_taps(write(tmp_path / "C.npy", records(2)))) == 2


def test_a_dtypes_own_word_about_its_size_is_not_taken():
    larger = F8 + b"(K\x03X\x01\x00\x00\x00>NNNM\xff\x7fM\xff\x7fK\x3ftb"
    array = load_plain(op(BARE + b"(K\x01(K\x01t" + larger + b"\x89C\x08" + np.array([1.5], ">f8").tobytes() + b"tb"))
    assert array.dtype == np.dtype(">f8")
    assert array.tolist() == [1.5]
    assert load_plain(op(BARE)) is None


def test_an_array_does_not_share_bytes_that_go_on_changing():
    """numpy would not hold on to a bytearray, which moves when it grows: the array would show freed memory."""
    buffer = b"\x96" + (8).to_bytes(8, "little") + np.array([1.5]).tobytes() + b"\x94"
    array = b"cnumpy._core.numeric\n_frombuffer\n(" + buffer + F8 + b"K\x01\x85X\x01\x00\x00\x00CtR"
    grown = b"h\x00(" + b"K\x00" * 4096 + b"e0"
    value = load_plain(op(array + grown))
    assert value.tolist() == [1.5] and isinstance(value.base, bytes)


def test_any_byte_may_be_broken(tmp_path):
    whole = write(tmp_path / "C.npy", records(1)).read_bytes()
    rng = np.random.default_rng(0)
    for cut in [*range(0, 400, 3), *rng.integers(400, len(whole), 50)]:
        (tmp_path / "C.npy").write_bytes(whole[:cut])
        with pytest.raises(DatasetError):
            load_authors_taps(tmp_path / "C.npy")
    for place in [*range(0, 600, 2), *rng.integers(600, len(whole), 50)]:
        broken = bytearray(whole)
        broken[place] ^= 1 << rng.integers(8)
        (tmp_path / "C.npy").write_bytes(bytes(broken))
        try:
            load_authors_taps(tmp_path / "C.npy")
        except DatasetError as error:
            assert "\n" not in str(error)


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"sample_idx": 81}, "record 81: expected 0 to 80"),
        ({"sample_idx": 3}, "two records of one sample_idx"),
        ({"sample_idx": 1.5}, "sample_idx is 1.5, expected a whole number"),
        ({"sample_idx": True}, "sample_idx is True"),
        ({"LRs": np.zeros((5, 47))}, r"LRs has shape \(5, 47\), expected \(frames, 48\)"),
        ({"LRs": np.zeros((5, 48))}, "no frame has a positive sum"),
        ({"LRs": np.full((5, 48), np.nan)}, "LRs holds values that are not finite"),
        ({"LRs": "text"}, "LRs is str, expected numbers"),
        ({"LRs": [[1.0] * 48, [1.0] * 47]}, "record 0: "),
        ({"LRs": [["a"] * 48]}, "LRs holds something else than numbers"),
        ({"LRs": []}, "LRs is float64"),
        ({"depth": np.zeros(5)}, r"depth is float64 \(5,\)"),
        ({"depth": np.array([["a"]])}, "depth is <U1"),
        ({"depth": None}, "depth is NoneType"),
    ],
)
def test_records_that_are_not_as_they_should_be_are_named(tmp_path, changes, complaint):
    with pytest.raises(DatasetError, match=complaint):
        load_authors_taps(write(tmp_path / "C.npy", records(2, **changes)))


def test_other_files_are_refused(tmp_path):
    path = tmp_path / "C.npy"
    with pytest.raises(DatasetError, match="cannot be read: No such file"):
        load_authors_taps(path)
    np.save(path, np.zeros((3, 4)))
    with pytest.raises(DatasetError, match="its array is of float64, expected objects"):
        load_authors_taps(path)
    for array, complaint in (
        (np.empty((0, 1), dtype=object), "no records"),
        (np.array([1, 2], dtype=object), "record 0 has int, expected a dict"),
        (np.array([{"depth": 1}], dtype=object), "record 0 has depth, expected a dict with sample_idx, depth, LRs"),
    ):
        with pytest.raises(DatasetError, match=complaint):
            load_authors_taps(write(path, array))
    write(path, records(2))
    path.write_bytes(path.read_bytes().replace(b"'shape': (2, 1)", b"'shape': (3, 1)"))
    with pytest.raises(DatasetError, match="header tells"):
        load_authors_taps(path)


def test_a_list_that_holds_itself_does_not_hang(tmp_path):
    loop = []
    loop.append(loop)
    with pytest.raises(DatasetError):
        load_authors_taps(write(tmp_path / "C.npy", records(1, LRs=loop)))
    assert plain_value(loop) is loop

import json
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.errors import MessageError
from edge.sinks.binary_message import pack, unpack

NAMES = st.text(max_size=8)
SHAPES = st.lists(st.integers(0, 4), max_size=3).map(tuple)
HEADERS = st.dictionaries(NAMES.filter(lambda name: name != "maps"), st.none() | st.integers(-(2**53), 2**53) | NAMES)


@given(HEADERS, st.dictionaries(NAMES, SHAPES, max_size=4))
def test_what_was_packed_is_unpacked(header, shapes):
    rng = np.random.default_rng(1)
    maps = {name: rng.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}
    message = pack(header, maps)
    got_header, got_maps = unpack(message)
    assert got_header == {**header, "maps": [[name, list(shape)] for name, shape in shapes.items()]}
    assert got_maps.keys() == maps.keys()
    for name, values in maps.items():
        assert np.array_equal(got_maps[name], values) and got_maps[name].shape == values.shape


def test_the_layout_is_as_documented():
    message = pack({"a": 1}, {"z": np.array([[1, 2.5]]), "y": np.array([3])})
    (length,) = struct.unpack("<I", message[:4])
    assert (4 + length) % 4 == 0
    assert json.loads(message[4 : 4 + length]) == {"a": 1, "maps": [["z", [1, 2]], ["y", [1]]]}
    assert message[4 + length :] == struct.pack("<3f", 1, 2.5, 3)


GOOD = pack({"kind": "result"}, {"pattern": np.ones((2, 2))})


@pytest.mark.parametrize("end", range(len(GOOD)))
def test_a_message_cut_short_is_refused(end):
    with pytest.raises(MessageError):
        unpack(GOOD[:end])


@pytest.mark.parametrize(
    "bad",
    [
        b"",
        GOOD + b"0000",
        struct.pack("<I", 2) + b"[]",
        struct.pack("<I", 12) + b'{"maps": 1} ',
        struct.pack("<I", 24) + b'{"maps": [["a", [-1]]]} ',
        struct.pack("<I", 32) + b'{"maps": [["a", [99999999999]]]}',
        struct.pack("<I", 0xFFFFFFFF) + b"{}",
    ],
)
def test_what_is_no_message_is_refused(bad):
    with pytest.raises(MessageError):
        unpack(bad)

"""Targets of the fuzzer that are models, data sets or records of runs."""

import json
import re
from functools import partial

import numpy as np
from fuzz_samples import FOLDER, as_file, refused

from edge.errors import EdgeError, ModelError
from edge.evaluation.test_set import FrozenSet, load_frozen_set
from edge.inference.contract import KEY_PREFIX, Contract
from edge.inference.onnx_guard import check_plain
from edge.inference.onnx_session import ModelSession
from train.data.dataset import Sequences, load_sequences
from train.errors import DatasetError
from train.physics.simulated_sensor import FRAMES

CONTRACT = {
    "version": 4,
    "batch": 1,
    "taps": 4,
    "scale": 10,
    "tap_order": "newest first",
    "angle_step_deg": 5.0,
    "counts_per_unit": [500.0, 500.0, 1000.0],
    "output_unit": "mm",
    "output_full_scale": 2.0,
    "contact_level": 0.25,
    "sensor": "uSPa44",
    "rows": 4,
    "cols": 4,
    "pitch_mm": 4.7,
    "arithmetic": "float32",
    "interval_factor": 1.6,
    "confidence": {"1": {"doubt": [0.1, 0.2], "error": [0.1, 0.3], "gain": [0.01, 0.02]}},
    "training_sha256": "ab" * 32,
    "test_set_sha256": "cd" * 32,
    "test_error": {"4": {"psnr_db": 33.2}},
}


def contract(data: bytes) -> None:
    """Read metadata as lines of key and JSON; missing entries have valid values."""
    metadata = {KEY_PREFIX + key: json.dumps(value) for key, value in CONTRACT.items()}
    for line in data.decode("utf-8", "replace").split("\n"):
        key, _, value = line.partition(" ")
        metadata[KEY_PREFIX + key] = value
    made = refused(lambda: Contract.from_metadata(metadata), ModelError)
    if made is not None:
        height, width = made.pattern_shape
        assert 0 < height * width <= 1 << 20 and 0 < made.taps <= 64
        scaled = made.scale_window(np.full((1, 3, 4, 4), 65_535, np.float32))
        assert np.isfinite(scaled).all()
        assert Contract.from_metadata(made.to_metadata()) == made


def contract_seeds() -> list[bytes]:
    return ["\n".join(f"{key} {json.dumps(value)}" for key, value in CONTRACT.items()).encode()] + [
        f"{key} {value}".encode() for key in CONTRACT for value in ("null", "[", "1", '"1"', "{}", "[1, 2, 3]")
    ]


def tiny_model(**metadata: object) -> bytes:
    """Return a graph of one convolution, written without onnx, which the walk below must follow."""

    def field(number: int, content: bytes | int) -> bytes:
        if isinstance(content, int):
            return varint(number << 3) + varint(content)
        return varint(number << 3 | 2) + varint(len(content)) + content

    def varint(value: int) -> bytes:
        low, rest = value & 0x7F, value >> 7
        return bytes([low | 0x80]) + varint(rest) if rest else bytes([low])

    def value_info(name: bytes, shape: list[int]) -> bytes:
        dims = b"".join(field(1, field(1, size)) for size in shape)
        return field(1, name) + field(2, field(1, field(1, 1) + field(2, dims)))

    def node(kind: bytes, takes: list[bytes], gives: bytes, attributes: bytes = b"") -> bytes:
        return b"".join(field(1, name) for name in takes) + field(2, gives) + field(4, kind) + attributes

    def tensor(name: bytes, dims: list[int], kind: int, raw: bytes) -> bytes:
        return b"".join(field(1, size) for size in dims) + field(2, kind) + field(8, name) + field(9, raw)

    strides = field(5, field(1, b"strides") + field(8, 2) + field(8, 2) + field(20, 7))
    weights = np.full((3, 1, 2, 2), 0.5, np.float32)
    nodes = field(1, node(b"ConvTranspose", [b"window", b"w"], b"squares", strides))
    nodes += field(1, node(b"Squeeze", [b"squares", b"axis"], b"pattern"))
    inner = nodes + field(2, b"tiny") + field(5, tensor(b"w", [3, 1, 2, 2], 1, weights.tobytes()))
    inner += field(5, tensor(b"axis", [1], 7, np.array([1]).tobytes()))
    inner += field(11, value_info(b"window", [1, 3, 4, 4])) + field(12, value_info(b"pattern", [1, 8, 8]))
    told = CONTRACT | {"taps": 1, "scale": 2, "interval_factor": None, "confidence": {}} | metadata
    properties = b"".join(
        field(14, field(1, (KEY_PREFIX + key).encode()) + field(2, json.dumps(value).encode()))
        for key, value in told.items()
    )
    return field(1, 10) + field(8, field(2, 17)) + field(7, inner) + properties


def onnx_walk(data: bytes) -> None:
    """Run the checks that come before onnxruntime reads a byte."""
    refused(lambda: check_plain(data), ModelError)


def onnx_seeds() -> list[bytes]:
    side = b"\x3a\x08\x2a\x06\x70\x01\x6a\x02\x0a\x00"
    return [tiny_model(), side, b"\x3a\x06\x2a\x04\x08\x80\x80\x01", b"\x3a\x04\x0a\x02\x32\x00"]


def model(data: bytes) -> None:
    """Load a whole file into onnxruntime, and run it once."""
    session = refused(lambda: ModelSession(as_file("tiny.onnx", data)), ModelError)
    if session is not None:
        refused(lambda: session.run(np.ones((session.contract.taps, 3, 4, 4), np.float32)), EdgeError)


def model_seeds() -> list[bytes]:
    return [tiny_model(), tiny_model(batch="any")]


def frozen(data: bytes) -> None:
    found = refused(lambda: load_frozen_set(as_file("frozen.npz", data)), EdgeError)
    if found is not None and found.newest.shape[1:] == (3, 4, 4) and len(found) < 1000:
        assert len(found.windows(1)) == len(found.patterns()) == len(found)


def frozen_seeds() -> list[bytes]:
    made = FrozenSet(
        newest=np.zeros((2, 3, 4, 4), np.int16),
        earlier=np.zeros((1, 1, 3, 4, 4), np.int16),
        tap=np.zeros(2, np.int16),
        indentation_mm=np.ones(2, np.float32),
        force_n=np.ones(2, np.float32),
        unit_patterns=np.ones((1, 4, 4), np.float16),
        touched=np.ones((1, 4, 4), bool),
        surface=np.array(["S"]),
        angle_deg=np.zeros(1, np.float32),
        full_scale_mm=0.5,
    )
    made.save(FOLDER / "frozen.npz")
    return [(FOLDER / "frozen.npz").read_bytes()]


def sequences(data: bytes) -> None:
    """Load taps to train on, after the hash in the file is made right."""
    for _ in range(2):
        try:
            load_sequences(as_file("taps.npz", data))
        except DatasetError as error:
            if wanted := re.search(r"its sha256 is ([0-9a-f]{64}), it states ([0-9a-f]{64})", str(error)):
                data = data.replace(wanted[2].encode(), wanted[1].encode())
    refused(lambda: load_sequences(as_file("taps.npz", data)), DatasetError)


def sequences_seeds() -> list[bytes]:
    ones = partial(np.ones, dtype=np.float32)
    made = Sequences(
        surfaces=np.array(["S"]),
        poses=np.zeros((1, 1, 3)),
        counts=ones((1, 1, FRAMES, 3, 1, 1)),
        force_n=ones((1, 1, FRAMES)),
        indentation_mm=ones((1, 1, FRAMES)),
        unit_patterns=np.ones((1, 1, 2, 2), np.float16),
        touching=np.ones((1, 1, 2, 2), bool),
    )
    made.save(FOLDER / "taps.npz")
    return [(FOLDER / "taps.npz").read_bytes()]

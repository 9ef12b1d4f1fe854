"""Whatever comes, a parser gives what it promises or refuses it in a line: valid inputs, damaged in several places.

EDGE_FUZZ_INPUTS is the number of inputs for each parser. Decoders of the wire have such tests of their own, in
tests/bridge.
"""

import os
import re
import tempfile
import threading
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from edge_samples import ROOT, make_contract, wait_for, write_model
from hostile_samples import REST, archive, npy, recording_arrays, sensor_toml, stored
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from mcap.data_stream import RecordBuilder
from mcap.records import Channel, Message, Schema
from mcap.writer import MCAP0_MAGIC

from edge.errors import EdgeError, ModelError
from edge.inference.contract import KEY_PREFIX, Contract
from edge.inference.onnx_guard import check_plain
from edge.inference.onnx_session import ModelSession
from edge.pipeline.commands import Commands, command_lines
from firmware_bridge.errors import RecordingError, SensorFileError
from firmware_bridge.recording.csv_reader import csv_header
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.recording.scan_messages import baseline_type, encode_baseline, encode_scan, scan_type
from firmware_bridge.scans.scan import ABSENT, HIGHEST_COUNT, Scan
from firmware_bridge.sensor_file.model import load_sensor_file
from firmware_bridge.sensor_file.toml_writer import save_sensor_file
from firmware_bridge.zeroing.baseline import Baseline, load_baselines, save_baselines

INPUTS = int(os.environ.get("EDGE_FUZZ_INPUTS", "150"))
LONGEST_MESSAGE = 1000
_KEPT = tempfile.TemporaryDirectory(prefix="fuzz-", dir="/dev/shm" if Path("/dev/shm").is_dir() else None)
FOLDER = Path(_KEPT.name)
TOKENS = (
    *(b"\0", b"\xff", b"\r", b"\n", b"\a", b'"', b",", b"{", b"[" * 3000, b'{"":' * 1000, b"NaN", b"-1", b"1e999"),
    *(b"null", b"true", b"9" * 5000, b"-Infinity", b"\xed\xa0\x80", b"\\ud800", b"0.0", b"PK\x05\x06", b"\x93NUMPY"),
)
PLACES = st.integers(0, 9999)
CHANGES = st.lists(
    st.tuples(st.sampled_from(("flip", "set", "cut", "token", "copy")), PLACES, st.integers(0, 255), PLACES),
    min_size=1,
    max_size=8,
)


def damaged(data: bytes, changes: list[tuple[str, int, int, int]]) -> bytes:
    spoilt = bytearray(data)
    for kind, where, value, other in changes:
        place = where * len(spoilt) // 10_000
        if kind in ("flip", "set") and place < len(spoilt):
            spoilt[place] = spoilt[place] ^ 1 << value % 8 if kind == "flip" else value
        elif kind == "cut":
            del spoilt[place : place + 1 + value % 32]
        elif kind == "token":
            spoilt[place:place] = TOKENS[value % len(TOKENS)]
        elif kind == "copy":
            start = other * len(data) // 10_000
            spoilt[place:place] = data[start : start + 1 + value % 64]
    return bytes(spoilt)


def refused(read: Callable[[], object], *errors: type[Exception]):
    """Return what was read; None where it was refused in one line."""
    try:
        return read()
    except errors as error:
        text = str(error)
        assert "\n" not in text and len(text) <= LONGEST_MESSAGE, text
        return None


def as_file(name: str, data: bytes) -> Path:
    (FOLDER / name).write_bytes(data)
    return FOLDER / name


def recording(name: str, data: bytes) -> None:
    found = refused(lambda: load_recording(as_file(name, data)), RecordingError)
    if found is None:
        return
    assert found.tracks and all(len(note) <= LONGEST_MESSAGE for note in found.notes)
    assert found.rate_hz is None or 0 < found.rate_hz < 1e6
    for track in found.tracks:
        assert track.counts.shape[-3:] == (3, 4, 4) and track.counts.dtype == np.int32
        assert track.counts.min() >= ABSENT and track.counts.max() <= HIGHEST_COUNT
        if track.time_ns is not None:
            assert len(track.time_ns) == len(track.counts) and track.time_ns[0] >= 0
            assert not (track.time_ns[1:] < track.time_ns[:-1]).any()
        if track.renewed is not None:
            assert not (track.renewed & (track.counts[:, 0] == ABSENT)).any()
    for sensor, one in found.baselines.items():
        baseline_holds(sensor, one)


def baseline_holds(sensor: str, baseline: Baseline) -> None:
    held = baseline.counts[~np.isnan(baseline.counts)]
    assert sensor == baseline.sensor and ((held >= 0) & (held <= 0x10000)).all()
    assert not baseline.age_s(2e9) <= -1e12, "nan where the clock was wrong"


def with_right_ids(data: bytes, read: Callable[[bytes], object], error: type[Exception]) -> bytes:
    """Return the input with the ids of its counts, which an attacker can compute."""
    for _ in range(3):
        try:
            read(data)
        except error as complaint:
            if wanted := re.search(r"id': '([^']{1,60})', expected '([0-9a-f]{8})', which", str(complaint)):
                data = data.replace(wanted[1].encode(), wanted[2].encode())
    return data


def baselines(data: bytes) -> None:
    data = with_right_ids(data, lambda data: load_baselines(as_file("zero.json", data)), RecordingError)
    for sensor, one in (refused(lambda: load_baselines(as_file("zero.json", data)), RecordingError) or {}).items():
        baseline_holds(sensor, one)


def sensor_file(data: bytes) -> None:
    """Read it; what was read is written unchanged."""
    data = with_right_ids(data, lambda data: load_sensor_file(as_file("s.toml", data)), SensorFileError)
    found = refused(lambda: load_sensor_file(as_file("s.toml", data)), SensorFileError)
    if found is not None:
        save_sensor_file(FOLDER / "again.toml", found)
        again = load_sensor_file(FOLDER / "again.toml")
        assert (again.mountings, again.pads) == (found.mountings, found.pads)


def commands(data: bytes) -> None:
    """Commands are those that exist, and no more than the lines that hold one."""
    read_end, write_end = os.pipe()
    os.write(write_end, data)
    os.close(write_end)
    asked = Commands()
    with command_lines(asked, read_end):
        wait_for(lambda: "command-lines" not in [thread.name for thread in threading.enumerate()])
        got = asked.poll()
        assert all(command.name in ("reset", "zero") and isinstance(command.force, bool) for command in got)
        assert len(got) + asked.refused <= data.count(b"\n") + 1
        assert len(got) <= data.count(b"reset") + data.count(b"zero") + data.count(b"\\u")
    os.close(read_end)


def contract(data: bytes) -> None:
    metadata = dict(line.partition(" ")[::2] for line in data.decode("utf-8", "replace").split("\n"))
    made = refused(lambda: Contract.from_metadata({KEY_PREFIX + key: metadata[key] for key in metadata}), ModelError)
    if made is not None:
        height, width = made.pattern_shape
        assert 0 < height * width <= 1 << 20 and 0 < made.taps <= 64
        assert np.isfinite(made.scale_window(np.full((1, 3, 4, 4), 65_535, np.float32))).all()
        assert Contract.from_metadata(made.to_metadata()) == made


def model(data: bytes) -> None:
    """Check it as before onnxruntime reads a byte; then load it, and run it once."""
    refused(lambda: check_plain(data), ModelError)
    session = refused(lambda: ModelSession(as_file("tiny.onnx", data)), ModelError)
    if session is not None:
        refused(lambda: session.run(np.ones((session.contract.taps, 3, 4, 4), np.float32)), EdgeError)


def npy_in_npz(data: bytes) -> None:
    """Load a whole container with one damaged array, which the first byte selects."""
    if data:
        members = {name: npy(value) for name, value in recording_arrays().items()}
        recording("finger.npz", stored(members | {sorted(members)[data[0] % len(members)]: data[1:]}))


def csv_seeds() -> list[bytes]:
    header, values = ",".join(csv_header()), REST.reshape(3, 16).T.ravel()
    row, quoted = ",".join(f"{value}.0" for value in values), ",".join(f'"{value}"' for value in values)
    other = f"sep=;\ntime;{header}\n0;{row}".replace(",", ";").encode("utf-16")
    return [f"{header}\n{row}\n".encode(), f"\ufeff{header}\r\n{row}\r\n{quoted}\r\n".encode(), other]


def mcap_seeds() -> list[bytes]:
    """Return plain records, without chunks and sums, so that a change is not mere damage."""
    fresh, plain = np.ones((4, 4), dtype=bool), RecordBuilder()
    scans = [Scan("4", n, n, np.int32(REST + n), fresh, fresh) for n in range(2)]
    messages = [(baseline_type(16), encode_baseline(Baseline.of("4", REST, 1000.0, 100, "file"), "4", 1.0, 5))]
    messages += [(scan_type(16), encode_scan(scan, "4", 5, 0xFFFF, 0xFFFF)) for scan in scans]
    for number, kind in enumerate((baseline_type(16), scan_type(16)), 1):
        Schema(number, kind.definition.encode(), "ros2msg", kind.name).write(plain)
        Channel(number, "/x", "cdr", {}, number).write(plain)
    for kind, message in messages:
        Message(1 + (kind is scan_type(16)), 5, message, 5, 0).write(plain)
    return [MCAP0_MAGIC + plain.end()]


def baseline_seeds() -> list[bytes]:
    save_baselines(FOLDER / "zero.json", [Baseline.of(name, REST, 1000.0, 100, "file") for name in "46"])
    return [(FOLDER / "zero.json").read_bytes()]


def contract_seeds() -> list[bytes]:
    told = make_contract(interval_factor=1.6).to_metadata()
    return ["\n".join(f"{key.removeprefix(KEY_PREFIX)} {value}" for key, value in told.items()).encode()]


TARGETS = {
    "CSV": (lambda data: recording("finger.csv", data), csv_seeds),
    "npz": (lambda data: recording("finger.npz", data), lambda: [archive(**recording_arrays())]),
    "npy in npz": (npy_in_npz, lambda: [b"\0" + npy(recording_arrays()["counts"]), b"\1" + npy("tactile-recording")]),
    "MCAP": (lambda data: recording("finger.mcap", data), mcap_seeds),
    "baseline JSON": (baselines, baseline_seeds),
    "sensor TOML": (sensor_file, lambda: [sensor_toml(FOLDER)]),
    "commands": (
        commands,
        lambda: [b'{"cmd": "zero", "sensor": "4", "force": true}\n{"cmd":"r\\u0065set"}\n\n[[1e9]]\n'],
    ),
    "contract": (contract, contract_seeds),
    "ONNX": (model, lambda: [write_model(FOLDER / "whole.onnx", make_contract(taps=1)).read_bytes()]),
}
seeds = cache(lambda name: TARGETS[name][1]())


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", TARGETS)
@example(number=0, changes=[("set", 0, 5, 0)])  # one array in another's place, whose text has several lines
@given(number=st.integers(0, 2), changes=CHANGES)
@settings(max_examples=INPUTS, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
def test_whatever_comes_a_parser_keeps_its_promise(name, number, changes):
    TARGETS[name][0](damaged(seeds(name)[number % len(seeds(name))], changes))


def test_nothing_is_loaded_that_could_run():
    """numpy and torch refuse pickles unless they are asked for, and ruff refuses pickle itself."""
    for package in ("edge", "firmware_bridge", "train", "export"):
        for path in (ROOT / package).rglob("*.py"):
            assert not re.search(r"allow_pickle=True|weights_only=False|joblib\.load", path.read_text()), path

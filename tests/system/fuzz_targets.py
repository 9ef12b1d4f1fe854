"""Every parser of what comes from outside: what it may be fed first, and what must be true of whatever it is fed.

A target takes bytes and returns; only the errors that a parser documents are caught. `python tests/system/fuzz.py` runs
them guided by coverage, tests/hostile/test_fuzz.py for some seconds without.
"""

import io
import json
import os
import re
import struct
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from mcap.data_stream import RecordBuilder
from mcap.records import Channel, Message, Schema
from mcap.writer import MCAP0_MAGIC

from edge.bench.compare import compared
from edge.bench.errors import BenchError
from edge.bench.record import read_record
from edge.budgeting.run_time_cache import CalibrationCache
from edge.errors import EdgeError, ModelError
from edge.evaluation.test_set import FrozenSet, load_frozen_set
from edge.inference.contract import KEY_PREFIX, Contract
from edge.inference.onnx_guard import check_plain
from edge.inference.onnx_session import ModelSession
from edge.pipeline.commands import LONGEST_LINE_BYTES, CommandLines, Commands
from edge.sinks.mcap_writer import McapFile
from firmware_bridge.can.gs_usb import BitTiming, BitTimingLimits, GsUsbDecoder, bit_timing, channel_count
from firmware_bridge.can.slcan import LONGEST_LINE, CanFrame, SlcanDecoder, encode_frame
from firmware_bridge.errors import RecordingError, SensorFileError
from firmware_bridge.recording.formats import CSV_HEADER, load_recording
from firmware_bridge.recording.scan_messages import BASELINE, SCAN, encode_baseline, encode_scan
from firmware_bridge.recording.tracks import HIGHEST_COUNT
from firmware_bridge.scans.can_id_maps import USPA44_MAP
from firmware_bridge.scans.gs_usb_scans import GsUsbScans
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.pad import GAINS, Pad
from firmware_bridge.scans.scan import ABSENT, Scan
from firmware_bridge.scans.slcan_scans import SlcanScans
from firmware_bridge.scans.xela_server_scans import ServerScans
from firmware_bridge.sensor_file.model import SensorEntry, SensorFile, load_sensor_file
from firmware_bridge.sensor_file.toml_writer import save_sensor_file
from firmware_bridge.zeroing.baseline import Baseline, load_baselines, save_baselines
from train.data.dataset import Sequences, load_sequences
from train.errors import DatasetError
from train.physics.simulated_sensor import FRAMES

LONGEST_MESSAGE = 1000
"""Characters of an error that a user can still read, paths among them."""
_KEPT = tempfile.TemporaryDirectory(prefix="fuzz-", dir="/dev/shm" if Path("/dev/shm").is_dir() else None)
FOLDER = Path(_KEPT.name)
FRESH = np.ones((4, 4), dtype=bool)
REST = np.array([16_000, 16_400, 38_600])[:, None, None] + np.arange(16).reshape(4, 4) * 90


@dataclass(frozen=True)
class Target:
    """A parser under fire.

    Attributes:
        name: what it parses.
        run: one input; raises where a promise is broken.
        seeds: valid inputs to begin with.
        longest: bytes of an input.
        share: of the inputs of a long run; what is slow gets fewer.
    """

    name: str
    run: Callable[[bytes], None]
    seeds: Callable[[], list[bytes]]
    longest: int = 4096
    share: int = 1


def refused(read: Callable[[], object], *errors: type[Exception]) -> object | None:
    """What was read; None where it was refused in one line."""
    try:
        return read()
    except errors as error:
        text = str(error)
        assert "\n" not in text and len(text) <= LONGEST_MESSAGE, text
        return None


def as_file(name: str, data: bytes) -> Path:
    path = FOLDER / name
    path.write_bytes(data)
    return path


def slcan(data: bytes) -> None:
    """The same frames whatever the chunks; each stands in the text; no byte is counted twice; memory is bounded."""
    whole, cut = SlcanDecoder(), SlcanDecoder()
    frames = whole.feed(data)
    step = 1 + len(data) % 31
    pieces = [frame for start in range(0, len(data), step) for frame in cut.feed(data[start : start + step])]
    assert pieces == frames and cut.counters() == whole.counters()
    assert whole.pending_bytes <= LONGEST_LINE
    text, position = data.upper(), 0
    for frame in frames:
        if not frame.remote:  # of which the length is not kept
            found = text.find(encode_frame(frame).upper(), position)
            assert found >= 0, (frame, data)
            position = found + 1
    for scan in SlcanScans(USPA44_MAP).feed(data, time_ns=1):
        check_counts(scan.counts)


def check_counts(counts: np.ndarray) -> None:
    assert counts.shape[-3:] == (3, 4, 4) and counts.dtype == np.int32
    assert counts.min() >= ABSENT and counts.max() <= HIGHEST_COUNT


def gs_usb(data: bytes) -> None:
    """The same frames whatever the chunks, each of them in the bytes; then scans of them, stamped or not."""
    stamped, data = data[:1] > b"\x7f", data[1:]
    whole, cut = (GsUsbDecoder(stamped=stamped, channels=2) for _ in range(2))
    frames = whole.feed(data)
    step = 1 + len(data) % 31
    pieces = [frame for start in range(0, len(data), step) for frame in cut.feed(data[start : start + step])]
    assert pieces == frames and cut.counters() == whole.counters()
    assert all(frame.frame.data in data and len(frame.frame.data) <= 8 for frame in frames)
    scans = GsUsbScans()
    scans.start(stamped=stamped, channels=2)
    for scan in scans.feed(data, time_ns=1):
        check_counts(scan.counts)
    trouble = scans.trouble(2)
    assert trouble is None or ("\n" not in trouble and len(trouble) <= LONGEST_MESSAGE)


def gs_usb_seeds() -> list[bytes]:
    made = [b"\0", b"\xff"]
    for number, (can_id, _) in enumerate(USPA44_MAP.wire_order("4")):
        frame = struct.pack("<IIBBBB8s", 0xFFFFFFFF, can_id, 8, 0, 0, 0, bytes(range(8)))
        made[0] += frame
        made[1] += frame + struct.pack("<I", 600 * number)
    error = struct.pack("<IIBBBB8s", 0xFFFFFFFF, 0x20000004, 8, 0, 1, 0, bytes((0, 4, 0, 0, 0, 0, 96, 0)))
    return [*made, b"\0" + error + made[0][1:41]]


def gs_usb_limits(data: bytes) -> None:
    """What an adapter says of itself."""
    limits = refused(lambda: BitTimingLimits.from_bytes(data), ValueError)
    if isinstance(limits, BitTimingLimits):
        timing = refused(lambda: bit_timing(limits), ValueError)
        if isinstance(timing, BitTiming):
            assert timing.quanta * timing.brp * 1_000_000 == limits.clock_hz and len(timing.to_bytes()) == 20
    refused(lambda: channel_count(data), ValueError)


def gs_usb_limits_seeds() -> list[bytes]:
    return [struct.pack("<10I", 16, 48_000_000, 1, 16, 1, 8, 4, 1, 1024, 1), bytes(12)]


def server(data: bytes) -> None:
    """Messages by lines; what comes of them are readings of this geometry, and counters."""
    scans = ServerScans()
    scans.begin()
    for number, text in enumerate(data.split(b"\n")):
        for scan in scans.feed(text, arrival_ns=10_000_000 * (1 + number)):
            check_counts(scan.counts)
    assert len(scans.foreign) <= 1110 and all(count >= 0 for count in scans.counters().values())
    trouble = scans.trouble
    assert trouble is None or ("\n" not in trouble and len(trouble) <= 10 * LONGEST_MESSAGE)


def server_seeds() -> list[bytes]:
    counts = REST.reshape(3, 16).T.ravel().tolist()
    texts = ",".join(f"{value:X}" for value in counts)
    welcome = {"message": "Welcome", "version": "1.7.6", "time": 1.7e9}
    sensor = {"data": texts, "taxels": 16, "model": "XR1944", "ups": [100] * 16, "temp": [300] * 16, "time": 1.7e9}
    newer = sensor | {"data": counts, "integer": counts, "calibrated": [0.5] * 48}
    messages = [welcome, *({"message": n, "time": 1.7e9 + n / 100, "1": sensor, "2": newer} for n in range(3))]
    return ["\n".join(json.dumps(one) for one in several).encode() for several in (messages, messages[:2])]


def sensor_toml(data: bytes) -> None:
    """A sensor file, and the same with the id that its counts give; what was read is written as it was."""
    for _ in range(2):
        try:
            load_sensor_file(as_file("sensor.toml", data))
        except SensorFileError as error:
            if wanted := re.search(r"id': '([^']{1,60})', expected '([0-9a-f]{8})', which", str(error)):
                data = data.replace(wanted[1].encode(), wanted[2].encode())
    told = refused(lambda: load_sensor_file(as_file("sensor.toml", data)), SensorFileError)
    if isinstance(told, SensorFile):
        for entry in told.sensors.values():
            assert np.isfinite(np.asarray(entry.mounting.gains, np.float32)).all()
            assert entry.counts_per_newton is None or 0 < float(entry.counts_per_newton) < np.inf
            assert entry.baseline is None or entry.baseline.age_s(2e9) > -1e12
        save_sensor_file(FOLDER / "again.toml", told)
        again = load_sensor_file(FOLDER / "again.toml")
        assert (again.mountings, again.pads) == (told.mountings, told.pads)


def sensor_toml_seeds() -> list[bytes]:
    pad = Pad(thickness_mm=4.5, intervals={"poisson": (0.4, 0.49)}, gains=(1.0,) * GAINS)
    entry = SensorEntry(baseline=Baseline.of("4", REST, 1000.0, 100, "file"), counts_per_newton=1200.5, pad=pad)
    made = []
    for sensor_file in (SensorFile(adapter="D30", sensors={"4": entry}), SensorFile(sensors={"a": SensorEntry()})):
        save_sensor_file(FOLDER / "sensor.toml", sensor_file)
        made.append((FOLDER / "sensor.toml").read_bytes())
    return made


def slcan_seeds() -> list[bytes]:
    order = USPA44_MAP.wire_order("4")
    frames = [CanFrame(can_id, bytes((0, *np.uint16(REST[:, 0, 0]).byteswap().tobytes(), 0))) for can_id, _ in order]
    cycle = b"".join(map(encode_frame, frames))
    others = [CanFrame(0x1ABCDEF0, b"\x01\x02", extended=True, timestamp_ms=59_999), CanFrame(5, b"", remote=True)]
    return [cycle, cycle[:100] + cycle, b"".join(map(encode_frame, others)), b"\rz\r\aV1013\rF00\rsb000000\re1a\r"]


def csv(data: bytes) -> None:
    recording = refused(lambda: load_recording(as_file("finger.csv", data)), RecordingError)
    if recording is not None:
        (track,) = recording.tracks
        check_counts(track.counts)
        assert len(track.counts) == data.count(b"\n") - 1 and track.counts.min() >= 0


def csv_seeds() -> list[bytes]:
    header = ",".join(CSV_HEADER)
    row = ",".join(f"{value}.0" for value in REST.reshape(3, 16).T.ravel())
    quoted = ",".join(f'"{value}"' for value in REST.reshape(3, 16).T.ravel())
    return [f"{header}\n{row}\n".encode(), f"\ufeff{header}\r\n{row}\r\n{quoted}\r\n".encode(), b"a,b\n1,2\n"]


def csv_rows(data: bytes) -> None:
    """The same behind a whole header, which chance would never find again."""
    csv(HEADER + data)


HEADER = csv_seeds()[0].partition(b"\n")[0] + b"\n"


def csv_rows_seeds() -> list[bytes]:
    return [seed.partition(b"\n")[2] for seed in csv_seeds()[:2]]


def csv_rate(data: bytes) -> None:
    """The file beside a recording that tells its rate."""
    as_file("meta_data.csv", data)
    try:
        recording = refused(lambda: load_recording(as_file("rated.csv", CSV)), RecordingError)
        assert recording is None or recording.rate_hz is None or 0 < recording.rate_hz < 1e6
    finally:
        (FOLDER / "meta_data.csv").unlink()


CSV = csv_seeds()[0]


def csv_rate_seeds() -> list[bytes]:
    return [b"dropped,notes,frequency_hz\n0,,59.75\n", b"frequency_hz\n1e2\n", b"x\n"]


def archive(compressed: bool = False, **arrays: object) -> bytes:
    file = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(file, **arrays)
    return file.getvalue()


def recording_arrays() -> dict[str, object]:
    counts = np.stack([REST, REST + 1]).astype(np.int32)
    times = {"scan": np.arange(2), "time_ns": np.arange(2) * 10_000_000}
    return {"format": "tactile-recording", "version": 1, "sensor": np.array(["4", "4"]), "counts": counts, **times}


def npz(data: bytes) -> None:
    recording = refused(lambda: load_recording(as_file("finger.npz", data)), RecordingError)
    if recording is not None:
        assert recording.tracks
        for track in recording.tracks:
            check_counts(track.counts)
            assert track.time_ns is not None and len(track.time_ns) == len(track.counts)
            assert track.time_ns[0] >= 0 and not (track.time_ns[1:] < track.time_ns[:-1]).any()
            track.sensor.encode()


def npz_seeds() -> list[bytes]:
    return [archive(**recording_arrays()), archive(compressed=True, rate_hz=100.0, **recording_arrays())]


def mcap(data: bytes) -> None:
    """A file as it is, and the same bytes as records of one that begins well, so that they are reached."""
    for name, content in (("finger.mcap", data), ("records.mcap", MCAP0_MAGIC + data)):
        recording = refused(lambda: load_recording(as_file(name, content)), RecordingError)  # noqa: B023
        if recording is not None:
            assert recording.tracks and all(len(note) <= LONGEST_MESSAGE for note in recording.notes)
            for track in recording.tracks:
                check_counts(track.counts)
                assert track.time_ns is not None and track.renewed is not None
                assert len(track.time_ns) == len(track.counts) == len(track.renewed)
                assert track.time_ns[0] >= 0 and not (track.time_ns[1:] < track.time_ns[:-1]).any()
                assert not (track.renewed & (track.counts[:, 0] == ABSENT)).any()
            for sensor, one in recording.baselines.items():
                held = one.counts[~np.isnan(one.counts)]
                assert sensor == one.sensor and ((held >= 0) & (held <= 0x10000)).all()


def mcap_seeds() -> list[bytes]:
    """Whole, and plain: without chunks and sums, so that a change is no mere damage."""
    path = FOLDER / "made.mcap"
    path.unlink(missing_ok=True)
    file = McapFile(path, "ros2", "fuzz")
    file.add_metadata("mounting", {"sensor": "4", "mounting": json.dumps(asdict(Mounting()))})
    baseline = encode_baseline(Baseline.of("4", REST, 1000.0, 100, "file"), 1.0, 5)
    scans = [Scan("4", n, n, np.int32(REST + n), FRESH, FRESH) for n in range(2)]
    messages = [(BASELINE, baseline), *((SCAN, encode_scan(scan, 5, 0xFFFF, 0xFFFF)) for scan in scans)]
    plain = RecordBuilder()
    channels: dict[str, int] = {}
    for kind, message in messages:
        if kind.name not in channels:
            schema = file.add_schema(kind.name, "ros2msg", kind.definition)
            channels[kind.name] = number = file.add_channel(f"/{schema}", "cdr", schema, {})
            Schema(number, kind.definition.encode(), "ros2msg", kind.name).write(plain)
            Channel(number, "/x", "cdr", {}, number).write(plain)
        file.add_message(channels[kind.name], 5, message)
        Message(channels[kind.name], 5, message, 5, 0).write(plain)
    file.close()
    return [path.read_bytes(), plain.end()]


def npy_in_npz(data: bytes) -> None:
    """An npz file whose container is whole, so that what is fuzzed is an array in it: first a byte that says which."""
    if data:
        npz(stored(MEMBERS | {sorted(MEMBERS)[data[0] % len(MEMBERS)]: data[1:]}))


def npy(value: object) -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array(file, np.asarray(value))
    return file.getvalue()


def stored(members: dict[str, bytes]) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as whole:
        for name, content in members.items():
            whole.writestr(f"{name}.npy", content)
    return file.getvalue()


MEMBERS = {name: npy(value) for name, value in recording_arrays().items()} | {"rate_hz": npy(100.0)}


def npy_in_npz_seeds() -> list[bytes]:
    return [bytes([i]) + MEMBERS[name] for i, name in enumerate(sorted(MEMBERS))]


def baseline(data: bytes) -> None:
    """A file changed by hand, and the same with the id that its counts give, which an attacker can work out."""
    for _ in range(3):
        try:
            load_baselines(as_file("zero.json", data))
        except RecordingError as error:
            if wanted := re.search(r"'id': '([^']{1,60})', expected '([0-9a-f]{8})', which", str(error)):
                data = data.replace(wanted[1].encode(), wanted[2].encode())
    baselines = refused(lambda: load_baselines(as_file("zero.json", data)), RecordingError)
    if baselines is not None:
        for sensor, one in baselines.items():
            assert sensor == one.sensor and one.counts.ndim == 3 and one.age_s(2e9) > -1e12
            held = one.counts[~np.isnan(one.counts)]
            assert ((held >= 0) & (held <= 0x10000)).all()


def baseline_seeds() -> list[bytes]:
    save_baselines(FOLDER / "zero.json", [Baseline.of(name, REST, 1000.0, 100, "file") for name in "46"])
    return [(FOLDER / "zero.json").read_bytes()]


def commands(data: bytes) -> None:
    """Whatever comes on stdin: commands are known ones, and no more than the lines that hold one."""
    read_end, write_end = os.pipe()
    try:
        os.write(write_end, data)
        os.close(write_end)
        asked = Commands()
        lines = CommandLines(asked, read_end)
        asked.ask(lines.read)
        got = [command for _ in range(len(data) // 4096 + 2) for command in asked.poll()]
        for command in got:
            assert command.name in ("reset", "zero")
            assert command.sensor is None or (isinstance(command.sensor, str) and command.name == "zero")
            assert isinstance(command.force, bool)
        assert len(got) + asked.refused <= data.count(b"\n") + 1
        assert len(got) <= data.count(b"reset") + data.count(b"zero") + data.count(b"\\u")
        assert len(lines._partial) <= LONGEST_LINE_BYTES + 1
    finally:
        os.close(read_end)


def commands_seeds() -> list[bytes]:
    zero = b'{"cmd": "zero", "sensor": "4", "force": true}\n{"cmd":"zero"}\n'
    return [zero, b'{"cmd": "reset"}\n', b'{"cmd":"r\\u0065set"}\n\n{"cmd": ["reset"]}\n[[[[1e999, null]]]]\n']


def calibration(data: bytes) -> None:
    """The cache of run times; its keys are made of this machine, so an entry of it stands for every key."""
    cache = CalibrationCache(as_file("calibration.json", data), 100.0, unix_time_s=lambda: 2e9)
    entry = next(iter(cache._entries.values()), None)
    cache._entries[cache._key(MODEL_LIKE)] = entry
    found = cache.find(MODEL_LIKE)
    assert found is None or (0 < found[0].p50_us <= found[0].p99_us < 1e12 and 0 <= found[1] < 1e12)
    assert all("\n" not in note for note in cache.notes)


MODEL_LIKE = as_file("like.onnx", b"model")


def calibration_seeds() -> list[bytes]:
    entry = {"model": "m", "p50_us": 900.5, "p99_us": 1200, "unix_s": 1.7e9}
    return [json.dumps({"ab" * 32: entry}).encode(), b"{}"]


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
    """Metadata as lines of key and JSON; what is not there is as it should be."""
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
    """A graph of one convolution, written without onnx: which the walk below must follow."""

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
    """What is checked before onnxruntime reads a byte."""
    refused(lambda: check_plain(data), ModelError)


def onnx_seeds() -> list[bytes]:
    side = b"\x3a\x08\x2a\x06\x70\x01\x6a\x02\x0a\x00"
    return [tiny_model(), side, b"\x3a\x06\x2a\x04\x08\x80\x80\x01", b"\x3a\x04\x0a\x02\x32\x00"]


def model(data: bytes) -> None:
    """A whole file, into onnxruntime and once through."""
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
    """Taps to train on, with the hash that the file tells made right."""
    for _ in range(2):
        try:
            load_sequences(as_file("taps.npz", data))
        except DatasetError as error:
            if wanted := re.search(r"its sha256 is ([0-9a-f]{64}), it says ([0-9a-f]{64})", str(error)):
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


def bench(data: bytes) -> None:
    """An earlier bench, read and held against a new one."""
    told = refused(lambda: read_record(as_file("bench.json", data)), BenchError)
    if told is not None:
        refused(lambda: compared(BENCH_RECORD, told, Path("bench.json")), BenchError)


def bench_seeds() -> list[bytes]:
    return [BENCH_RECORD.to_json().encode(), b'{"format": "tactile bench", "version": 1}']


def _bench_record() -> SimpleNamespace:
    from edge.bench.machine import this_machine
    from edge.bench.record import Record, RunTimeRow
    from edge.bench.timing import Pace, Times

    times = Times(3000, 9.0, 10.0, 11.0, 12.0, tuple(9.0 + block % 3 for block in range(10)))
    record = Record("2026-01-02", "edge-sr bench", this_machine(), {"rate_hz": 100.0, "ticks": 3000}, complete=True)
    record.peak_gmac_s[1] = 50.0
    row = RunTimeRow("m", 1, False, times, Pace(times, 3000, 2, 7.5), 10.0, 20.0, 300.0, 70.0)
    record.run_times = [row]
    return record


BENCH_RECORD = _bench_record()

TARGETS = {
    target.name: target
    for target in (
        Target("slcan", slcan, slcan_seeds, 1024, 60),
        Target("gs_usb", gs_usb, gs_usb_seeds, 1024, 100),
        Target("gs_usb limits", gs_usb_limits, gs_usb_limits_seeds, 64, 50),
        Target("server JSON", server, server_seeds, 8192, 50),
        Target("sensor TOML", sensor_toml, sensor_toml_seeds, 4096, 30),
        Target("CSV", csv, csv_seeds, 4096, 50),
        Target("CSV rows", csv_rows, csv_rows_seeds, 1024, 100),
        Target("CSV rate", csv_rate, csv_rate_seeds, 512, 10),
        Target("npz", npz, npz_seeds, 4096, 20),
        Target("MCAP", mcap, mcap_seeds, 8192, 20),
        Target("npy in npz", npy_in_npz, npy_in_npz_seeds, 1024, 10),
        Target("baseline JSON", baseline, baseline_seeds, 8192, 80),
        Target("commands", commands, commands_seeds, 4096, 200),
        Target("calibration JSON", calibration, calibration_seeds, 1024, 5),
        Target("bench JSON", bench, bench_seeds, 8192, 10),
        Target("contract", contract, contract_seeds, 4096, 5),
        Target("ONNX walk", onnx_walk, onnx_seeds, 4096, 180),
        Target("ONNX model", model, model_seeds, 8192, 10),
        Target("frozen set", frozen, frozen_seeds, 8192, 10),
        Target("sequences", sequences, sequences_seeds, 8192, 10),
    )
}

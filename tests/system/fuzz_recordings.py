"""Targets of the fuzzer that are recordings, baselines or sensor files."""

import io
import json
import re
import zipfile
from dataclasses import asdict

import numpy as np
from fuzz_samples import FOLDER, FRESH, LONGEST_MESSAGE, REST, as_file, check_counts, refused
from mcap.data_stream import RecordBuilder
from mcap.records import Channel, Message, Schema
from mcap.writer import MCAP0_MAGIC

from edge.sinks.mcap_writer import McapFile
from firmware_bridge.errors import RecordingError, SensorFileError
from firmware_bridge.recording.csv_reader import CSV_HEADER
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.recording.scan_messages import BASELINE, SCAN, encode_baseline, encode_scan
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.pad_constants import GAINS, Pad
from firmware_bridge.scans.scan import ABSENT, Scan
from firmware_bridge.sensor_file.model import SensorEntry, SensorFile, load_sensor_file
from firmware_bridge.sensor_file.toml_writer import save_sensor_file
from firmware_bridge.zeroing.baseline import Baseline, load_baselines, save_baselines


def sensor_toml(data: bytes) -> None:
    """Read a sensor file, and the same with the id of its counts; what was read is written unchanged."""
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


def csv(data: bytes) -> None:
    recording = refused(lambda: load_recording(as_file("finger.csv", data)), RecordingError)
    if recording is not None:
        (track,) = recording.tracks
        check_counts(track.counts)
        assert len(track.counts) <= len(re.split(b"[\r\n]", data)) and track.counts.min() >= 0


def csv_seeds() -> list[bytes]:
    header = ",".join(CSV_HEADER)
    row = ",".join(f"{value}.0" for value in REST.reshape(3, 16).T.ravel())
    quoted = ",".join(f'"{value}"' for value in REST.reshape(3, 16).T.ravel())
    return [
        f"{header}\n{row}\n".encode(),
        f"\ufeff{header}\r\n{row}\r\n{quoted}\r\n".encode(),
        b"a,b\n1,2\n",
        f"sep=;\ntime;{header}\n0;{row}".replace(",", ";").encode("utf-16"),
    ]


def csv_rows(data: bytes) -> None:
    """Load rows after a whole header, which chance would never produce."""
    csv(HEADER + data)


HEADER = csv_seeds()[0].partition(b"\n")[0] + b"\n"


def csv_rows_seeds() -> list[bytes]:
    return [seed.partition(b"\n")[2] for seed in csv_seeds()[:2]]


def csv_rate(data: bytes) -> None:
    """Load a recording with the file next to it that holds its rate."""
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
    """Read a file as it is, and the same bytes as records of a valid file, so that they are reached."""
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
    """Return a whole file, and plain records without chunks and sums, so that a change is not mere damage."""
    path = FOLDER / "made.mcap"
    path.unlink(missing_ok=True)
    file = McapFile(path, "ros2", "fuzz")
    file.add_metadata("mounting", {"sensor": "4", "mounting": json.dumps(asdict(Mounting()))})
    baseline = encode_baseline(Baseline.of("4", REST, 1000.0, 100, "file"), "4", 1.0, 5)
    scans = [Scan("4", n, n, np.int32(REST + n), FRESH, FRESH) for n in range(2)]
    messages = [(BASELINE, baseline), *((SCAN, encode_scan(scan, "4", 5, 0xFFFF, 0xFFFF)) for scan in scans)]
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
    """Load an npz file with a whole container and one fuzzed array, which the first byte selects."""
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
    """Read a file changed by hand, and the same with the id of its counts, which an attacker can compute."""
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

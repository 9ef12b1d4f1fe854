"""MCAP files made to harm, or of others: each is refused in one line, before it costs time or memory."""

import json
import re
import struct

import numpy as np
import pytest
import zstandard
from edge_samples import FakeModel, make_contract
from mcap.data_stream import RecordBuilder
from mcap.records import Channel, Chunk, DataEnd, Footer, Message, Schema
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer
from mcap_samples import OFFSET_NS

from edge.api import open_recording, open_sink
from edge.perception.runtime import Runtime
from edge.pipeline.result_stream import Stream
from firmware_bridge.errors import RecordingError
from firmware_bridge.recording import mcap_reader as mcap_recording
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.recording.mcap_records import MOST_CHUNK_BYTES
from firmware_bridge.recording.scan_messages import SENSOR, baseline_type, encode_baseline, encode_scan, scan_type
from firmware_bridge.scans.scan import Scan
from firmware_bridge.zeroing.baseline import Baseline

pytestmark = pytest.mark.usefixtures("bounded_memory")
SCAN, BASELINE = scan_type(16), baseline_type(16)
FRESH = np.ones((4, 4), bool)
ONE = Scan("4", 0, 10, np.full((3, 4, 4), 16_000, np.int32), FRESH, FRESH)
GOOD = SCAN.decode(encode_scan(ONE, "4", 10**9, 0xFFFF, 0xFFFF))
REST = BASELINE.decode(encode_baseline(Baseline.of("4", ONE.counts, 1000.0, 100, "file"), "4", 1.0, 10**9))


def written(tmp_path, *records, magic=MCAP0_MAGIC):
    builder = RecordBuilder()
    builder.write(magic)
    for record in records:
        builder.write(record) if isinstance(record, bytes) else record.write(builder)
    path = tmp_path / "made.mcap"
    path.write_bytes(builder.end())
    return path


def channel_of(kind, number=1, text=None):
    text = kind.definition.encode() if text is None else text
    return (
        Schema(id=number, name=kind.name, encoding="ros2msg", data=text),
        Channel(id=number, topic=f"/t{number}", message_encoding="cdr", metadata={}, schema_id=number),
    )


def message(kind, values, channel=1, **changes):
    return Message(channel, OFFSET_NS, kind.encode(values | changes), OFFSET_NS, 0)


def refused(path, words):
    with pytest.raises(RecordingError, match=words) as error:
        load_recording(path)
    assert "\n" not in str(error.value) and len(str(error.value)) < 1000


def test_files_that_are_something_else(tmp_path):
    refused(written(tmp_path, magic=b"PK\3\4 not an mcap"), r"made\.mcap: not an MCAP file")
    refused(written(tmp_path), r"no scans that edge-sr recorded; .* breaks off \(after byte 0\)")
    refused(tmp_path / "gone.mcap", r"gone\.mcap: cannot be read: No such file")


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.ZSTD])
def test_in_a_file_of_others_scans_are_found(tmp_path, compression):
    path = tmp_path / "other.mcap"
    for scans in (0, 3):
        with path.open("wb") as file:
            writer = Writer(file, compression=compression)
            writer.start()
            for number in range(12):
                other = writer.register_schema("Other", "jsonschema", b"{}")
                writer.add_message(writer.register_channel(f"/camera\n{number}", "json", other), 1, b"{}", 1)
            for number in range(scans):
                kind = writer.register_schema(SCAN.name, "ros2msg", SCAN.definition.encode())
                scan = SCAN.encode(GOOD | {"number": number})
                writer.add_message(writer.register_channel("/t", "cdr", kind), OFFSET_NS, scan, OFFSET_NS)
            writer.finish()
        if not scans:
            refused(path, "no scans that edge-sr recorded$")
    recording = load_recording(path)
    assert recording.tracks[0].numbers.tolist() == [0, 1, 2]
    assert "the mounting of sensor 4 is not in the file" in recording.notes[0]


OF_A_BASELINE, OF_A_SENSOR = channel_of(BASELINE, 2), channel_of(SENSOR, 2)
UNKNOWN_DATE = {"created_unix_s": float("nan")}
SEATED = {"order": list(range(16)), "swap_xy": False, "signs": [1, 1, 1]}


def of_scans(*changes, **settings):
    """Return the records of scans with these changes."""
    return *channel_of(SCAN, **settings), *(message(SCAN, GOOD, **one) for one in changes)


def of_facts(text):
    return *OF_A_SENSOR, message(SENSOR, GOOD | {"facts": text}, 2), *of_scans({})


@pytest.mark.parametrize(
    ("words", "records"),
    [
        *(
            (rf"topic '/t1': .*{name}", of_scans(changes))
            for name, changes in (
                ("sensor", {"sensor": ""}),
                ("sensor", {"sensor": "a\nb"}),
                ("number", {"number": -1}),
                ("time_ns", {"time_ns": -1}),
                ("time_ns", {"time_ns": 1 << 61}),
                ("device_time_ns", {"device_time_ns": -2}),
                ("fresh", {"fresh": 0x1FFFF}),
                ("fresh", {"renewed": 0x10000}),
                ("fresh", {"fresh": 0xFFFE, "renewed": 1}),
                ("one on each axis", {"fresh": 0xFFFE, "renewed": 0}),
                ("one on each axis", {"counts": np.full(48, -1)}),
                ("counts", {"counts": np.full(48, -2)}),
                ("counts", {"counts": np.full(48, 0x10000)}),
                ("vendor_newtons", {"vendor_newtons": np.zeros(47)}),
                ("vendor_newtons", {"vendor_newtons": np.full(48, np.nan)}),
                ("vendor_temperature_k", {"vendor_temperature_k": np.full(16, 199.0)}),
                ("vendor_ups_hz", {"vendor_ups_hz": np.full(16, -1.0)}),
            )
        ),
        *(
            (f"topic '/t2': {name}", (*OF_A_BASELINE, message(BASELINE, REST, 2, **changes), *of_scans({})))
            for name, changes in (
                ("sensor", {"sensor": ""}),
                ("id", {"id": ""}),
                ("created_unix_s", {"created_unix_s": -1.0}),
                ("age_s", UNKNOWN_DATE | {"age_s": -1.0}),
                ("age_s", UNKNOWN_DATE | {"age_s": 1e300}),
                ("created_unix_s", {"created_unix_s": 1e300}),
                ("scans", {"scans": 0}),
                ("counts", {"counts": np.full(48, -1.0)}),
            )
        ),
        *(
            ("made.mcap", of_facts(said))
            for said in ("", "[]", "[" * 5000, '{"mounting": 1}', '{"mounting": {}}', '{"geometry": {"rows": "9"}}')
        ),
        *(
            ("no mounting of sensor '4'", of_facts(json.dumps({"mounting": {"mounting": said}})))
            for said in (
                *("", "[]", "{}", "[" * 5000),
                json.dumps(SEATED | {"order": [0] * 16}),
                json.dumps(SEATED | {"swap_xy": 2}),
                json.dumps(SEATED | {"order": [0.0, *range(1, 16)]}),
            )
        ),
        ("times of sensor '4' that go back", of_scans({"time_ns": 10}, {"time_ns": 9})),
        ("more than 64 sensors", of_scans(*({"sensor": str(n)} for n in range(65)))),
        ("more than 64 sensors", (*OF_A_BASELINE, *(message(BASELINE, REST, 2, sensor=str(n)) for n in range(65)))),
        ("of another release", of_scans({}, text=b"int8 a\n")),
        ("more scans than 1,000 bytes hold", of_scans(*({"time_ns": 10 + n} for n in range(6)))),
    ],
    ids=lambda one: one if isinstance(one, str) else "",
)
def test_what_no_recording_holds_is_refused(tmp_path, limits, words, records):
    if "1,000 bytes" in words:
        limits(mcap_recording, MOST_KEPT_BYTES=1000)
    refused(written(tmp_path, *records), words)


@pytest.mark.parametrize("log_ns", [1 << 63, (1 << 31) * 10**9, 10, 0])
@pytest.mark.parametrize("second_ns", [10**9, 10, 0])
def test_what_is_read_can_be_recorded_again(tmp_path, log_ns, second_ns):
    first, second = SCAN.encode(GOOD | {"time_ns": 10**9}), SCAN.encode(GOOD | {"sensor": "6", "time_ns": second_ns})
    messages = [Message(1, log_ns, data, log_ns, 0) for data in (first, second)]
    path = written(tmp_path, *channel_of(SCAN), *messages)
    if not 0 <= log_ns + second_ns - 10**9 <= log_ns < (1 << 31) * 10**9:
        refused(path, r"a scan of sensor '[46]' at -?[0-9,]+ ns since 1970, expected 0\.\.")
        return
    contract = make_contract()
    with open_recording(path) as source:
        sink = open_sink(f"mcap:{tmp_path}/again.mcap", contract, source)
        for result in Stream(source, Runtime(FakeModel(contract), source=source.kind)):
            sink.write(result, {})
        sink.close()
    tracks = load_recording(tmp_path / "again.mcap").tracks
    assert {one.sensor: one.time_ns.tolist() for one in tracks} == {"4": [10**9], "6": [second_ns]}


def chunk(data, compression="zstd", size=None, crc=0, packed=None):
    packed = (zstandard.compress(data) if compression else data) if packed is None else packed
    return Chunk(compression, packed, 0, 0, crc, len(data) if size is None else size)


BOMB = zstandard.compress(bytes(1 << 28))
UNSIZED_BOMB = zstandard.ZstdCompressor(write_content_size=False).compress(bytes(1 << 28))


@pytest.mark.parametrize(
    ("broken", "words"),
    [
        (chunk(b"", size=1 << 40), "expected at most"),
        (chunk(b"", packed=BOMB, size=1 << 28), "expected at most"),
        (chunk(b"", packed=BOMB, size=1 << 20), r"does not hold the 1,048,576 bytes"),
        (chunk(b"", packed=UNSIZED_BOMB, size=1 << 20), "cannot be read"),
        (chunk(b"abc", packed=b"nothing"), "cannot be read"),
        (chunk(b"abc", crc=1), "crc validation failed"),
        (chunk(b"abc", "lz4"), "compressed by 'lz4', expected zstd or nothing"),
        (chunk(b"abc"), "cannot be read"),
        (chunk(struct.pack("<BQ", 5, 1 << 60)), "a chunk that is cut off"),
        (struct.pack("<BQ", 6, 1 << 62), "exceeds limit"),
        (struct.pack("<BQ", 4, 8) + b"\xff" * 8, "breaks off"),
        (struct.pack("<BQ", 6, 40) + bytes(28) + struct.pack("<IQ", 0, 1 << 62), "breaks off"),
        (chunk(bytes(MOST_CHUNK_BYTES + 1), ""), "expected at most"),
    ],
)
def test_chunks_made_to_harm_end_it_and_keep_what_was_before(tmp_path, broken, words):
    scan = message(SCAN, GOOD)
    recording = load_recording(written(tmp_path, *channel_of(SCAN), scan, broken, scan))
    assert len(recording.tracks[0].counts) == 1
    note, _ = recording.notes
    assert len(note) < 1000 and "\n" not in note
    if words != "breaks off":
        left = re.search(r"is damaged \(.*\): ([0-9,]+) bytes after that are not read", note)[1]
        assert 0 < int(left.replace(",", "")) < (tmp_path / "made.mcap").stat().st_size
    with pytest.raises(RecordingError, match=words):
        load_recording(written(tmp_path, broken))


def test_files_put_behind_the_first_are_not_read_and_noted(tmp_path):
    """As `cat first.mcap second.mcap` leaves it, of which nobody heard that the second half is missing."""
    end = (DataEnd(0), Footer(0, 0, 0), MCAP0_MAGIC)
    path = written(tmp_path, *channel_of(SCAN), message(SCAN, GOOD), *end)
    alone = path.read_bytes()
    assert not any("not read" in note for note in load_recording(path).notes)
    path.write_bytes(alone * 2)
    note = load_recording(path).notes[0]
    size = f"{len(alone):,}"
    assert note.endswith(f"(another file follows at byte {len(alone)}): {size} bytes after that are not read")

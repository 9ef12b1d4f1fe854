"""Recordings that a tool has copied in part: messages alone, some of their topics, or those from some time on."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from edge_samples import BASELINE, FakeModel, fake_source, make_scan
from mcap_samples import OFFSET_NS, SURE, TURNED, make_results, messages_alone, record_into

from edge import api
from edge.api import open_recording, open_runtime
from edge.perception.runtime import Runtime
from edge.pipeline.result_stream import Stream
from edge.sinks.mcap import McapSink
from firmware_bridge.errors import RecordingError
from firmware_bridge.pad_geometry import SensorGeometry
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.scan import Scan

PERIOD_NS = 50_000_000


@pytest.fixture(scope="module")
def turned(tmp_path_factory):
    """Three seconds of a sensor that sits turned, and of one that does not."""
    scans = [
        make_scan(number, sensor=name, time_ns=(number + 1) * PERIOD_NS, press_counts=3000, noise=2)
        for number in range(60)
        for name in ("4", "left/6")
    ]
    results = make_results(scans, mountings={"4": TURNED})
    return record_into(tmp_path_factory.mktemp("turned") / "turned.mcap", results, mountings={"4": TURNED})


def patterns(path):
    with open_recording(path) as source:
        runtime = open_runtime(FakeModel(SURE), source, every_scan=True)
        results = []
        while (taken := source.take(1.0)) is not None:
            results += [runtime.push(one) for one in taken if isinstance(one, Scan)]
    return [(one.scan.time_ns, one.zeroed.tobytes()) for one in results]


@pytest.mark.parametrize("start_ns", [0, OFFSET_NS + 21 * PERIOD_NS + 1])
def test_messages_alone_give_the_same_patterns(turned, tmp_path, start_ns):
    part = messages_alone(turned, tmp_path / "part.mcap", start_ns=start_ns)
    recording = load_recording(part)
    assert recording.origin == "device" and recording.notes == () and dict(recording.mountings) == {"4": TURNED}
    assert {name: one.id for name, one in recording.baselines.items()} == {"4": BASELINE.id, "left/6": BASELINE.id}
    assert patterns(part) == [one for one in patterns(turned) if one[0] + OFFSET_NS >= start_ns]


def test_a_baseline_of_later_is_none_of_the_beginning(tmp_path):
    results = make_results([make_scan(number, time_ns=(number + 1) * PERIOD_NS) for number in range(60)])
    taken = replace(BASELINE, created_unix_s=(OFFSET_NS + 30 * PERIOD_NS) / 1e9)
    results = [replace(one, baseline=taken if number >= 30 else None) for number, one in enumerate(results)]
    assert load_recording(record_into(tmp_path / "zeroed.mcap", results)).baselines == {}


def test_what_a_tool_left_out_is_named(turned, tmp_path):
    part = messages_alone(turned, tmp_path / "part.mcap", topics="/s4/scan")
    (note,) = load_recording(part).notes
    assert "the mounting of sensor 4 is not in the file" in note and "--sensor FILE" in note


def scans_alone(path, to):
    return messages_alone(path, to, topics="/s4/scan")


@pytest.mark.parametrize(
    ("kind", "copy"),
    [("device", Path.rename), ("emulated", Path.rename), ("emulated", messages_alone), ("emulated", scans_alone)],
)
def test_an_emulated_sensor_stays_one_in_every_generation(tmp_path, kind, copy):
    path = record_into(tmp_path / "first.mcap", make_results([make_scan()], source=kind))
    for generation in range(3):
        path = copy(path, tmp_path / f"{generation}-copy.mcap")
        recording = load_recording(path)
        assert recording.origin == kind
        assert (f"{path} was recorded from an emulated sensor" in recording.notes) == (kind == "emulated")
        with open_recording(path) as source:
            path = tmp_path / f"{generation}.mcap"
            sink = api.open_sink(f"mcap:{path}", SURE, source)
            for result in Stream(source, Runtime(FakeModel(SURE), source=source.kind)):
                assert result.source == "replay"
                sink.write(result, {})
            sink.close()


@pytest.mark.parametrize(("rows", "cols"), [(4, 6), (5, 5)])
def test_another_pad_is_known_without_metadata(tmp_path, rows, cols):
    geometry, grid = SensorGeometry("mine", rows, cols, 5.0, 30.0, 30.0), (rows, cols)
    baseline = replace(BASELINE, counts=np.full((3, *grid), 30_000.0, np.float32))
    sink = McapSink(tmp_path / "a.mcap", SURE, fake_source(unix_offset_ns=OFFSET_NS, geometry=geometry))
    result = make_results([make_scan()])[0]
    everything = np.ones(grid, bool)
    scan = replace(result.scan, counts=np.full((3, *grid), 30_000, np.int32), fresh=everything, renewed=everything)
    sink.write(replace(result, scan=scan, baseline=baseline, pattern=None), {})
    sink.close()
    recording = load_recording(messages_alone(tmp_path / "a.mcap", tmp_path / "b.mcap"))
    assert recording.tracks[0].geometry == geometry


def test_two_mountings_of_one_sensor_are_refused(turned, tmp_path):
    straight = record_into(tmp_path / "straight.mcap", make_results([make_scan()]), mountings={"4": Mounting()})
    with pytest.raises(RecordingError, match="two mountings of sensor '4'"):
        load_recording(messages_alone(turned, tmp_path / "both.mcap", more=straight))

"""Recordings in other people's programs: public readers, and the layouts of viewers."""

import ast
import json
import time
from dataclasses import replace

import numpy as np
from edge_samples import ROOT, make_contract, make_wrench_result
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from mcap_samples import OFFSET_NS, make_results, odd_scans

from edge.perception.event import Event
from edge.pipeline.sink import RunFacts
from edge.sinks.mcap import McapSink
from edge.sinks.ros2.cdr_messages import RESULT
from firmware_bridge.sensor_file.pad_frame import PadFrame


def test_public_readers_find_units_frames_and_marks(tmp_path):
    """By the definitions in the file alone, as Foxglove and Rerun read it."""
    results = [replace(one, source="emulated") for one in make_results(odd_scans())]
    path = tmp_path / "press.mcap"
    sink = McapSink(
        path, make_contract(), RunFacts(unix_offset_ns=OFFSET_NS, frames={"4": PadFrame("tool0", (0, 0, 50.5))})
    )
    for result in results:
        scan = replace(result.scan, device_ns=result.scan.time_ns - 2_000_000)
        sink.write(replace(result, scan=scan), {})
    sink.close()
    with path.open("rb") as file:
        found = list(make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages())
    messages = {channel.topic: message for _, channel, _, message in found}
    units = {channel.topic: channel.metadata.get("unit") for _, channel, _, _ in found}
    assert (units["/s4/pattern"], units["/left/s6/deviation"], units["/s4/scan"]) == ("m", "m", None)
    for what in ("scan", "result", "pattern", "deviation", "baseline"):
        for sensor in ("4", "left/6"):
            header = messages[f"/{'s4' if sensor == '4' else 'left/s6'}/{what}"].header
            assert header.frame_id == f"emulated/{sensor}", "a scan of no sensor that is not marked"
    (transform,) = messages["/tf_static"].transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("tool0", "emulated/4")
    assert transform.transform.translation.z == 0.0505 and transform.transform.rotation.w == 1
    newest = [one for one in results if one.scan.sensor == "4" and one.pattern is not None][-1]
    pattern = messages["/s4/pattern"]
    assert np.frombuffer(bytes(pattern.data), "<f4").max() == np.float32(newest.pattern.max()) * np.float32(1e-3)
    stamp_ns = pattern.header.stamp.sec * 10**9 + pattern.header.stamp.nanosec
    assert stamp_ns == newest.scan.time_ns - 2_000_000 + OFFSET_NS, "of arrival, though the device states a time"


def field_is_in(path, text):
    """Return whether a path as Foxglove writes it, such as wrench.force.x, leads to a number in a type's text."""
    own, *parts = text.split("=" * 80)
    types = {part.split("\n", 2)[1].removeprefix("MSG: "): part.split("\n", 2)[2] for part in parts}
    for name in path.split("."):
        kinds = {words[1]: words[0] for words in map(str.split, own.splitlines()) if len(words) > 1}
        if name not in kinds:
            return False
        own = types.get(kinds[name], "")
    return True


def test_the_layout_for_foxglove_shows_what_a_recording_holds(tmp_path):
    layout = json.loads((ROOT / "examples/viewers/foxglove.json").read_text())
    sink = McapSink(tmp_path / "press.mcap", make_contract(), RunFacts(frames={"4": PadFrame("tool0", (0, 0, 50.5))}))
    result = make_wrench_result()
    sink.write(replace(result, deviation=result.pattern / 10), {})
    sink.tell(Event(time.monotonic_ns(), "note", None, "hello"), {})
    sink.close()
    with (tmp_path / "press.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    recorded = {one.topic: summary.schemas[one.schema_id].data.decode() for one in summary.channels.values()}
    panels = layout["configById"]

    def leaves(node):
        return [node] if isinstance(node, str) else [*leaves(node["first"]), *leaves(node["second"])]

    assert sorted(leaves(layout["layout"])) == sorted(panels), "a panel that is not there, or not shown"
    images = [panel["imageMode"] for panel in panels.values() if "imageMode" in panel]
    assert {one["imageTopic"] for one in images} == {"/s4/pattern", "/s4/deviation"}
    assert all(one["imageTopic"] in recorded and one["maxValue"] < 1e-3 for one in images), "in metres"
    paths = [line["value"] for panel in panels.values() for line in panel.get("paths", ())]
    assert len(paths) == 7
    for path in paths:
        topic, _, field = path.partition(".")
        assert field_is_in(field, recorded[topic]), path
    assert panels["RosOut!events"]["topicToRender"] in recorded and "/tf_static" in recorded


def test_the_layout_for_rerun_plots_numbers_that_a_result_has():
    """Rerun itself, of 170 MB, is not installed for the tests."""
    tree = ast.parse((ROOT / "examples/viewers/rerun_view.py").read_text())
    assigned = {one.targets[0].id: one.value for one in tree.body if isinstance(one, ast.Assign)}
    plots = ast.literal_eval(assigned["PLOTS"])
    assert ast.literal_eval(assigned["RESULT"]) == RESULT.name
    assert {number for numbers in plots.values() for number in numbers} <= {field.name for field in RESULT.fields}

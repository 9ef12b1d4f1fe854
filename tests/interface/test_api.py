"""The runtime as a library, with poses from any thread, and that the command line is made of nothing else."""

import json
import re
import threading
import time
from dataclasses import fields
from typing import get_type_hints

import numpy as np
import pytest
from cli_samples import files, records, run, write_recording
from edge_samples import BASELINE, ROOT, FakeLink, FakeModel, make_scan
from mcap_samples import SURE, arrays_of
from pose_samples import PosedModel, posed_pattern

from edge import api
from edge.api import Pad, Stream, UsageError, load_model, open_recording, open_runtime, open_sink, open_source
from edge.pipeline.scan_reader import Source
from firmware_bridge.links.base import Notice
from firmware_bridge.poses import PadPose
from firmware_bridge.scans.mounting import Mounting

__all__ = ["files"]
NAN = float("nan")
OF_24 = {"4": Mounting(taxel_count=24)}
OF_THE_MOMENT = ("counters", "time_ns", "run_time_us", "latency_us", "baseline_age_s", "device_time_ns")


def test_types_that_are_asked_for_are_public():
    asked = re.findall(r"(?:edge|firmware_bridge)[\w.]*\.(\w+)", str(get_type_hints(Stream.__init__)))
    assert {"Commands", "Event"} <= set(asked) <= set(api.__all__)


def test_the_page_tells_of_everything_that_a_result_has():
    """Attributes are named as the keys of a record, unless the page says so."""
    pages = (("python.md", "## What a result has"), ("formats.md", "## Records"))
    tables = [(ROOT / "docs" / page).read_text().partition(head)[2].partition("\n## ")[0] for page, head in pages]
    assert {field.name for field in fields(api.Result)} <= set(re.findall(r"`(\w+)`", "".join(tables)))


def timeless(record):
    """Return the parts of a record without its time; a reader, with its counters, may be ahead of the scan."""
    return {name: value for name, value in record.items() if name not in OF_THE_MOMENT}


def played(files, **settings):
    out, model = files / "api.jsonl", load_model(files / "sure.onnx")
    with open_recording(files / "taps.npz") as source:
        runtime = open_runtime(model, source, baselines=files / "zero.json", **settings)
        sink, stream = open_sink(f"jsonl:{out}", model.contract, source), Stream(source, runtime)
        for result in stream:
            sink.write(result, stream.counters)
        sink.close()
    return records(out.read_text())


def test_records_of_the_command_line_are_those_of_the_api(files):
    fixed = ["replay", files / "taps.npz", "--model", files / "sure.onnx", "--baseline", files / "zero.json"]
    thresholds = {"contact_on_counts": 2000, "contact_off_counts": 900, "counts_per_newton": 1200, "idle_reset_s": 0.1}
    options = [f"--{name.replace('_', '-')}={value}" for name, value in thresholds.items()]
    for typed, settings in (([], {}), (["--every-scan", *options], thresholds | {"every_scan": True})):
        made, said = played(files, **settings), records(run(*fixed, "--sink", "jsonl:-", *typed).stdout)
        assert len(said) == 40 and {one["state"] for one in said} == {"idle", "contact"}
        assert [timeless(one) for one in made] == [timeless(one) for one in said]


def stream(source, model=None, **settings):
    return Stream(source, open_runtime(model or FakeModel(), source, baselines={"4": BASELINE}), **settings)


@pytest.mark.parametrize(
    ("ask", "words"),
    [
        (lambda _: open_runtime(FakeModel(), open_source("demo")), "^source demo is not open: use it in a with"),
        (lambda _: next(iter(stream(open_source("demo")))), "^source demo is not open: use it in a with statement"),
        (lambda _: open_source("demo", give_up_s=NAN), "give_up_s is nan, expected 0 or more"),
        (lambda _: open_source(["demo"]), r"source is \['demo'\], expected text"),
        (lambda _: api.examine("demo", rate_hz=-1), "rate_hz is -1, expected a positive number"),
        (lambda _: api.examine("demo", baselines={"4": 1}), "baseline of sensor 4 is a int, expected"),
        (lambda _: api.examine("demo", "demo"), "^2 sources, expected one: examine them one after"),
        (lambda _: open_runtime(FakeModel(), "demo"), "source is 'demo', expected an open one"),
        (lambda source: open_runtime(FakeModel(), source, counts_per_newton=0), "counts_per_newton is 0, expected a"),
        (lambda source: open_runtime(FakeModel(), source, counts_per_newton={"6": NAN}), "newton of sensor 6 is nan"),
        (lambda source: open_runtime(FakeModel(), source, pad={"6": 1}), "pad of sensor 6 is a int, expected a Pad"),
        (lambda source: open_runtime(FakeModel(), source, pad=Pad(gains=(1.0,) * 6)), "6 gains, expected 48, three"),
        (lambda source: open_runtime(FakeModel(), source, baselines={"4": 1}), "baseline of sensor 4 is a int"),
        (lambda source: open_runtime(FakeModel(), source, baselines=[BASELINE]), "baselines are a list, expected"),
        (lambda source: open_runtime(FakeModel(), source, baselines={4: BASELINE}), "baseline of sensor 4: expected"),
        (lambda source: open_runtime(FakeModel(), source, pad={4: Pad()}), "pad of sensor 4: expected its name as t"),
        (lambda source: open_runtime(None, source), "model is None, expected the name of one, its file"),
        (lambda source: open_sink(5, SURE, source), "sink is 5, expected text"),
        (lambda source: open_sink("jsonl:-", load_model("stsr"), source), "contract is .*, expected that of the model"),
        (lambda source: open_sink("jsonl:-", SURE, None), "source is None, expected an open one"),
        (lambda source: stream(source, sinks=[5]), "sink is 5, expected what open_sink returned"),
        (lambda source: stream(source, sinks=5), "sinks is 5, expected a list"),
        (lambda source: Stream(source, None), "runtime is None, expected what open_runtime returned"),
        (lambda _: Stream(None, None), "source is None, expected an open one"),
        (lambda _: api.Commands().put("zero"), r'command is \'zero\', expected a Command, such as Command\("zero"\)'),
        *(
            (
                lambda _, wrong=wrong: api.Command(*wrong),
                r"^Command\(name=.*, expected 'reset' or 'zero', a sensor's name",
            )
            for wrong in (("Reset",), ("zero", 4), ("zero", "4", 1), ("zero", ""))
        ),
        (lambda _: api.Commands().poses.put(PadPose(0, 0)), "pose is PadPose.*, expected a TimedPose"),
        (lambda source: open_runtime(FakeModel(), source).pose((1, 2, 3), 0), r"pose is \(1, 2, 3\), expected a PadP"),
        (lambda _: api.ObjectMap(centre_mm=(NAN, 0)), r"centre of a map is \(nan, 0\), expected two finite numbers"),
        (lambda source: stream(source, duration_s=-1), "duration_s is -1, expected a positive number"),
        (lambda source: stream(source).read(timeout_s=0), "timeout_s is 0, expected a positive number"),
        (lambda _: api.Runtime(FakeModel(), source="device", mountings=OF_24), "sensor 4 is of 24 taxels, expected 16"),
        (lambda source: stream(source, clock_ns=lambda: 0).pose(0, 0, time_ns=10**18), "time_ns is .* ahead of"),
    ],
)
def test_what_cannot_be_is_one_line(ask, words):
    with Source(FakeLink([])) as source, pytest.raises(UsageError, match=words) as raised:
        ask(source)
    assert "\n" not in str(raised.value)


def test_a_loop_that_was_left_goes_on_with_the_next_result():
    """Scans that waited in its batch have their results, and a cable that was out in between is not forgotten."""
    torn = make_scan(10, press_counts=3000, absent=(1,))
    link = FakeLink([[make_scan(n, press_counts=3000) for n in range(9)], *[[]] * 9, [torn, make_scan(11)]])
    link.notices = lambda: [Notice(0, kind, kind) for kind in ("lost", "back")] if link.reads == 11 else []
    heard = []
    with Source(link) as source:
        while not link.ended:
            time.sleep(0.001)
        results = stream(source, on_event=lambda event: heard.append(event.kind))
        for result in results:
            heard.append(result.scan.number)
            break
        for result in results:
            heard.append(result.scan.number)
        assert list(results) == []
    assert heard == [*range(9), "lost", "back", 10, 11]
    assert results.statistics.scans == 11


def test_a_silent_sensor_that_an_option_names_is_reported():
    link = FakeLink([[make_scan(n)] for n in range(100)])
    events = []
    with Source(link) as source:
        other = api.Baseline.of("6", BASELINE.counts, 1000.0, 100, "file")
        baselines, newtons = {"4": BASELINE, "6": other}, {"4": 1000.0, "l": 1000.0}
        runtime = open_runtime(FakeModel(), source, baselines=baselines, counts_per_newton=newtons)
        list(Stream(source, runtime, on_event=events.append))
    assert [(event.kind, event.sensor) for event in events] == [("silent", "6"), ("silent", "l")]


def test_the_doctors_findings_are_those_of_the_api(files):
    arguments = (f"replay:{files}/rest.npz",)
    findings = api.examine(*arguments, baselines=files / "zero.json", rate_hz=400, duration_s=30)
    options = ("--source", *arguments, "--baseline", files / "zero.json", "--rate-hz", 400, "--drift-s", 30)
    told = json.loads(run("doctor", "--json", "--no-press", *options).stdout)["findings"]
    assert [one.name for one in findings] == [one["name"] for one in told if one["name"] != "guided press"]
    verdicts = {one.name: one.verdict for one in findings}
    assert verdicts["noise"] == verdicts["load"] == verdicts["baseline"] == "ok"


PRESSES = [0, 3000, 3000, 0, 0, 3000, 3000]


def test_poses_of_another_thread_are_those_of_the_next_scans(tmp_path):
    steps = [threading.Event() for _ in PRESSES]
    batches = []
    for number, (press, step) in enumerate(zip(PRESSES, steps, strict=True)):
        batches += [[make_scan(number, press_counts=press)], step]
    now_ns = [0]
    with Source(FakeLink(batches)) as source:
        model = PosedModel()
        runtime = open_runtime(model, source, baselines={"4": BASELINE})
        sink = open_sink(f"mcap:{tmp_path}/out.mcap", model.contract, source)
        stream = Stream(source, runtime, sinks=[sink], clock_ns=lambda: now_ns[0])
        results = []
        for result in stream:
            results.append(result)
            now_ns[0] = result.scan.time_ns + 1
            place = {"x_mm": np.float32(len(results)), "y_mm": 0, "turn_deg": 5}
            thread = threading.Thread(target=stream.pose, kwargs=place | {"holds": True, "error_mm": 0.5})
            thread.start()
            thread.join()
            steps[result.scan.number].set()
        sink.close()
    assert [result.pose and result.pose.x_mm for result in results] == [None, *range(1, len(PRESSES))]
    last, turn = results[-1], np.radians(5)
    assert last.pose == PadPose(6, 0, 5, 0.5)
    assert last.taps_used == 2 and last.poses[1, :2] == pytest.approx([(1 - 6) * np.cos(turn), 5 * np.sin(turn)])
    window = model.contract.scale_window(last.window)
    np.testing.assert_allclose(last.pattern, posed_pattern(window, last.poses), atol=1e-4)
    assert stream.statistics.poses == len(PRESSES) - 1
    arrays = arrays_of(tmp_path / "out.mcap")
    assert arrays["poses"].shape == (len(results), 7, 5) and arrays["scan_pose"].shape == (len(results), 5)
    assert np.isnan(arrays["poses"][0]).all() and np.isnan(arrays["scan_pose"][0]).all()
    np.testing.assert_allclose(arrays["scan_pose"][2], [2, 0, 5, 0.5, 1], rtol=1e-4)
    np.testing.assert_allclose(arrays["poses"][-1, :2], last.poses, atol=1e-4)
    assert np.isnan(arrays["poses"][-1, 2:]).all()


def test_of_a_recording_poses_are_stated_at_its_own_times(tmp_path):
    write_recording(tmp_path / "taps.npz", PRESSES)
    with open_recording(tmp_path / "taps.npz", zero=True) as source:
        runtime = open_runtime(FakeModel(), source, baselines={"4": BASELINE})
        stream = Stream(source, runtime)
        with pytest.raises(UsageError, match=r"is a recording: give `runtime.pose` a PadPose and a time of its scans"):
            stream.pose(0, 0)
        with pytest.raises(UsageError, match=r"without a latest.*paced=True"):
            stream.latest()
        runtime.pose(api.PadPose(3, 4), 0, holds=True)
        assert {result.pose for result in stream} == {PadPose(3, 4)}

"""JSON Lines: one record per scan, and what becomes of them on pipes."""

import fcntl
import json
import os
from contextlib import closing, suppress
from dataclasses import replace

import numpy as np
import orjson
import pytest
from edge_samples import BASELINE, FakeModel, fake_source, make_contract, make_scan
from sink_samples import CONTRACT, RUN, make_results, make_sure_results

from edge.api import Runtime, SinkError
from edge.sinks.json_records import ALWAYS, RecordForm, has_room
from edge.sinks.registry import open_sink
from firmware_bridge.scans.scan import VendorReading


def record_line(result, counters):
    return orjson.dumps(RecordForm(maps=True).of(result, counters), option=orjson.OPT_SERIALIZE_NUMPY) + b"\n"


def test_each_result_is_written_whole_though_patterns_repeat(tmp_path):
    """A repeated pattern is the same array, of one sensor; others, and scans without one, come between."""
    baselines = {name: replace(BASELINE, sensor=name) for name in ("4", "6")}
    runtime = Runtime(FakeModel(make_contract(interval_factor=1.6)), source="device", baselines=baselines)
    presses = [(3000, "4"), (5000, "6"), (3000, "4"), (5000, "6"), (0, "4"), (3000, "4"), (7000, "4"), (7000, "4")]
    results = [runtime.push(make_scan(n, press_counts=z, sensor=name)) for n, (z, name) in enumerate(presses)]
    assert [result.reused_from for result in results] == [None, None, 0, 1, None, None, None, 6]
    path = tmp_path / "out.jsonl"
    path.write_text('{"time_ns":5,"sensor":"old"}\n')
    sink, expected = open_sink(f"jsonl:{path}", CONTRACT, fake_source()), b""
    for number, result in enumerate(results):
        sink.write(result, RUN)
        expected += record_line(result, None if number > 1 else RUN | {"unwritten": 0})  # the first of each sensor
        assert path.read_bytes() == expected, "there as soon as it is written"
        told = json.loads(expected.splitlines()[-1], parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
        assert result.pattern is None or (np.array(told["pattern"], np.float32) == result.pattern).all()
    sink.close()


def test_a_run_that_cannot_begin_leaves_earlier_records(tmp_path):
    """As of `edge-sr --sink jsonl:out.jsonl --sink mcap:FILE` where FILE exists."""
    path, results = tmp_path / "out.jsonl", make_results(1)
    first = open_sink(f"jsonl:{path}", CONTRACT, fake_source())
    first.write(results[0], RUN)
    with pytest.raises(SinkError, match=r"out\.jsonl: another run writes to it: end that, or give another name"):
        open_sink(f"jsonl:{path}", CONTRACT, fake_source())
    first.write(results[1], RUN)
    first.close()
    open_sink(f"jsonl:{path}", CONTRACT, fake_source()).close()
    assert [json.loads(line)["sensor"] for line in path.read_text().splitlines()] == ["4", "6"]


@pytest.mark.parametrize("content", [b"txl1_x,txl1_y\n", b'{\n  "format": "tactile-baseline"', b"\x89MCAP", b"{"])
def test_what_holds_no_records_is_not_replaced(tmp_path, content):
    """As of `edge-sr replay press.csv --sink jsonl:press.csv`, which left no recording."""
    path = tmp_path / "press.csv"
    path.write_bytes(content)
    with pytest.raises(SinkError, match=r"press\.csv: it holds something else: give another name"):
        open_sink(f"jsonl:{path}", CONTRACT, fake_source())
    assert path.read_bytes() == content


@pytest.mark.parametrize(
    ("chosen", "more"),
    [
        ("force_counts", {"force_counts"}),
        ("deviation, pattern", {"deviation", "pattern"}),
        ("trusted,temperature_k", set()),  # a field that is left out where it is unknown
    ],
)
def test_a_record_holds_named_fields_and_what_a_robot_must_see(chosen, more, tmp_path):
    whole, path = make_sure_results()[6], tmp_path / "out.jsonl"
    sink = open_sink(f"jsonl:{path}", CONTRACT, fake_source(), fields=chosen)
    sink.write(whole, RUN)
    sink.close()
    record, expected = json.loads(path.read_bytes()), json.loads(record_line(whole, RUN | {"unwritten": 0}))
    assert whole.pattern is not None and {"source", "state", "trusted", "note", "pattern_unit"} < record.keys()
    assert record.keys() == {*ALWAYS, "counters", *more}
    assert record == {name: expected[name] for name in record}


def test_separate_contacts_are_in_a_record_where_they_are_named(tmp_path):
    pattern = np.zeros((40, 40), dtype=np.float32)
    pattern[4:10, 4:14], pattern[25:35, 25:35] = 0.2, 0.4
    results = [replace(make_sure_results()[6], pattern=pattern, trusted=True), make_sure_results()[0]]
    with closing(open_sink(f"jsonl:{tmp_path}/out", CONTRACT, fake_source(), fields="contacts")) as sink:
        for result in results:
            sink.write(result, RUN)
    touched, free = map(json.loads, (tmp_path / "out").read_bytes().splitlines())
    assert free["contacts"] == [] and touched.keys() == {*ALWAYS, "counters", "contacts"}
    strong, weak = touched["contacts"]
    assert strong["area_mm2"] == pytest.approx(100 * 0.47**2, abs=1e-3) and weak["long_axis_deg"] == 0
    assert strong["centre_mm"] == pytest.approx([10 * 0.47, 10 * 0.47], abs=1e-3)
    assert strong["trusted"] is True and strong["force_n"] is None and len(weak["normal"]) == 3


def test_what_the_vendor_says_is_told_where_it_does():
    runtime = Runtime(FakeModel(), source="device", baselines={"4": BASELINE})
    newtons = np.full((3, 4, 4), 0.125, dtype=np.float32)
    vendor = VendorReading(newtons, np.array([[300.0, np.nan] * 2] * 4, dtype=np.float32))
    scans = replace(make_scan(), vendor=vendor), replace(make_scan(1, absent=(2,)), vendor=vendor), make_scan(2)
    told, absent, silent = (json.loads(record_line(runtime.push(scan), {})) for scan in scans)
    assert (told["vendor_force_n"], told["temperature_k"], told["force_n"]) == ([2.0, 2.0, 2.0], 300.0, 2.0)
    assert "vendor_force_n" not in absent and absent["force_n"] is None
    assert not {"vendor_force_n", "temperature_k"} & set(silent)
    calibrated = Runtime(FakeModel(), source="device", baselines={"4": BASELINE}, counts_per_newton=100.0)
    assert calibrated.push(replace(make_scan(press_counts=50), vendor=vendor)).force_n == 0.5  # the user's own wins


def test_a_slow_reader_holds_up_nothing_and_its_loss_is_counted(tmp_path):
    """Every record is written or counted, and each that is written is whole."""
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    reader = os.open(fifo, os.O_RDONLY | os.O_NONBLOCK)
    sink = open_sink(f"jsonl:{fifo}", CONTRACT, fake_source("device"))
    result, written = make_results(3)[4], 300
    for _ in range(written):
        sink.write(result, {})  # would wait for ever
    os.set_blocking(reader, False)
    data = b""
    with suppress(BlockingIOError):
        while True:
            data += os.read(reader, 1 << 20)
    lines = data.splitlines()
    assert 10 < len(lines) < written and all(json.loads(line)["scan"] == result.scan.number for line in lines)
    assert sink.unwritten == written - len(lines)
    sink.write(result, {"unwritten": 10**6})  # of other readers
    assert json.loads(os.read(reader, 1 << 20))["counters"]["unwritten"] == written - len(lines)
    sink.close()
    os.close(reader)


def test_a_pipe_smaller_than_a_record_has_room_while_it_is_empty(tmp_path):
    read_end, write_end = os.pipe()
    fcntl.fcntl(write_end, fcntl.F_SETPIPE_SZ, 4096)
    assert has_room(write_end, 25_000)
    os.write(write_end, b"1")
    assert not has_room(write_end, 25_000)
    os.close(read_end)
    os.close(write_end)

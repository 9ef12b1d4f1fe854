import contextlib
import fcntl
import io
import json
import os
import resource
import signal
import subprocess
import sys
import threading
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from edge_samples import BASELINE, PERIOD_NS, ROOT, FakeModel, ListSink, make_contract, make_scan
from hypothesis import given, settings
from hypothesis import strategies as st

from edge.errors import SinkClosedError, SinkError, UsageError
from edge.perception.event import Event
from edge.perception.result import Result
from edge.perception.runtime import Runtime
from edge.sinks import npz
from edge.sinks.event_printer import MessageSink
from edge.sinks.fan_out import Fan
from edge.sinks.jsonl import JsonLinesSink, record_line
from edge.sinks.npz import NpzSink, gather, parts_dir
from edge.sinks.pipe_capacity import has_room
from edge.sinks.registry import FORMS, open_sink
from edge.sinks.status_line import StatusSink
from firmware_bridge.errors import LinkLostError
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.scans.scan import ABSENT, VendorReading

SHAPES = ((3, 4, 4), (40, 40))
RUN = {"dropped": 2, "overruns": 1, "torn_wire": 3, "torn_source": 4}


def make_results(count=6, runtime=None, **settings):
    """Idle and contact in turn, of two sensors, some torn; sensor 6 has no baseline and stays in zeroing."""
    settings = {"source": "emulated", "baselines": {"4": BASELINE}, "unix_time_s": lambda: 1012.34} | settings
    runtime = runtime or Runtime(FakeModel(), **settings)
    results = []
    for number in range(count):
        for sensor in ("4", "6"):
            absent = (3, 7) if number % 4 == 2 else ()
            press = 3000 + 40 * (3 - number % 4) if number % 4 > 1 else 0
            scan = make_scan(number, sensor=sensor, press_counts=press, absent=absent, noise=3)
            results.append(runtime.push(scan))
    return results


def make_sure_results(count=6, **settings):
    """The same of a model that gives deviations."""
    settings = {"source": "emulated", "baselines": {"4": BASELINE}} | settings
    return make_results(count, Runtime(FakeModel(make_contract(interval_factor=1.6)), **settings))


def test_an_npz_keeps_the_model_of_each_row_however_long_its_name(tmp_path):
    model = FakeModel()
    model.name = "n" * 100
    sink = NpzSink(tmp_path / "out.npz", *SHAPES)
    sink.write(Runtime(model, source="device", baselines={"4": BASELINE}).push(make_scan(0)), RUN)
    sink.close()
    assert np.load(tmp_path / "out.npz")["model"].tolist() == ["n" * 32]


class TestJsonLines:
    def test_what_is_written_is_each_result_in_itself_however_patterns_are_given_again(self, tmp_path):
        """A pattern given again is the same array, of one sensor; between them come others and none."""
        baselines = {name: replace(BASELINE, sensor=name) for name in ("4", "6")}
        runtime = Runtime(FakeModel(make_contract(interval_factor=1.6)), source="device", baselines=baselines)
        presses = [(3000, "4"), (5000, "6"), (3000, "4"), (5000, "6"), (0, "4"), (3000, "4"), (7000, "4"), (7000, "4")]
        results = [runtime.push(make_scan(n, press_counts=z, sensor=name)) for n, (z, name) in enumerate(presses)]
        assert [result.reused_from for result in results] == [None, None, 0, 1, None, None, None, 6]
        sink = JsonLinesSink(str(tmp_path / "out.jsonl"))
        for result in results:
            sink.write(result, RUN)
        sink.close()
        counters = RUN | {"unwritten": 0}
        assert (tmp_path / "out.jsonl").read_bytes() == b"".join(record_line(result, counters) for result in results)

    def test_a_record_says_all_of_a_contact(self):
        ticks = iter([0, 123_456])
        runtime = Runtime(
            FakeModel(),
            source="emulated",
            baselines={"4": BASELINE},
            counts_per_newton=1200,
            clock_ns=lambda: next(ticks),
            unix_time_s=lambda: 1012.34,
        )
        result = runtime.push(make_scan(7, press_counts=3000, stale=(0, 15)))
        record = json.loads(record_line(result, RUN))
        pattern = record.pop("pattern")
        assert np.shape(pattern) == (40, 40)
        np.testing.assert_allclose(pattern, result.pattern, rtol=1e-5)
        assert record.pop("counts") == result.scan.counts.tolist()
        assert record.pop("centroid_mm") == pytest.approx([-2.35, -2.35])
        assert record.pop("deviation") is record.pop("traction") is None
        assert record.pop("wrench") is record.pop("wrench_origin") is record.pop("shear_ratio") is None
        assert record == {
            "time_ns": 8 * PERIOD_NS,
            "device_time_ns": None,
            "sensor": "4",
            "scan": 7,
            "source": "emulated",
            "state": "contact",
            "fresh": 0xFFFF,
            "renewed": 0x7FFE,
            "contact": True,
            "taps_used": 1,
            "force_counts": 3000.0,
            "force_n": 2.5,
            "area_mm2": 22.09,
            "interval_mm": None,
            "expected_rmse_mm": None,
            "another_tap": None,
            "reused_from": None,
            "run_time_us": 123.5,
            "latency_us": None,
            "baseline": BASELINE.id,
            "baseline_origin": "file",
            "baseline_age_s": 12.3,
            "drift_counts": {"common": [0.0, 0.0, 0.0], "own": 0.0, "step": 0.0},
            "model": "fake",
            "dead": {},
            "filled": None,
            "note": None,
            "event": None,
            "counters": RUN,
            "pattern_unit": "mm",
        }

    def test_absent_is_null(self):
        runtime = Runtime(FakeModel(), source="device")
        record = json.loads(record_line(runtime.push(make_scan(absent=(2,))), {}))
        absent = "contact force_counts force_n area_mm2 centroid_mm interval_mm run_time_us pattern deviation"
        for name in absent.split():
            assert record[name] is None
        assert (
            record["baseline"]
            is record["baseline_age_s"]
            is record["baseline_origin"]
            is record["drift_counts"]
            is None
        )
        assert record["state"] == "zeroing" and record["fresh"] == 0xFFFF - 4
        assert [axis[0][2] for axis in record["counts"]] == [None] * 3
        assert ABSENT not in np.array(record["counts"]).ravel().tolist()

    def test_a_deviation_stands_beside_its_pattern_in_the_same_digits(self):
        result = make_sure_results(3)[4]
        record = json.loads(record_line(result, {}))
        for name in ("pattern", "deviation"):
            np.testing.assert_allclose(record[name], getattr(result, name), rtol=2e-7, atol=0.51e-7)
        assert record["pattern"] != record["deviation"]
        assert record["interval_mm"] == pytest.approx(1.6 * 0.04, abs=1e-3)
        assert record["interval_mm"] == round(result.interval_mm, 5)

    def test_what_the_vendor_says_is_told_where_it_does(self):
        runtime = Runtime(FakeModel(), source="device", baselines={"4": BASELINE})
        newtons = np.full((3, 4, 4), 0.125, dtype=np.float32)
        vendor = VendorReading(newtons, np.array([[300.0, np.nan] * 2] * 4, dtype=np.float32))
        record = json.loads(record_line(runtime.push(replace(make_scan(), vendor=vendor)), {}))
        assert (record["vendor_force_n"], record["temperature_k"], record["force_n"]) == ([2.0, 2.0, 2.0], 300.0, 2.0)
        record = json.loads(record_line(runtime.push(replace(make_scan(1, absent=(2,)), vendor=vendor)), {}))
        assert "vendor_force_n" not in record and record["force_n"] is None
        record = json.loads(record_line(runtime.push(make_scan(2)), {}))
        assert not {"vendor_force_n", "temperature_k"} & set(record)
        calibrated = Runtime(FakeModel(), source="device", baselines={"4": BASELINE}, counts_per_newton=100.0)
        assert calibrated.push(replace(make_scan(press_counts=50), vendor=vendor)).force_n == 0.5  # the user's own wins

    @settings(max_examples=50, deadline=None)
    @given(st.lists(st.floats(-(2.0**99), 2.0**99, width=32, allow_subnormal=False), min_size=4, max_size=4))
    def test_patterns_keep_seven_decimals_and_are_json(self, values):
        result = make_results(3)[4]
        pattern = np.array(values, dtype=np.float32).reshape(2, 2)
        object.__setattr__(result, "pattern", pattern)
        line = record_line(result, {})
        got = json.loads(line, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))["pattern"]
        np.testing.assert_allclose(got, pattern, rtol=2e-7, atol=0.51e-7)
        assert line.endswith(b"}\n") and line.count(b"\n") == 1

    def test_a_file_holds_a_record_a_line_there_as_soon_as_written(self, tmp_path):
        path = tmp_path / "out.jsonl"
        path.write_text("old\n")
        sink = JsonLinesSink(str(path))
        results = make_results()
        for count, result in enumerate(results, 1):
            sink.write(result, RUN)
            assert len(path.read_text().splitlines()) == count
        sink.close()
        assert [json.loads(line)["scan"] for line in path.read_text().splitlines()] == [r.scan.number for r in results]

    def test_what_cannot_be_opened_is_told(self, tmp_path):
        with pytest.raises(SinkError, match=r"none/out.jsonl: No such file"):
            JsonLinesSink(str(tmp_path / "none" / "out.jsonl"))

    def test_a_full_disk_is_told_and_closing_stays_quiet(self):
        sink = JsonLinesSink("/dev/full")
        with pytest.raises(SinkError, match="/dev/full: No space left") as raised:
            sink.write(make_results(1)[0], {})
        assert not isinstance(raised.value, SinkClosedError)
        sink.close()

    def test_a_reader_that_has_gone_is_an_ordinary_end(self, tmp_path):
        fifo = tmp_path / "fifo"
        os.mkfifo(fifo)
        reader = os.open(fifo, os.O_RDONLY | os.O_NONBLOCK)
        sink = JsonLinesSink(str(fifo))
        sink.write(make_results(1)[0], {})
        os.close(reader)
        with pytest.raises(SinkClosedError, match="has gone"):
            sink.write(make_results(1)[0], {})
        sink.close()

    def test_an_event_is_a_record_told_by_its_state(self, tmp_path):
        sink = JsonLinesSink(str(tmp_path / "out.jsonl"), source="replay")
        sink.tell(Event(5, "lost", None, "the cable is out"), {"scans": 3})
        sink.close()
        assert json.loads((tmp_path / "out.jsonl").read_text()) == {
            "time_ns": 5,
            "sensor": None,
            "source": "replay",
            "state": "event",
            "event": "lost",
            "note": "the cable is out",
            "counters": {"scans": 3, "unwritten": 0},
        }

    def test_a_slow_reader_holds_up_nothing_and_what_it_missed_is_counted(self, tmp_path):
        """Every record is written or counted, and each that is written is whole."""
        fifo = tmp_path / "fifo"
        os.mkfifo(fifo)
        reader = os.open(fifo, os.O_RDONLY | os.O_NONBLOCK)
        sink = JsonLinesSink(str(fifo), patient=False)
        result, written = make_results(3)[4], 300
        for _ in range(written):
            sink.write(result, {})  # would wait for ever
        os.set_blocking(reader, False)
        lines = b"".join(iter(lambda: _read(reader), b"")).splitlines()
        assert 10 < len(lines) < written and all(json.loads(line)["scan"] == result.scan.number for line in lines)
        assert sink.unwritten == written - len(lines)
        sink.write(result, {"unwritten": 10**6})  # of other readers
        assert json.loads(os.read(reader, 1 << 20))["counters"]["unwritten"] == written - len(lines)
        sink.close()
        os.close(reader)

    def test_a_pipe_that_is_smaller_than_a_record_still_takes_it_from_a_reader_that_keeps_up(self, tmp_path):
        read_end, write_end = os.pipe()
        fcntl.fcntl(write_end, fcntl.F_SETPIPE_SZ, 4096)
        assert has_room(write_end, 25_000)
        os.write(write_end, b"1")
        assert not has_room(write_end, 25_000)
        os.close(read_end)
        os.close(write_end)

    def test_a_fifo_that_nobody_reads_is_refused_rather_than_waited_for(self, tmp_path):
        os.mkfifo(tmp_path / "fifo")
        with pytest.raises(SinkError, match=r"nobody reads \S+/fifo: start its reader first"):
            JsonLinesSink(str(tmp_path / "fifo"))

    def test_a_recording_is_waited_for(self, tmp_path):
        fifo = tmp_path / "fifo"
        os.mkfifo(fifo)
        reader = os.open(fifo, os.O_RDONLY | os.O_NONBLOCK)
        sink, result = JsonLinesSink(str(fifo)), make_results(3)[4]
        got, lines = [], 300

        def read():
            os.set_blocking(reader, True)
            while data := os.read(reader, 1 << 16):
                got.append(data)

        thread = threading.Thread(target=read)
        thread.start()
        for _ in range(lines):
            sink.write(result, {})
        sink.close()
        thread.join()
        os.close(reader)
        assert b"".join(got).count(b"\n") == lines


def _read(descriptor):
    try:
        return os.read(descriptor, 1 << 20)
    except BlockingIOError:
        return b""


class TestFan:
    class Failing(ListSink):
        def __init__(self, error):
            super().__init__(on_write=self.fail)
            self.error = error

        def fail(self, result):
            if self.error is not None:
                raise self.error

    def test_a_sink_that_fails_is_given_up_with_a_message_and_the_others_go_on(self):
        told = []
        fan, good, bad = Fan(told.append, lambda: 7), ListSink(), self.Failing(SinkError("disk full"))
        for sink in (bad, good):
            fan.add(sink)
        results = make_results(2)
        for result in results:
            fan.write(result, RUN)
        assert good.results == results and len(bad.results) == 1 and bad.closed
        assert told == good.events == [Event(7, "sink", None, "disk full; the other sinks go on")]
        with pytest.raises(SinkError, match="disk full"):
            fan.close()
        assert good.closed

    def test_trouble_that_lasts_is_told_once_and_again_when_it_comes_back(self):
        class Troubled(ListSink):
            trouble = None

        now_ns, told = [0], []
        fan, bad, good = Fan(told.append, lambda: now_ns[0]), Troubled(), ListSink()
        fan.add(bad)
        fan.add(good)
        for time_ms, trouble in ((100, "nobody"), (600, "nobody"), (1200, "nobody"), (1800, None), (2400, "nobody")):
            now_ns[0], bad.trouble = time_ms * 1_000_000, trouble
            fan.write(make_results(1)[0], RUN)
            assert fan.trouble == trouble
        assert [(event.time_ns, event.kind, event.text) for event in told] == [
            (time_ns, "sink", "nobody") for time_ns in (600_000_000, 2_400_000_000)
        ]
        assert good.events == told

    def test_one_that_fails_while_nothing_comes_is_given_up_too(self):
        fan, good, bad = Fan(lambda event: None), ListSink(), ListSink()
        bad.wait = lambda: self.Failing(SinkError("disk full")).fail(None)
        fan.add(bad)
        fan.add(good)
        fan.write(make_results(1)[0], RUN)
        fan.wait()
        fan.wait()
        assert good.waits == 2 and bad.closed and [event.kind for event in good.events] == ["sink"]
        assert good.told_counters == [RUN]  # and of what was counted nothing is forgotten

    def test_two_that_fail_together_leave_the_third(self):
        for acts in (
            lambda fan: fan.write(make_results(1)[0], RUN),
            lambda fan: fan.tell(Event(0, "lost", None, ""), RUN),
        ):
            fan, good = Fan(lambda event: None), ListSink()
            full = [JsonLinesSink("/dev/full") for _ in range(2)]
            for sink in (*full, good):
                fan.add(sink)
            acts(fan)
            fan.write(make_results(1)[0], RUN)
            assert len(good.results) >= 1 and len(fan.failures) == 2

    def test_what_ended_the_run_is_told_rather_than_a_sink_that_failed_before(self):
        fan = Fan(lambda event: None)
        for sink in (self.Failing(SinkError("disk full")), ListSink()):
            fan.add(sink)
        fan.write(make_results(1)[0], RUN)
        with pytest.raises(LinkLostError, match="gone"), contextlib.ExitStack() as closing:
            closing.callback(fan.close)
            raise LinkLostError("gone")

    def test_the_last_to_fail_ends_it(self):
        fan = Fan(lambda event: None)
        fan.add(self.Failing(SinkError("disk full")))
        with pytest.raises(SinkError, match="disk full"):
            fan.write(make_results(1)[0], RUN)

    def test_readers_that_go_are_an_ordinary_end_of_the_last_sink_alone(self):
        fan = Fan(lambda event: None)
        first, second = (self.Failing(SinkClosedError(name)) for name in "ab")
        second.error = None
        fan.add(first)
        fan.add(second)
        fan.write(make_results(1)[0], RUN)
        second.error = SinkClosedError("b")
        with pytest.raises(SinkClosedError, match="b"):
            fan.write(make_results(1)[0], RUN)
        fan.close()

    def test_one_that_cannot_be_finished_hinders_no_other(self):
        class Unfinished(ListSink):
            def close(self):
                raise SinkError("no room")

        fan, good = Fan(lambda event: None), ListSink()
        for sink in (Unfinished(), good):
            fan.add(sink)
        with pytest.raises(SinkError, match="no room"):
            fan.close()
        assert good.closed


@pytest.mark.parametrize("terminal", [True, False])
def test_events_are_lines_on_stderr(terminal):
    stream = Terminal() if terminal else io.StringIO()
    MessageSink(stream).tell(Event(0, "lost", None, "the cable is out"), {})
    assert stream.getvalue() == ("\r\x1b[K" if terminal else "") + "edge-sr: the cable is out\n"


def test_what_others_wrote_does_nothing_to_the_terminal():
    stream = io.StringIO()
    MessageSink(stream).tell(Event(0, "trouble", None, "\x1b[2J\x9b\rpad\n\ud800 in µm"), {})
    assert stream.getvalue() == "edge-sr: \\x1b[2J\\x9b\\rpad\\n\\ud800 in µm\n"


def test_what_to_do_is_said_ever_more_seldom_until_the_first_scan():
    stream, now_s = io.StringIO(), [0.0]
    messages = MessageSink(stream, hint="is it powered?", clock_s=lambda: now_s[0])
    for now_s[0] in np.arange(0, 60, 0.5):
        messages.wait()
    hints = [f"edge-sr: no scan in {silent_s} s: is it powered?" for silent_s in (5, 10, 20, 40)]
    assert stream.getvalue().splitlines() == hints
    messages.write(make_results(1)[0], RUN)
    now_s[0] = 1000.0
    messages.wait()
    assert stream.getvalue().splitlines() == hints


def test_the_events_of_a_result_are_lines():
    stream = io.StringIO()
    messages = MessageSink(stream)
    for number, texts in enumerate([[], ["zeroing refused", "zeroed; again"]]):
        events = tuple(Event(number, "refused", None, text) for text in texts)
        messages.write(Result(make_scan(number), "device", "tiny", "idle", events=events), {})
    assert stream.getvalue() == "edge-sr: zeroing refused\nedge-sr: zeroed; again\n"


class TestNpz:
    def record(self, path, results, **settings):
        sink = NpzSink(path, *SHAPES, **settings)
        for result in results:
            sink.write(result, {})
        sink.close()

    def test_what_replay_reads_back_is_the_same_scans(self, tmp_path):
        path = tmp_path / "out.npz"
        results = make_results()
        self.record(path, results)
        tracks = load_recording(path).tracks
        assert [track.sensor for track in tracks] == ["4", "6"]
        for track in tracks:
            mine = [result.scan for result in results if result.scan.sensor == track.sensor]
            np.testing.assert_array_equal(track.counts, np.stack([scan.counts for scan in mine]))
            assert track.time_ns is not None and track.time_ns.tolist() == [scan.time_ns for scan in mine]
        assert not parts_dir(path).exists() and list(tmp_path.iterdir()) == [path]

    def test_every_array_holds_its_row(self, tmp_path):
        results = make_results(counts_per_newton=5)
        self.record(tmp_path / "out.npz", results)
        data = dict(np.load(tmp_path / "out.npz"))
        assert str(data.pop("format")) == "tactile-recording" and int(data.pop("version")) == 1
        assert {len(column) for column in data.values()} == {len(results)}
        assert np.isnan(data["interval_mm"]).all() and "deviation" not in data
        for i, result in enumerate(results):
            row = {name: column[i] for name, column in data.items()}
            assert row["scan"] == result.scan.number and row["sensor"] == result.scan.sensor
            assert row["source"] == "emulated" and row["state"] == result.state and row["model"] == "fake"
            assert row["contact"] == {None: -1, False: 0, True: 1}[result.contact]
            assert row["taps_used"] == result.taps_used
            assert row["has_pattern"] == (result.pattern is not None)
            np.testing.assert_array_equal(row["pattern"], 0 if result.pattern is None else result.pattern)
            for name in ("force_counts", "run_time_us"):
                value = getattr(result, name)
                assert np.isnan(row[name]) if value is None else row[name] == np.float32(value)
            assert row["baseline"] == ("" if result.baseline is None else result.baseline.id)
            counts = np.nan if result.baseline is None else result.baseline.counts
            np.testing.assert_array_equal(row["baseline_counts"], counts)
        assert {"contact", "idle", "zeroing"} <= set(data["state"].tolist())

    def test_deviations_are_kept_where_the_model_gives_them(self, tmp_path):
        results = make_sure_results()
        self.record(tmp_path / "out.npz", results, deviations=True)
        data = np.load(tmp_path / "out.npz")
        assert data["deviation"].shape == data["pattern"].shape
        for i, result in enumerate(results):
            np.testing.assert_array_equal(data["deviation"][i], 0 if result.pattern is None else result.deviation)
            interval_mm = np.nan if result.interval_mm is None else np.float32(result.interval_mm)
            np.testing.assert_array_equal(data["interval_mm"][i], interval_mm)
        assert 0 < np.isfinite(data["interval_mm"]).sum() == data["has_pattern"].sum() < len(results)
        assert len(load_recording(tmp_path / "out.npz").tracks) == 2

    def test_nothing_is_at_the_target_before_the_end_and_an_old_one_is_left_alone(self, tmp_path):
        path = tmp_path / "out.npz"
        sink = NpzSink(path, *SHAPES)
        sink.write(make_results(1)[0], {})
        assert not path.exists()
        sink.close()
        assert len(load_recording(path).tracks[0].counts) == 1
        with pytest.raises(SinkError, match=r"out\.npz exists: give another name"):
            NpzSink(path, *SHAPES)
        path.rename(tmp_path / "first.npz")
        sink = NpzSink(path, *SHAPES)
        sink.write(make_results(1)[0], {})
        path.write_bytes(b"of another meanwhile")
        with pytest.raises(SinkError, match=r"out\.npz exists, .* move it away, then `python -m edge\.sinks\.npz"):
            sink.close()
        assert path.read_bytes() == b"of another meanwhile"
        path.unlink()
        assert npz.gather(path) == 1

    def test_without_a_scan_nothing_is_written(self, tmp_path):
        NpzSink(tmp_path / "out.npz", *SHAPES).close()
        assert list(tmp_path.iterdir()) == []

    def test_every_row_is_on_disk_as_soon_as_written_and_none_is_kept(self, tmp_path):
        sink = NpzSink(tmp_path / "out.npz", *SHAPES)
        result = make_results(3)[4]
        for count in range(1, 4):
            sink.write(result, {})
            size = (parts_dir(tmp_path / "out.npz") / npz.ROWS).stat().st_size
            assert size % count == 0 and 40 * 40 * 4 < size // count < 40 * 40 * 4 + 2000
        sink.close()

    def test_kill_9_costs_no_whole_scan(self, tmp_path):
        path = tmp_path / "out.npz"
        results = make_results()
        script = (
            "import os, sys; sys.path[:0] = ['tests/sinks', 'tests/support']; from test_sinks import *\n"
            "sink = NpzSink(Path(sys.argv[1]), *SHAPES)\n"
            "for result in make_results(): sink.write(result, {})\n"
            "os.kill(os.getpid(), 9)"
        )
        done = subprocess.run([sys.executable, "-c", script, str(path)], cwd=ROOT, timeout=60)
        assert done.returncode == -signal.SIGKILL and not path.exists()
        with (parts_dir(path) / npz.ROWS).open("ab") as rows:
            rows.write(b"\1" * 1300)  # of one more, half
        with pytest.raises(SinkError, match=r"not finished: `python -m edge.sinks.npz .*out.npz` makes the .npz"):
            NpzSink(path, *SHAPES)
        done = subprocess.run(
            [sys.executable, "-m", "edge.sinks.npz", str(path)], cwd=ROOT, capture_output=True, text=True, timeout=60
        )
        assert (done.returncode, done.stdout) == (0, f"{path}: {len(results)} scans\n")
        counts = np.stack([result.scan.counts for result in results])
        np.testing.assert_array_equal(np.load(path)["counts"], counts)
        assert len(zipfile.ZipFile(path).read("scan.npy")) == 128 + 8 * len(results), "nothing hangs on behind"
        assert not parts_dir(path).exists()

    def test_a_row_of_which_the_disk_takes_a_part_is_gone_on_with(self, tmp_path):
        """Else what is written once there is room again would lie between the rows."""
        sink = NpzSink(tmp_path / "out.npz", *SHAPES)
        rows, sizes = sink._rows, []

        class Stubborn:
            close = rows.close

            def write(self, data):
                sizes.append(len(data))
                return rows.write(data[: len(data) // 2 + 1])

        sink._rows = Stubborn()
        results = make_results(2)
        for result in results:
            sink.write(result, {})
        sink.close()
        assert len(sizes) > 2 * len(results)
        counts = np.stack([result.scan.counts for result in results])
        np.testing.assert_array_equal(np.load(tmp_path / "out.npz")["counts"], counts)

    def test_gathering_what_is_not_there_is_told(self, tmp_path, capsys):
        assert npz.main([str(tmp_path / "none.npz")]) == 1
        assert "none.npz is not there, finished or not: a recording that a crash" in capsys.readouterr().err
        with pytest.raises(SystemExit):
            npz.main([])
        NpzSink(tmp_path / "empty.npz", *SHAPES)
        with pytest.raises(SinkError, match=r"^\S+/empty.npz.parts holds no scan: delete it$"):
            gather(tmp_path / "empty.npz")
        (parts_dir(tmp_path / "empty.npz") / npz.LAYOUT).write_text("{")
        with pytest.raises(SinkError, match=r"layout.json cannot be read"):
            gather(tmp_path / "empty.npz")

    def test_a_whole_file_needs_no_gathering_and_is_not_to_be_moved_away(self, tmp_path, capsys):
        path = tmp_path / "out.npz"
        sink = NpzSink(path, *SHAPES)
        sink.write(make_results(1)[0], {})
        sink.close()
        content = path.read_bytes()
        assert npz.main([str(path)]) == 1
        words = capsys.readouterr().err
        assert words.startswith(f"{path} is finished, and can be read as it is: ") and "move" not in words
        assert path.read_bytes() == content

    def test_what_cannot_be_recorded_into_is_told_at_the_start(self, tmp_path):
        with pytest.raises(SinkError, match="is a directory"):
            NpzSink(tmp_path, *SHAPES)
        with pytest.raises(SinkError, match=r"No such file"):
            NpzSink(tmp_path / "none" / "out.npz", *SHAPES)

    def test_wrong_rows_are_refused_rather_than_shifting_the_array(self, tmp_path):
        sink = NpzSink(tmp_path / "out.npz", (3, 4, 4), (20, 20))
        with pytest.raises(SinkError, match=r"pattern has shape \(40, 40\), expected \(20, 20\)"):
            sink.write(make_results(3)[4], {})
        sink = NpzSink(tmp_path / "long.npz", *SHAPES)
        runtime = Runtime(FakeModel(), source="device")
        with pytest.raises(SinkError, match="too long"):
            sink.write(runtime.push(make_scan(sensor="x" * 65)), {})

    @pytest.mark.parametrize("when", ["writing", "gathering"])
    def test_a_full_disk_keeps_the_parts_and_says_so(self, tmp_path, when):
        """The limit on a file's size stands for the disk's end."""
        path = tmp_path / "out.npz"
        sink = NpzSink(path, *SHAPES)
        result = make_results(3)[4]
        limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        try:
            if when == "writing":
                sink.write(result, {})
                row_bytes = (parts_dir(path) / npz.ROWS).stat().st_size
                resource.setrlimit(resource.RLIMIT_FSIZE, (20 * row_bytes + 100, limits[1]))
            with pytest.raises(SinkError, match=r"File too large.*python -m edge.sinks.npz"):
                for _ in range(50):
                    sink.write(result, {})
                resource.setrlimit(resource.RLIMIT_FSIZE, (2000, limits[1]))
                sink.close()
            sink.close() if when == "writing" else None
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert list(tmp_path.iterdir()) == [parts_dir(path)]
        assert gather(path) == (20 if when == "writing" else 50)
        assert zipfile.ZipFile(path).testzip() is None


class Terminal(io.StringIO):
    def isatty(self):
        return True


class TestStatus:
    def test_a_finger_that_is_silent_does_not_stand_there_as_if_it_were_not(self):
        now_s = [0.0]
        sink = StatusSink(Terminal(), clock_s=lambda: now_s[0], columns=lambda: 200)
        for result in make_results(1):
            sink.write(result, {})
        now_s[0] = 2.0
        sink.write(make_results(2)[2], {})
        assert "6 no scan for 2 s" in sink.line() and "4 no scan" not in sink.line()

    def make(self, columns=200, **settings):
        self.now_s = 0.0
        self.stream = Terminal()
        return StatusSink(self.stream, clock_s=lambda: self.now_s, columns=lambda: columns, **settings)

    def shown(self):
        return [line.removesuffix("\x1b[K") for line in self.stream.getvalue().split("\r")[1:]]

    def test_the_line_says_source_state_taps_force_area_time_rate_and_losses(self):
        sink = self.make()
        ticks = iter(range(0, 10**9, 250_000))
        for result in make_results(4, clock_ns=lambda: next(ticks)):
            sink.write(result, RUN)
        assert sink.line() == (
            "EMULATED | 4 contact tap 1 3002 counts 22 mm2 250 us 100 Hz"
            " | 6 no stored baseline for sensor 6, only for 4: zeroing | 2 dropped | 1 overrun | 3 torn"
            f" | baseline {BASELINE.id} 12 s old"
        )

    def test_newtons_where_calibrated_and_no_source_for_a_device(self):
        sink = self.make()
        runtime = Runtime(FakeModel(), source="device", baselines={"4": BASELINE}, counts_per_newton=1000)
        sink.write(runtime.push(make_scan(0, press_counts=3000)), {})
        assert sink.line().startswith("4 contact tap 1 3.00 N 22 mm2 ")

    def test_a_model_that_gives_deviations_says_how_far_off_it_may_be(self):
        sink = self.make()
        ticks = iter(range(0, 10**9, 250_000))
        for result in make_sure_results(4, clock_ns=lambda: next(ticks)):
            sink.write(result, {})
        assert " counts 22 mm2 +-0.064 mm 250 us 100 Hz" in sink.line() and sink.line().isascii()

    def test_dead_taxels_are_named(self):
        sink = self.make()
        result = Runtime(FakeModel(), source="device", baselines={"4": BASELINE}).push(make_scan())
        sink.write(replace(result, dead={3: "stuck", 7: "silent"}, filled="neighbours"), RUN)
        assert "4 idle without taxel 3,7 " in sink.line() + " "

    def test_a_note_while_zeroing_is_shown(self):
        sink = self.make()
        runtime = Runtime(FakeModel(), source="replay", baselines={"9": BASELINE})
        sink.write(runtime.push(make_scan()), {})
        assert sink.line() == "REPLAY | 4 no stored baseline for sensor 4, only for 9: zeroing"

    def test_it_is_rewritten_at_most_ten_times_a_second(self):
        sink = self.make()
        result = make_results(1)[0]
        for _ in range(101):
            sink.write(result, {})
            self.now_s += 1 / 64
        assert len(self.shown()) == 1 + 100 // 7  # every 7/64 s

    def test_the_rate_follows_the_sensor(self):
        sink = self.make()
        runtime = Runtime(FakeModel(), source="device", baselines={"4": BASELINE})
        time_ns = 0
        for period_ns, rate in ((10_000_000, "100 Hz"), (20_000_000, "50 Hz"), (0, "50 Hz"), (-5_000_000, "50 Hz")):
            for _ in range(200):
                time_ns += period_ns
                sink.write(runtime.push(make_scan(time_ns=time_ns)), {})
            assert f" {rate} |" in sink.line()
        sink.write(runtime.push(make_scan(time_ns=time_ns + 10_000_000)), {})
        sink.write(runtime.push(make_scan(time_ns=time_ns + 20_000_000)), {})
        assert " 53 Hz |" in sink.line(), "a single scan moves it little"

    def test_silence_is_shown(self):
        sink = self.make()
        sink.wait()
        assert self.shown()[-1] == "no scan for 0 s"
        sink.write(make_results(1)[0], {})
        self.now_s = 0.99
        sink.wait()
        assert "no scan" not in self.shown()[-1]
        self.now_s = 3.2
        sink.wait()
        assert self.shown()[-1].startswith("EMULATED | no scan for 3 s | 4 idle")

    @pytest.mark.parametrize("columns", [1, 2, 10, 40, 80])
    def test_it_never_wraps(self, columns):
        sink = self.make(columns)
        for result in make_results(8):
            sink.write(result, RUN)
            self.now_s += 1
        assert max(len(line) for line in self.shown()) == columns - 1

    def test_the_last_line_stands_at_the_end(self):
        sink = self.make()
        first, last = make_results(1)
        sink.write(first, {})
        sink.write(last, {})
        sink.close()
        assert "| 6 no stored" in self.stream.getvalue().rsplit("\r", 1)[1]
        assert self.stream.getvalue().endswith("\n")

    def test_a_window_that_was_closed_ends_nothing(self):
        self.now_s = 0.0
        leader, follower = os.openpty()
        stream = os.fdopen(follower, "w")
        sink = StatusSink(stream, clock_s=lambda: self.now_s, columns=lambda: 80)
        sink.write(make_results(1)[0], {})
        os.close(leader)
        self.now_s = 1.0
        sink.write(make_results(1)[0], {})
        sink.close()
        with contextlib.suppress(OSError):  # it still has what nobody took
            stream.close()

    def test_nothing_where_there_is_no_terminal(self):
        stream = io.StringIO()
        sink = StatusSink(stream)
        sink.write(make_results(1)[0], {})
        sink.wait()
        sink.close()
        assert stream.getvalue() == ""


def test_forms_open_their_sinks(tmp_path):
    contract = make_contract()
    for text, kind in (
        ("status", StatusSink),
        (f"jsonl:{tmp_path}/a", JsonLinesSink),
        (f"npz:{tmp_path}/a.npz", NpzSink),
    ):
        sink = open_sink(text, contract)
        assert type(sink) is kind
        sink.close()


def test_the_npz_sink_gets_the_shapes_of_the_contract(tmp_path):
    sink = open_sink(f"npz:{tmp_path}/a.npz", make_contract(scale=2))
    layout = json.loads((parts_dir(tmp_path / "a.npz") / npz.LAYOUT).read_text())
    assert layout["pattern"][1] == [8, 8] and layout["counts"][1] == [3, 4, 4] and "deviation" not in layout
    sink.close()
    sink = open_sink(f"npz:{tmp_path}/b.npz", make_contract(scale=2, interval_factor=1.6))
    layout = json.loads((parts_dir(tmp_path / "b.npz") / npz.LAYOUT).read_text())
    assert layout["deviation"] == layout["pattern"]
    sink.close()


@pytest.mark.parametrize("text", ["", "jsonl", "jsonl:", "npz:", "csv:a", "status:x", "out.jsonl", "JSONL:a"])
def test_other_forms_are_refused_listing_those_there_are(text, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UsageError) as refused:
        open_sink(text, make_contract())
    assert repr(text) in str(refused.value)
    for form in FORMS:
        assert form in str(refused.value)
    assert list(Path().iterdir()) == []


@pytest.mark.parametrize("text", ["npz:a", "npz:a.mcap", "mcap:/dev/full", "mcap:a.npz"])
def test_a_file_with_another_ending_is_refused_for_that(text):
    ending = f".{text.partition(':')[0]}"
    with pytest.raises(UsageError, match=rf"^sink '{text}' names '\S+', expected a file whose name ends in \{ending}$"):
        open_sink(text, make_contract())

"""Results over zenoh: what another process reads, in a session of its own over loopback TCP."""

import json
import os
import queue
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import replace
from urllib.parse import unquote

import numpy as np
import pytest
import zenoh_samples
from bridge_samples import write_recording
from edge_samples import ROOT, ended, fake_source, make_scan, unpack, wait_for, write_model
from test_listening import reachable
from zenoh_samples import CONTRACT, consumer, endpoint, listening, make_results

from edge.api import Event, SinkError
from edge.cli.main import main
from edge.sinks.registry import open_sink
from edge.sinks.zenoh import ZenohSink, chunks

__all__ = ["consumer", "endpoint"]

zenoh = pytest.importorskip("zenoh")


class TestMessages:
    def test_a_new_pattern_has_all_its_maps_and_writers_come_and_go(self, endpoint, consumer):
        """The rest of each result is in tests/sinks/test_every_sink.py."""
        results = make_results(40)
        sink = open_sink(f"zenoh:grip?connect={endpoint}", CONTRACT, fake_source())
        for result in results:
            sink.write(result, {})
        sink.close()
        told = [consumer.next()]
        while told[-1][0] != "went":
            told.append(consumer.next())
        with suppress(queue.Empty):  # that it goes may overtake what it sent
            while True:
                told.append(consumer.next(timeout=0.6))
        messages = [words[1:] for words in told if words[0] == "got"]
        alive = f"grip/alive/{sink.zid}"
        assert [words for words in told if words[0] != "got"] == [["came", alive], ["went", alive]]
        assert {writer for *_, writer, _ in messages} == {sink.zid}
        scan, pattern = ("grip/4/scan", "application/json"), ("grip/4/pattern", "application/octet-stream")
        expected = []
        for result in results:
            new = result.pattern is not None and result.reused_from is None
            expected += [(*scan, result), (*pattern, result)] if new else [(*scan, result)]
        assert 45 < len(expected) < 70
        for (*kind, _, data), (*wanted, result) in zip(messages, expected, strict=True):
            payload = bytes.fromhex(data)
            assert kind == wanted
            header, maps = (json.loads(payload), {}) if kind == [*scan] else unpack(payload)
            assert header["scan"] == result.scan.number
            assert maps.keys() == ({"pattern", "deviation", "traction"} if kind == [*pattern] else set())
            for name, values in maps.items():
                np.testing.assert_array_equal(values, getattr(result, name))

    def test_a_run_that_nobody_reads_says_so_as_it_goes_and_ends(self, endpoint, tmp_path, capsys):
        model = write_model(tmp_path / "tiny.onnx", CONTRACT)
        path = write_recording(tmp_path / "free.csv", np.stack([make_scan(n, noise=2).counts for n in range(150)]))
        source = ["--source", f"replay:{path}", "--rate-hz", "100", "--model", str(model)]
        with listening(endpoint):
            assert main([*source, "--sink", f"zenoh:grip?connect={endpoint}"]) == 0
        why = f"nobody subscribes to zenoh:grip?connect={endpoint}: check its reader, or the router"
        told = capsys.readouterr().err
        assert f"edge-sr: {why}\n" in told and f"\nsinks: {why}\n" in told

    def test_every_sensor_name_makes_a_key_of_its_own_and_is_told(self):
        names = ["4", "left/4", "/4", "a//b", "a/b", "a%2F%2Fb", "a*?#$b", "@left", "a b", "a%20b", "右"]
        parts = [chunks(name) for name in names]
        assert list(map(unquote, parts)) == names and len(set(parts)) == len(names)
        for part in parts:
            assert zenoh.KeyExpr("grip/**").includes(zenoh.KeyExpr(f"grip/{part}/scan")) and not set("*$#?") & set(part)


class TestWhoComesAndGoes:
    def test_a_reader_that_stands_still_holds_up_nobody(self, endpoint, consumer):
        result = make_results(2)[1]
        sink = ZenohSink(f"grip?connect={endpoint}", fake_source("device"))
        wait_for(lambda: sink.write(result, {}) or sink.trouble is None)
        consumer.process.send_signal(signal.SIGSTOP)
        for number in range(1000):  # 15 MB, more than sockets and queues hold
            sink.write(replace(result, scan=replace(result.scan, number=number)), {})
        consumer.process.send_signal(signal.SIGCONT)
        told = [consumer.next()]
        while told[-1][:2] != ["got", "grip/event"]:
            sink.tell(Event(5, "back", None, "goes on"), {})
            told.append(consumer.next())
        sink.close()
        assert ["went", f"grip/alive/{sink.zid}"] not in told, "it was cut off: had it been waited for?"
        scans = [json.loads(bytes.fromhex(words[-1]))["scan"] for words in told if words[1].endswith("/scan")]
        assert len(scans) < 1000 and sorted(scans[scans.index(0) :]) == scans[scans.index(0) :]

    def test_the_example_prints_patterns_events_and_who_goes(self, endpoint):
        command = [sys.executable, str(ROOT / "examples" / "zenoh_listen.py"), "grip/left", endpoint]
        streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        with ended(subprocess.Popen(command, **streams)) as listener:
            assert listener.stdout.readline() == "listens\n"
            sink, (free, pressed) = ZenohSink(f"grip/left?connect={endpoint}", fake_source()), make_results(2)
            wait_for(lambda: sink.write(free, {}) or sink.trouble is None)
            sink.write(pressed, {})
            sink.tell(Event(5, "lost", None, "the cable is out"), {})
            lines = {listener.stdout.readline() for _ in range(3)}
            sink.close()
            lines.add(listener.stdout.readline())
            listener.send_signal(signal.SIGINT)
            assert (listener.stderr.read(), listener.wait(60)) == ("", 0)
        alive = f"grip/left/alive/{sink.zid}"
        pattern = "4 emulated scan 1: 3000.0 counts, 3.000 mm at most\n"
        assert lines == {f"{alive} came\n", pattern, "the cable is out\n", f"{alive} went\n"}


@pytest.mark.parametrize(
    ("option", "why"),
    [
        ("config=none.json5", r"none.json5 is not a zenoh configuration: No such file"),
        ("config=bad.json5", r"bad.json5 is not a zenoh configuration: expected"),
        ("connect=smoke/1:2", r"zenoh cannot be opened: Unicast not supported for smoke protocol$"),
    ],
)
def test_what_cannot_be_opened_is_told(option, why, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bad.json5").write_text("{mode: ")
    with pytest.raises(SinkError, match=why):
        open_sink(f"zenoh:a?{option}", CONTRACT, fake_source())


@pytest.mark.parametrize(
    ("configuration", "protocol"),
    [
        (None, None),
        ("{connect: {endpoints: ['tcp/127.0.0.1:1']}}", None),
        ("{listen: {endpoints: ['tcp/0.0.0.0:0']}}", "tcp"),
        ("{scouting: {multicast: {enabled: true}}}", "udp"),
    ],
)
def test_nobody_can_reach_it_unless_a_configuration_says_so(tmp_path, configuration, protocol):
    (tmp_path / "zenoh.json5").write_text(configuration or "")
    before = reachable(os.getpid())
    sink = ZenohSink("grip" if configuration is None else f"grip?config={tmp_path}/zenoh.json5", fake_source())
    opened = {one.split()[0] for one in reachable(os.getpid()) if one not in before}
    sink.close()
    assert protocol in opened if protocol else not opened


@pytest.mark.parametrize("by_file", [False, True])
def test_nobody_is_dialled_but_whom_it_was_told_to(by_file, endpoint, tmp_path):
    """Zenoh peers report others that they are connected to."""
    (tmp_path / "zenoh.json5").write_text(json.dumps({"connect": {"endpoints": [endpoint]}}))
    with listening(endpoint) as known, listening(zenoh_samples.free_endpoint(), endpoint) as other:
        wait_for(lambda: known.info.peers_zid())
        option = f"config={tmp_path}/zenoh.json5" if by_file else f"connect={endpoint}"
        sink = ZenohSink(f"grip?{option}", fake_source())
        wait_for(lambda: sink.zid in map(str, known.info.peers_zid()))
        time.sleep(0.3)  # for a call to another, were there one
        assert sink.zid not in map(str, other.info.peers_zid())
        sink.close()

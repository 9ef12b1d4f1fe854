"""MCAP recordings of `edge-sr record`: whole whatever ended it, and replayed offline."""

import json
import os
import re
import resource
import subprocess
import time
from contextlib import suppress
from functools import partial

import numpy as np
import pytest
from bridge_samples import write_recording
from cli_samples import start
from edge_samples import BASELINE, ROOT, fake_source, make_scan, write_model
from mcap.exceptions import EndOfFile
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader
from mcap_samples import SURE, make_results, messages_of, odd_scans, record_into

from edge.cli import main as cli
from edge.doctor.examine import prepare
from edge.sinks.registry import open_sink
from edge.sinks.ros2 import messages as ros_messages
from edge.sinks.ros2.map_messages import in_si, recorded_map
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.recording.scan_messages import decode_scan
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.sensor_file.model import SensorFile


def scans_on_disk(path):
    """Return the scans that the public package reads, front to back, from a file that has no end yet."""
    seen, own = [], set()
    with suppress(FileNotFoundError, EndOfFile), path.open("rb") as file:
        for record in StreamReader(file).records:
            if isinstance(record, Channel) and record.topic.endswith("/scan"):
                own.add(record.id)
            if isinstance(record, Message) and record.channel_id in own:
                seen.append(decode_scan(record.data))
    return seen


def source_of(folder, rate_hz):
    return ["--model", f"{folder}/tiny.onnx", "--source", f"replay:{folder}/finger.csv", "--rate-hz", str(rate_hz)]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A tiny model and a pressed pad: recorded by `edge-sr record`, without a baseline of its own."""
    folder = tmp_path_factory.mktemp("made")
    write_model(folder / "tiny.onnx", SURE)
    counts = np.stack([make_scan(number, noise=3).counts for number in range(160)])
    for first in (110, 135):
        counts[first : first + 20, 2, 1, 1] += 3000
    write_recording(folder / "finger.csv", counts)
    for slower in range(1, 11):  # a machine that is busy, and writes its first second, may drop all of a contact
        assert cli.main(["record", f"{folder}/press.mcap", *source_of(folder, 100 / slower)]) == 0
        if any(own for own, _ in patterns(folder / "press.mcap").values()):
            return folder
        (folder / "press.mcap").unlink()
    raise AssertionError("no scan of the contact got its pattern in any of ten recordings")


def replayed(made, name, *options, file="press.mcap"):
    arguments = ["replay", made / file, "--model", made / "tiny.onnx", "--sink", f"jsonl:{name}", *options]
    assert cli.main([str(one) for one in arguments]) == 0
    return [json.loads(line) for line in name.read_text().splitlines()]


def patterns(path):
    """Each scan's pattern by its number, and whether it was made for that scan."""
    by_topic = messages_of(path)
    said = {at: ros_messages.RESULT.decode(data) for at, data in by_topic["/finger/result"]}
    made_for = {at: json.loads(one["record"])["reused_from"] is None for at, one in said.items()}
    return {said[at]["scan"]: (made_for[at], recorded_map(data).tobytes()) for at, data in by_topic["/finger/pattern"]}


class TestOffline:
    def test_the_same_again_is_the_same(self, made, tmp_path):
        first = replayed(made, tmp_path / "a.jsonl", "--sink", f"mcap:{tmp_path}/a.mcap")
        second = replayed(made, tmp_path / "b.jsonl", "--sink", f"mcap:{tmp_path}/b.mcap")
        assert len(first) == 160 and {one["state"] for one in first} == {"zeroing", "idle", "contact"}
        for one in (*first, *second):
            assert one["latency_us"] is None and (one["pattern"] is None) == (one["state"] != "contact")
            del one["run_time_us"]
        assert first == second
        recorded = messages_of(made / "press.mcap")
        again, other = messages_of(tmp_path / "a.mcap"), messages_of(tmp_path / "b.mcap")
        for topic in ("scan", "baseline", "pattern", "deviation"):
            assert again[f"/finger/{topic}"] == other[f"/finger/{topic}"] != []
        assert again["/finger/scan"] == recorded["/finger/scan"], "and at their times on the wall"
        replayed(made, tmp_path / "c.jsonl", "--sink", f"mcap:{tmp_path}/c.mcap", "--every-scan")
        offline = patterns(tmp_path / "c.mcap")
        made_then = {scan: pattern for scan, (own, pattern) in patterns(made / "press.mcap").items() if own}
        assert made_then and made_then.items() <= {scan: one for scan, (_, one) in offline.items()}.items()

    def test_it_begins_with_the_baseline_of_its_first_scan(self, made, tmp_path):
        """The recording begins in contact: zeroed again, the press would be gone."""
        path = tmp_path / "press.mcap"
        scans = [make_scan(number, press_counts=3000, noise=1) for number in range(130)]
        sink = open_sink(f"mcap:{path}", SURE, fake_source(unix_offset_ns=1_012_400_000_000))
        for result in make_results(scans, unix_time_s=lambda: 1012.4):
            sink.write(result, {})
        sink.close()
        for options in ((), ("--paced", "--rate-hz", 2000)):
            got = replayed(made, tmp_path / "a.jsonl", *options, file=path)
            assert {one["baseline"] for one in got} == {BASELINE.id}
            # Longer than that nobody believes a taxel that is pressed alone.
            assert {one["state"] for one in got[:18]} <= {"contact", "dropped"}
            # Played at its pace it is of now, and so is its age.
            age_s = got[0]["baseline_age_s"]
            assert age_s > 1e9 if options else abs(age_s - 12.4) < 60


class TestRecord:
    def test_it_says_what_it_recorded_and_what_of_that_is_emulated(self, made, tmp_path, capsys):
        assert cli.main(["record", f"{tmp_path}/run.1", *source_of(made, 2000)]) == 0
        assert len(load_recording(tmp_path / "run.1.mcap").tracks[0].counts) == 160
        said = capsys.readouterr().err.splitlines()[-1]
        assert f"recorded {tmp_path}/run.1.mcap: 160 scans, 0.1 s, " in said and "EMULATED" not in said
        scans = [make_scan(number, noise=3) for number in range(5)]
        path = record_into(tmp_path / "first.mcap", make_results(scans, source="emulated"))
        model = ["--model", f"{made}/tiny.onnx"]
        assert cli.main(["record", f"{tmp_path}/again.mcap", *model, "--source", f"replay:{path}"]) == 0
        said = capsys.readouterr().err.splitlines()
        assert any(line.startswith("REPLAY ") and "(EMULATED): 5 scans" in line for line in said)
        assert said[-1].endswith(", EMULATED") and load_recording(tmp_path / "again.mcap").origin == "emulated"

    @pytest.mark.parametrize(
        ("name", "code", "words"),
        [
            ("taken", 5, "cannot record into taken: it is a directory"),
            ("x.csv", 2, ".csv cannot be recorded: edge-sr record x.mcap; afterwards edge-sr convert x.mcap x.csv"),
            ("old.mcap", 5, "exists: give another name"),
            ("none/x", 5, "No such file or directory"),
        ],
    )
    def test_where_nothing_can_be_recorded_it_says_so(self, made, tmp_path, monkeypatch, capsys, name, code, words):
        monkeypatch.chdir(tmp_path)
        (tmp_path / "taken").mkdir()
        (tmp_path / "old.mcap").write_text("old")
        assert cli.main(["record", name, *source_of(made, 2000)]) == code
        assert words in capsys.readouterr().err.splitlines()[-1]
        assert (tmp_path / "old.mcap").read_text() == "old" and len(list(tmp_path.iterdir())) == 2

    def test_a_killed_recorder_leaves_all_that_was_on_the_disk(self, made, tmp_path):
        """The amount depends on the machine; docs/recordings.md gives a measured one."""
        path = tmp_path / "killed.mcap"
        process = start("record", path, *source_of(made, 20), stderr=subprocess.DEVNULL)
        while len(written := scans_on_disk(path)) < 12:
            assert process.poll() is None
            time.sleep(0.02)
        process.kill()
        process.wait()
        seen = scans_on_disk(path)
        assert [scan.number for scan in seen] == list(range(len(seen))) and len(seen) >= len(written)
        recording = load_recording(path)
        assert (recording.tracks[0].counts == np.stack([scan.counts for scan in seen])).all()
        assert f"{path} breaks off (after byte " in recording.notes[0]

    @pytest.mark.parametrize("most_bytes", [40_000, 4000])
    def test_of_a_full_disk_no_more_scans_are_claimed_than_are_sure(self, made, tmp_path, most_bytes):
        """Without room for one scan no file is left."""
        path = tmp_path / "full.mcap"
        disk = partial(resource.setrlimit, resource.RLIMIT_FSIZE, (most_bytes, most_bytes))
        environment = os.environ | {"PYTHONDONTWRITEBYTECODE": "1"}
        process = start("record", path, *source_of(made, 60), preexec_fn=disk, env=environment)
        said, some = process.communicate()[1], most_bytes == 40_000
        assert process.returncode == 5 and f"recording into {path} stopped: File too large; " in said.splitlines()[-1]
        assert (path.exists(), f"recorded {path}: at most " in said, "can be played" in said) == (some, some, some)


def test_what_the_page_says_of_reading_it_works(tmp_path, monkeypatch, capsys):
    (script,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "recordings.md").read_text(), re.DOTALL)
    results = make_results(odd_scans())
    record_into(tmp_path / "press.mcap", results)
    monkeypatch.chdir(tmp_path)
    exec(compile(script, "recordings.md", "exec"), {})
    shown = [one.pattern for one in results if one.scan.sensor == "4" and one.pattern is not None]
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == len(shown) > 0 and lines[0].endswith(f"(40, 40) {in_si('pattern', shown[0]).max()!s}")


def test_the_doctor_goes_by_how_the_recorded_sensors_sat(tmp_path):
    sat = Mounting(signs=(1, 1, -1))
    path = record_into(tmp_path / "a.mcap", make_results(odd_scans()), mountings={"4": sat})
    _, known, _ = prepare([f"replay:{path}"], SensorFile(), {}, None)
    assert known.mountings["4"] == sat

"""Refusals of `edge-sr` as a user meets them: one line, an exit code, and nothing written."""

import resource
import subprocess

import numpy as np
import pytest
from cli_samples import EDGE_SR, assert_refused, base_options, files, records, run, write_recording
from edge_samples import BASELINE, ROOT, make_contract, write_model

from edge.cli import main as cli
from edge.inference import bundled as bundle
from firmware_bridge.links import registry as source
from firmware_bridge.links.serial_ports import Port
from firmware_bridge.sensor_file.model import SensorEntry, SensorFile
from firmware_bridge.sensor_file.toml_writer import save_sensor_file
from firmware_bridge.zeroing.baseline import load_baselines

__all__ = ["files"]


@pytest.fixture
def there(files, tmp_path):
    """Folder with what the refused commands name."""
    (tmp_path / "text.onnx").write_text("text")
    write_model(tmp_path / "other.onnx", make_contract(pitch_mm=5.0))
    (tmp_path / "kept.npz").write_text("old")
    (tmp_path / "kept.jsonl").write_text("old")
    (tmp_path / "bad.toml").write_text("format = 1")
    save_sensor_file(tmp_path / "s.toml", SensorFile("XR1944", sensors={"4": SensorEntry()}))
    write_recording(tmp_path / "moving.npz", range(0, 2000, 10))
    return tmp_path


KNOWN = "--model {files}/tiny.onnx --baseline {files}/zero.json"
REST = "--source replay:{files}/rest.npz"
MAP = "map --source replay:none.npz --out"
ZERO = "baseline --rate-hz 1000 --out {tmp}/zero.json --source replay:"


@pytest.mark.parametrize(
    ("code", "typed", "words"),
    [
        (2, "--rate-hz 0", ["--rate-hz: '0' is not a positive number"]),
        (2, "--rate-hz 1e-300", ["--rate-hz: '1e-300' is not a positive number, 1e-09 to 1e+09"]),
        (2, "--counts-per-newton 1e8", ["--counts-per-newton: '1e8' is not a positive number, 0.001 to 1e+06"]),
        (2, "--duration-s nan", ["--duration-s: 'nan' is not a positive number"]),
        (2, "--mode x", ["unrecognized arguments: --mode"]),
        (2, "demo --source gs_usb", ["unrecognized arguments: --source gs_usb"]),
        (2, "model", ["no command 'model': did you mean models?"]),
        (2, "press", ["no command 'press': commands are demo, record, replay"]),
        (2, "models x", ["unrecognized arguments: x", "edge-sr models --help"]),
        (2, "baseline", ["--out"]),
        (2, "baseline --out x --scans 29", ["'29' is not a whole number from 30"]),
        (2, "baseline --out x --source demo --scans 99", ["scans is 99", "from 100"]),
        (2, "baseline --out x --skip -1", ["--skip"]),
        (2, "replay --view a.mcap", ["'a.mcap' is not a port", "write FILE or command before it"]),
        (2, "--view 65536", ["'65536' is not a port: expected 0 to 65535"]),
        (2, "--source serial:x", ["'serial:x'", "slcan:/dev/ttyUSB0", "replay:FILE", "demo"]),
        (2, "--source replay:none\nsuch.npz", ["none such.npz"]),
        (2, "--source replay:none.npz", ["none.npz", "No such file"]),
        (2, "--source demo --baseline none.json", ["none.json", "No such file"]),
        (2, "--poses mqtt:x", ["no source of poses 'mqtt:x'"]),
        (2, "--source demo --sensor {tmp}/bad.toml", ["'format': 1, expected 'tactile-sensor'"]),
        (2, "--sensor {tmp}/s.toml --id-map A", ["is of a XR1944"]),
        (2, "baseline --out x --sensor {tmp}/s.toml --id-map A", ["is of a XR1944"]),
        (2, "doctor --sensor {tmp}/s.toml --id-map A", ["is of a XR1944"]),
        (5, f"{MAP} {{tmp}}/kept.npz", ["exists: give another name"]),
        (2, f"{MAP} {{tmp}}/m.mcap", ["ends in .npz"]),
        (2, f"{MAP} {{tmp}}/m.npz --png {{tmp}}/m.jpg", ["ends in .png"]),
        (2, f"{MAP} {{tmp}}/m.npz --size-mm 9000", ["pixels along a side"]),
        (2, f"{MAP} {{tmp}}/m.npz --centre-mm 0 nan", ["finite numbers"]),
        (2, f"{MAP} {{tmp}}/m.npz", ["none.npz"]),
        (3, f"{KNOWN} --source slcan:/dev/none --sink jsonl:{{tmp}}/kept.jsonl", ["/dev/none", "no such port"]),
        (3, f"{KNOWN} --source slcan:/dev/null", ["/dev/null"]),
        (3, f"{KNOWN} --source slcan:serial=NOSUCH", ["NOSUCH"]),
        (3, f"{ZERO}{{tmp}}/moving.npz", ["nowhere free and still for 30 scans", "taxel (1, 1) z", "moved by"]),
        (3, f"{ZERO}{{files}}/taps.npz --skip 1", ["ended before 100 complete scans"]),
        (4, f"{REST} --model none", ["no model 'none'", "bundled: "]),
        (4, f"{REST} --model {{tmp}}/text.onnx", ["text.onnx"]),
        (4, f"{REST} --model {{tmp}}/other.onnx", ["'pitch_mm' is 5.0", "4.7"]),
        (5, f"{KNOWN} {REST} --sink jsonl:{{tmp}}/none/x", ["none/x", "No such file"]),
    ],
)
def test_a_refusal_is_one_line_with_its_code_and_all_files_stay(code, typed, words, files, there):
    before = {path.name: path.read_bytes() for path in there.iterdir()}
    assert_refused(run(*typed.format(files=files, tmp=there).split(" ")), code, *words)
    assert {path.name: path.read_bytes() for path in there.iterdir()} == before


@pytest.mark.parametrize("command", [[], ["demo"], ["record", "new"], ["replay", "none.npz"]])
@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (["--contact-on-counts", "10"], ["on 10", "off 750"]),
        (["--sink", "csv:x"], ["'csv:x'", "jsonl:FILE", "mcap:FILE"]),
        (["--sink", "npz:x.npz"], ["record by --sink mcap:x.mcap, then edge-sr convert x.mcap x.npz"]),
        (["--sink", "jsonl:-", "--fields", "force_n,patern"], ["no field 'patern'", "did you mean pattern?"]),
        (["--sink", "jsonl:-", "--fields", "x"], ["no field 'x'", "expected time_ns, sensor, "]),
        (["--fields", "force_n"], ["--fields requires a sink of JSON records"]),
        (["--sink", "mcap:/dev/full"], ["'mcap:/dev/full'", "a file whose name ends in .mcap"]),
        (["--sink", "jsonl:-", "--sink", "jsonl:-"], ["'jsonl:-' is there 2 times", "leave one"]),
        (["--sink", "ros2:4fingers"], ["'4fingers'", "no digit first"]),
        (["--sink", "zenoh:a//b"], ["'a//b'", "words with '/' between"]),
    ],
)
def test_thresholds_and_sinks_that_cannot_be_are_2_before_anything_is_opened(command, wrong, words):
    assert_refused(run(*command, "--model", "none", *wrong), 2, *words)


@pytest.mark.parametrize("ports", [[], ["/dev/ttyUSB0", "/dev/ttyUSB1"]])
def test_without_source_none_or_several_adapters_are_3_and_nothing_is_emulated(monkeypatch, capsys, tmp_path, ports):
    monkeypatch.setattr(bundle, "BUNDLE_DIR", tmp_path)
    seen = [Port(path, (0x0403, 0x6015), f"S{path[-1]}", "adapter") for path in ports]
    monkeypatch.setattr(source, "serial_ports", lambda: [*seen, Port("/dev/ttyS9", None, None, "n/a")])
    assert cli.main(["--sink", "jsonl:-"]) == 3
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1
    for word in ("--source demo", "/dev/ttyS9", *ports):
        assert word in err


def test_a_demo_that_is_not_installed_is_2(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(bundle, "BUNDLE_DIR", tmp_path)
    assert cli.main(["--source", "demo"]) == 2
    assert "demo.npz is missing" in capsys.readouterr().err


@pytest.mark.parametrize("to", ["file", "stdout"])
@pytest.mark.parametrize("limit", [100, 20_011])
def test_a_disk_that_fills_leaves_whole_records(files, tmp_path, to, limit):
    path = tmp_path / "a.jsonl"
    replay = ["replay", files / "taps.npz", "--model", files / "tiny.onnx", "--baseline", files / "zero.json"]
    with path.open("ab") as out:
        done = subprocess.run(
            [*EDGE_SR, *map(str, replay), "--sink", f"jsonl:{path if to == 'file' else '-'}"],
            stdout=out,
            stderr=subprocess.PIPE,
            text=True,
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
            cwd=ROOT,
        )
    assert done.returncode == 5 and "File too large" in done.stderr
    text = path.read_text()
    assert text.endswith("\n") == (limit > 10_000) and len(records(text)) >= 5 * (limit > 10_000)


def test_a_full_disk_is_5_after_the_summary(files):
    done = run(*base_options(files), "--source", f"replay:{files}/rest.npz", "--sink", "jsonl:/dev/full")
    lines = done.stderr.splitlines()
    assert done.returncode == 5 and lines[1].startswith("REPLAY")
    assert lines[-1] == "edge-sr: cannot write records to /dev/full: No space left on device"


def test_a_baseline_is_taken_kept_and_used(files, tmp_path):
    zero = tmp_path / "zero.json"
    done = run("baseline", "--source", f"replay:{files}/rest.npz", "--rate-hz", "1000", "--skip", "5", "--out", zero)
    assert done.returncode == 0 and done.stderr == ""
    baseline = load_baselines(zero)["4"]
    assert done.stdout == f"sensor 4: baseline {baseline.id} of 100 scans (REPLAY) -> {zero}\n"
    assert np.abs(baseline.counts - BASELINE.counts).max() <= 2
    done = run(
        "--model", files / "tiny.onnx", "--source", f"replay:{files}/taps.npz",
        "--baseline", zero, "--sink", "jsonl:-",
    )  # fmt: skip
    assert {record["baseline"] for record in records(done.stdout)} == {baseline.id}
    assert any(record["contact"] for record in records(done.stdout))


def test_of_a_recording_a_few_free_scans_are_enough(files, tmp_path):
    begins_in_contact = write_recording(tmp_path / "held.npz", [3000] * 50 + [0] * 40)
    done = run(
        "baseline", "--source", f"replay:{begins_in_contact}", "--rate-hz", "1000", "--out", tmp_path / "zero.json",
        "--skip", "50", "--scans", "40",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert load_baselines(tmp_path / "zero.json")["4"].scans == 40
    done = run("baseline", "--source", f"replay:{begins_in_contact}", "--out", tmp_path / "free.json")
    assert "sensor 4: zeroed from its scans 5" in done.stderr
    assert done.stderr.count("where the pad is still and pressed least\n") == 1
    free, zero = (load_baselines(tmp_path / f"{name}.json")["4"] for name in ("free", "zero"))
    assert np.abs(free.counts - zero.counts).max() < 5


def test_a_recording_that_hardly_changes_may_be_of_a_held_pad(tmp_path):
    """Nothing in it shows that the pad is free, so that is not stated."""
    for begins, why in (
        ([400] * 60, " to be believed: baseline in doubt: taken from this recording"),
        ([], ": no contact: its readings never reached"),
    ):
        held = write_recording(tmp_path / "held.npz", [*begins, *[0] * 110])
        done = run("replay", held)
        assert "Its readings hardly change: is the pad free, or held? If it holds something all" in done.stderr
        assert f"sensor 4 has no pattern{why}" in done.stderr

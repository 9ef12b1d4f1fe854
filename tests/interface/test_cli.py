"""`edge-sr` as a user runs it: help, recordings, models, baselines, and refusals."""

from pathlib import Path

import numpy as np
import pytest
from bridge_samples import write_recording as write_counts
from cli_samples import assert_refused, base_options, files, records, run, start, write_recording
from edge_samples import make_contract, write_model

from edge import __version__
from edge.cli import listings
from edge.cli import main as cli
from firmware_bridge.links.serial_ports import Port
from firmware_bridge.sensor_file.model import SensorEntry, SensorFile
from firmware_bridge.sensor_file.toml_writer import save_sensor_file
from firmware_bridge.zeroing.baseline import load_baselines

__all__ = ["files"]


def test_a_sensor_gets_the_model_of_one_tap_unless_asked_and_the_demo_that_of_poses(tmp_path):
    recording = write_counts(tmp_path / "rest.csv", np.full((3, 3, 4, 4), 30_000))
    for name, model in ((f"replay:{recording}", "stsr-int8"), ("demo", "mtsr-int8")):
        done = run("--source", name, "--rate-hz", "100", "--duration-s", "0.5", "--sink", "jsonl:-")
        assert {record["model"] for record in records(done.stdout)} == {model}


class TestHelp:
    def test_help_fits_the_terminal_and_80_columns(self, capsys, monkeypatch):
        for columns, most in (("1", 40), ("40", 40), ("80", 80), ("200", 80)):
            monkeypatch.setenv("COLUMNS", columns)
            for command in (None, *cli.COMMANDS):
                with pytest.raises(SystemExit, match="0"):
                    cli.main([*([command] if command else []), "--help"])
                out, errors = capsys.readouterr()
                assert errors == "" and max(map(len, out.splitlines())) <= most, command

    def test_the_version(self):
        done = run("doctor", "--version")
        assert (done.returncode, done.stdout, done.stderr) == (0, f"edge-sr {__version__}\n", "")


class TestModels:
    def test_models_are_listed_from_their_contracts(self, bundle, capsys):
        write_model(bundle / "mtsr4.onnx")
        sure = {"1": {"psnr_db": 30.1, "coverage_90": 0.9034}}
        write_model(bundle / "stsr.onnx", make_contract(taps=1, interval_factor=1.6, test_error=sure))
        assert cli.main(["models"]) == 0
        out = capsys.readouterr().out.splitlines()
        size_mb = (bundle / "mtsr4.onnx").stat().st_size / 1e6
        assert out[1].split() == ["mtsr4", "4", f"{size_mb:.1f}", "float32", "33.2", "2.10", "-"]
        assert out[2].split() == ["stsr", "1", f"{size_mb:.1f}", "float32", "30.1", "-", "-"]
        assert max(map(len, out)) <= 80

    def test_run_times_are_measured_next_to_the_error(self, bundle, limits, capsys):
        limits(listings, RATE_HZ=2000.0)
        write_model(bundle / "mtsr4.onnx")
        assert cli.main(["models", "--measure"]) == 0
        head, row, _, note, *_ = capsys.readouterr().out.splitlines()
        assert "p50 us p99 us" in head and note == "run times of 150 patterns each at 2000 Hz, on one thread"
        *figures, p50, p99 = row.split()[4:]
        assert 0 < int(p50) <= int(p99) and figures == ["33.2", "2.10", "-"] and max(map(len, (head, row))) <= 80


def test_a_demo_that_ends_before_its_first_tap_says_so(files, capsys):
    assert cli.main(["demo", "--model", f"{files}/tiny.onnx", "--duration-s", "0.2"]) == 0
    assert capsys.readouterr().out == "\nnone of 4 taps scored: the run ended before a tap had a pattern\n"


@pytest.fixture
def there(tmp_path):
    """Folder with what the refused commands name."""
    write_model(tmp_path / "other.onnx", make_contract(pitch_mm=5.0))
    (tmp_path / "kept.npz").write_text("old")
    (tmp_path / "kept.jsonl").write_text("old")
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
        (2, "--counts-per-newton 1e8", ["--counts-per-newton: '1e8' is not a positive number, 0.001 to 1e+06"]),
        (2, "model", ["no command 'model': did you mean models?"]),
        (2, "baseline --out x --scans 29", ["'29' is not a whole number from 30"]),
        (2, "baseline --out x --source demo --scans 99", ["scans is 99", "from 100"]),
        (2, "baseline --out x --skip -1", ["--skip"]),
        (2, "--source demo --view-host 0.0.0.0", ["--view-host requires --view"]),
        (2, "--source demo --view 0 --view-token short", ["a token of 5 characters for the live page: expected at"]),
        (5, "--source demo --view 0 --view-host 192.0.2.1", ["192.0.2.1 is not an address of this machine; name one"]),
        (5, "--source demo --view 0 --view-host no.invalid", ["no.invalid is not an address of this machine; name"]),
        (2, "--source replay:none\nsuch.npz", ["none such.npz"]),
        (2, "--sensor {tmp}/s.toml --id-map A", ["is of a XR1944"]),
        (2, "doctor --sensor {tmp}/s.toml --id-map A", ["is of a XR1944"]),
        (5, f"{MAP} {{tmp}}/kept.npz", ["exists: give another name"]),
        (2, f"{MAP} {{tmp}}/m.mcap", ["ends in .npz"]),
        (2, f"{MAP} {{tmp}}/m.npz --png {{tmp}}/m.jpg", ["ends in .png"]),
        (2, f"{MAP} {{tmp}}/m.npz --size-mm 9000", ["pixels along a side"]),
        (2, f"{MAP} {{tmp}}/m.npz --centre-mm 0 nan", ["finite numbers"]),
        (3, f"{KNOWN} --source slcan:/dev/none --sink jsonl:{{tmp}}/kept.jsonl", ["/dev/none", "no such port"]),
        (3, f"{KNOWN} --source slcan:serial=NOSUCH", ["NOSUCH"]),
        (3, f"{ZERO}{{tmp}}/moving.npz", ["nowhere free and still for 30 scans", "taxel (1, 1) z", "moved by"]),
        (3, f"{ZERO}{{files}}/taps.npz --skip 1", ["ended before 100 complete scans"]),
        (4, f"{REST} --model {{tmp}}/other.onnx", ["'pitch_mm' is 5.0", "4.7"]),
    ],
)
def test_a_refusal_is_one_line_with_its_code_and_all_files_stay(code, typed, words, files, there):
    """Those that tests/golden has are not repeated."""
    before = {path.name: path.read_bytes() for path in there.iterdir()}
    assert_refused(run(*typed.format(files=files, tmp=there).split(" ")), code, *words)
    assert {path.name: path.read_bytes() for path in there.iterdir()} == before


@pytest.mark.parametrize("command", [["demo"], ["record", "new"], ["replay", "none.npz"]])
@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (["--sink", "jsonl:-", "--fields", "force_n,patern"], ["no field 'patern'", "did you mean pattern?"]),
        (["--fields", "force_n"], ["--fields requires a sink of JSON records"]),
        (["--sink", "jsonl:-", "--sink", "jsonl:-"], ["'jsonl:-' is there 2 times", "leave one"]),
        (["--sink", "zenoh:a//b"], ["'a//b'", "words with '/' between"]),
    ],
)
def test_fields_and_sinks_that_cannot_be_are_2_before_anything_is_opened(command, wrong, words):
    assert_refused(run(*command, "--model", "none", *wrong), 2, *words)


def test_without_source_several_adapters_are_3_and_nothing_is_emulated(plugged, capsys):
    ports = ["/dev/ttyUSB0", "/dev/ttyUSB1"]
    plugged += [Port(path, (0x0403, 0x6015), f"S{path[-1]}", "adapter") for path in ports]
    plugged.append(Port("/dev/ttyS9", None, None, "n/a"))
    assert cli.main(["--sink", "jsonl:-"]) == 3
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1
    for word in ("--source demo", "/dev/ttyS9", *ports):
        assert word in err


def test_a_full_disk_is_5_after_the_summary(files):
    done = run(*base_options(files), "--source", f"replay:{files}/rest.npz", "--sink", "jsonl:/dev/full")
    lines = done.stderr.splitlines()
    assert lines[0] == "edge-sr: model tiny has no checks: act on no pattern of it"
    assert done.returncode == 5 and lines[1].startswith("REPLAY")
    assert lines[-1] == "edge-sr: cannot write records to /dev/full: No space left on device"
    with Path("/dev/full").open("w") as full:
        process = start(*base_options(files), "--source", f"replay:{files}/rest.npz", "--sink", "jsonl:-", stdout=full)
        assert "cannot write records to stdout: No space left" in process.communicate()[1] and process.returncode == 5


def test_of_a_recording_a_few_free_scans_are_enough(tmp_path):
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


def test_a_baseline_of_a_recording_that_may_be_of_a_held_pad_is_in_doubt(tmp_path):
    done = run("replay", write_recording(tmp_path / "held.npz", [*[400] * 60, *[0] * 110]))
    assert "sensor 4 has no pattern to be believed: baseline in doubt: taken from this recording" in done.stderr


def test_the_example_is_a_grip_of_two_emulated_fingers():
    done = run("replay", "--example", "--sink", "jsonl:-", "--fields", "trusted,force_counts")
    assert done.returncode == 0 and "grip.npz was recorded from an emulated sensor" in done.stderr
    got = [one for one in records(done.stdout) if one["state"] != "event"]
    for sensor in "46":
        held = [one for one in got if one["sensor"] == sensor and one["state"] == "contact"]
        assert len(held) > 300 and sum(one["trusted"] is True for one in held) > 0.9 * len(held)

"""`edge-sr` as a user runs it: a process of its own, real pipes, real signals, a real pseudo-terminal."""

import json
import re
import subprocess
import sys

import numpy as np
import pytest
from cli_samples import TIMEOUT_S, base_options, files, records, run, start, write_recording
from edge_samples import BASELINE, ROOT, make_contract, write_model

from edge import __version__
from edge.cli import main as cli
from edge.cli import models_command
from edge.inference import bundled as bundle
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.zeroing.baseline import Baseline, save_baselines

__all__ = ["files"]


def test_a_sensor_gets_the_model_of_one_tap_unless_asked_and_the_demo_that_of_poses(tmp_path):
    recording = tmp_path / "rest.csv"
    header = ",".join(f"txl{taxel}_{axis}" for taxel in range(1, 17) for axis in "xyz")
    recording.write_text("\n".join([header, *[",".join(["30000.0"] * 48)] * 3, ""]))
    for name, model in ((f"replay:{recording}", "stsr-int8"), ("demo", "mtsr7-int8")):
        done = run("--source", name, "--rate-hz", "100", "--duration-s", "0.5", "--sink", "jsonl:-")
        assert {record["model"] for record in records(done.stdout)} == {model}


class TestHelp:
    def test_help_fits_the_terminal_and_80_columns(self, capsys, monkeypatch):
        for columns, most in (("40", 40), ("80", 80), ("200", 80)):
            monkeypatch.setenv("COLUMNS", columns)
            for command in (None, *cli.COMMANDS):
                with pytest.raises(SystemExit, match="0"):
                    cli.main([*([command] if command else []), "--help"])
                out, errors = capsys.readouterr()
                assert errors == "" and max(map(len, out.splitlines())) <= most, command

    def test_options_are_in_groups_and_those_of_the_demo_are_its_own(self):
        text = run("--help").stdout
        groups = "options, sensor, model, outputs, live page, contact, checks of patterns and sensor, processor"
        at = [text.index(f"\n{group}:\n") for group in groups.split(", ")]
        assert at == sorted(at)
        for name in cli.COMMANDS:
            assert re.search(f"^  {name} ", text, re.MULTILINE), name
        demo = run("demo", "--help").stdout
        assert "usage: edge-sr demo [options]" in demo and "--view" in demo and "--source" not in demo

    @pytest.mark.parametrize("command", [[], ["doctor"]])
    def test_the_version(self, command):
        done = run(*command, "--version")
        assert (done.returncode, done.stdout, done.stderr) == (0, f"edge-sr {__version__}\n", "")

    def test_help_loads_no_onnxruntime(self):
        script = (
            "import sys\nfrom edge.cli.main import main\ntry: main(['--help'])\nexcept SystemExit: pass\n"
            "sys.exit('onnxruntime' in sys.modules)"
        )
        subprocess.run(
            [sys.executable, "-c", script], cwd=ROOT, check=True, stdout=subprocess.DEVNULL, timeout=TIMEOUT_S
        )


class TestReplay:
    def test_every_scan_is_a_record_and_the_summary_goes_to_stderr(self, files):
        done = run(*base_options(files), "--source", f"replay:{files}/taps.npz", "--sink", "jsonl:-", "--rate-hz", "30")
        assert done.returncode == 0
        got = records(done.stdout)
        assert [record["scan"] for record in got] == list(range(40))
        assert {record["source"] for record in got} == {"replay"}
        assert [record["taps_used"] for record in got if record["contact"]] == [
            t for t in (1, 2, 3, 4) for _ in range(5)
        ]
        assert {record["baseline"] for record in got} == {BASELINE.id}
        assert all(record["force_n"] is None for record in got)
        lines = done.stderr.splitlines()
        assert lines[0] == "edge-sr: model tiny has no checks: act on no pattern of it"
        assert re.match(r"REPLAY replay:.*taps.npz: 40 scans, \d+ patterns \(\d+ reused\), \d+ dropped", lines[1])
        assert re.search(r"rate held: (29|30)\.\d Hz \(sensor 4\), 30 Hz asked for", done.stderr)
        assert "p50" in done.stderr and "\x1b" not in done.stderr

    def test_newtons_thresholds_and_idle_time_are_heard(self, files):
        done = run(
            *base_options(files), "--source", f"replay:{files}/taps.npz", "--sink", "jsonl:-",
            "--counts-per-newton", "1000", "--contact-on-counts", "2999000", "--rate-hz", "30",
        )  # fmt: skip
        got = records(done.stdout)
        assert not any(record["contact"] for record in got)
        assert got[7]["force_n"] == pytest.approx(3, abs=0.1)
        assert "30 Hz asked for" in done.stderr
        done = run(
            *base_options(files), "--source", f"replay:{files}/taps.npz", "--sink", "jsonl:-", "--idle-reset-s", "0.03",
        )  # fmt: skip
        assert {record["taps_used"] for record in records(done.stdout)} == {0, 1}

    def test_two_sensors_and_several_sinks_at_once(self, files, tmp_path):
        other = write_recording(tmp_path / "other.csv.npz", [0] * 10)
        data = dict(np.load(other))
        data["sensor"] = np.array(["6"] * 10)
        np.savez(other, **data)
        done = run(
            *base_options(files), "--source", f"replay:{files}/taps.npz,{other}",
            "--sink", "jsonl:-", "--sink", f"jsonl:{tmp_path}/copy.jsonl", "--sink", f"mcap:{tmp_path}/out.mcap",
        )  # fmt: skip
        assert done.returncode == 0
        assert (tmp_path / "copy.jsonl").read_text() == done.stdout
        assert [len(track.counts) for track in load_recording(tmp_path / "out.mcap").tracks] == [40, 10]

    def test_two_sources_are_named_in_the_records(self, files, tmp_path):
        sources = ["--source", f"left=replay:{files / 'taps.npz'}", "--source", f"replay:{files / 'rest.npz'}"]
        done = run("--model", files / "tiny.onnx", *sources, "--rate-hz", 500, "--sink", "jsonl:-")
        assert done.returncode == 0, done.stderr
        assert {record["sensor"] for record in records(done.stdout)} == {"left/4", "source2/4"}
        assert len(records(done.stdout)) == 160

    def test_duration_ends_it(self, files, tmp_path):
        slow = write_recording(tmp_path / "slow.npz", [0] * 3, period_ns=10**11)
        done = run(*base_options(files), "--source", f"replay:{slow}", "--duration-s", "0.3", "--sink", "jsonl:-")
        assert done.returncode == 0 and len(records(done.stdout)) == 1

    def test_a_reset_on_stdin_forgets_the_taps(self, files, tmp_path):
        taps = write_recording(tmp_path / "many.npz", ([0] * 5 + [3000] * 5) * 12)
        process = start(*base_options(files), "--source", f"replay:{taps}", "--sink", "jsonl:-", stdin=subprocess.PIPE)
        assert process.stdout is not None and process.stdin is not None
        used = []
        for line in process.stdout:
            record = json.loads(line)
            used.append(record["taps_used"])
            if used[-1] == 4:
                process.stdin.write('{"cmd": "reset"}\nnonsense\n')
                process.stdin.flush()
                break
        rest = [json.loads(line) for line in process.stdout]
        refused = [record["note"] for record in rest if record["state"] == "event" and record["event"] == "refused"]
        assert len(refused) == 1 and "a line on stdin is refused: 'nonsense', expected " in refused[0]
        used += [record["taps_used"] for record in rest if record["state"] != "event"]
        assert process.wait(TIMEOUT_S) == 0
        after = used[used.index(4) :]
        assert 1 in after and after.index(1) < 30
        assert process.stderr is not None and "refused: 1 lines or messages were not commands" in process.stderr.read()

    def test_a_sensor_of_the_baseline_that_was_not_recorded_has_no_cable(self, files, tmp_path):
        other = Baseline.of("6", BASELINE.counts, BASELINE.created_unix_s, 100, "file")
        save_baselines(tmp_path / "two.json", [BASELINE, other])
        options = ["--model", files / "tiny.onnx", "--baseline", tmp_path / "two.json"]
        done = run("replay", write_recording(tmp_path / "long.npz", [0] * 80), *options)
        assert (
            "no scan from sensor 6 for 0.5 s: the recording has none of it, though there is a baseline" in done.stderr
        )
        assert "cable" not in done.stderr


class TestModels:
    def test_models_are_listed_from_their_contracts(self, monkeypatch, capsys, tmp_path):
        monkeypatch.setattr(bundle, "BUNDLE_DIR", tmp_path)
        write_model(tmp_path / "mtsr4.onnx")
        sure = {"1": {"psnr_db": 30.1, "coverage_90": 0.9034}}
        write_model(tmp_path / "stsr.onnx", make_contract(taps=1, interval_factor=1.6, test_error=sure))
        assert cli.main(["models"]) == 0
        out = capsys.readouterr().out.splitlines()
        size_mb = (tmp_path / "mtsr4.onnx").stat().st_size / 1e6
        figures = ["psnr_db", "33.2,", "rmse_percent", "2.1"]
        assert out[1].split() == ["mtsr4", "4", "x10", f"{size_mb:.1f}", "MB", "float32", *figures]
        figures = ["psnr_db", "30.1,", "coverage_90", "0.903"]
        assert out[2].split() == ["stsr", "1", "x10", f"{size_mb:.1f}", "MB", "float32", *figures]

    def test_run_times_are_measured_next_to_the_error(self, monkeypatch, capsys, tmp_path):
        monkeypatch.setattr(bundle, "BUNDLE_DIR", tmp_path)
        monkeypatch.setattr(models_command, "RATE_HZ", 2000.0)
        write_model(tmp_path / "mtsr4.onnx")
        assert cli.main(["models", "--measure"]) == 0
        head, row, note, *_ = capsys.readouterr().out.splitlines()
        assert "p50 us p99 us" in head and note == "run times of 150 patterns each at 2000 Hz, on one thread"
        p50, p99, *figures = row.split()[6:]
        assert 0 < int(p50) <= int(p99) and figures == ["psnr_db", "33.2,", "rmse_percent", "2.1"]


class TestDemo:
    def test_a_demo_that_ends_before_its_first_tap_says_so(self, files, capsys):
        assert cli.main(["demo", "--model", f"{files}/tiny.onnx", "--duration-s", "0.2"]) == 0
        assert capsys.readouterr().out == "\nnone of 4 taps scored: the run ended before a tap had a pattern\n"

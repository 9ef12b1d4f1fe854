"""Refusals of `edge-sr` as a user meets them: one line, and an exit code."""

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
from firmware_bridge.zeroing.baseline import load_baselines

__all__ = ["files"]


class TestRefusals:
    @pytest.mark.parametrize(
        ("arguments", "words"),
        [
            (["--rate-hz", "0"], ["--rate-hz: '0' is not a positive number"]),
            (["--rate-hz", "1e-300"], ["--rate-hz: '1e-300' is not a positive number, 1e-09 to 1e+09"]),
            (["--counts-per-newton", "1e8"], ["--counts-per-newton: '1e8' is not a positive number, 0.001 to 1e+06"]),
            (["--duration-s", "nan"], ["--duration-s: 'nan' is not a positive number"]),
            (["--counts-per-newton", "x"], ["--counts-per-newton: 'x' is not"]),
            (["--mode", "x"], ["unrecognized arguments: --mode"]),
            (["model"], ["no command 'model': did you mean models?"]),
            (["doctro"], ["no command 'doctro': did you mean doctor?"]),
            (["x.mcap"], ["no command 'x.mcap': did you mean map?"]),
            (["press"], ["no command 'press': commands are demo, record, replay"]),
            (["models", "x"], ["unrecognized arguments: x", "edge-sr models --help"]),
            (["baseline"], ["--out"]),
            (["baseline", "--out", "x", "--scans", "29"], ["'29' is not a whole number from 30"]),
            (["baseline", "--out", "x", "--source", "demo", "--scans", "99"], ["scans is 99", "from 100"]),
            (["baseline", "--out", "x", "--skip", "-1"], ["--skip"]),
            (["replay", "--view", "a.mcap"], ["'a.mcap' is not a port", "write FILE or command before it"]),
            (["--view", "demo"], ["'demo' is not a port"]),
            (["--view", "65536"], ["'65536' is not a port: expected 0 to 65535"]),
            (["--source", "serial:x"], ["'serial:x'", "slcan:/dev/ttyUSB0", "replay:FILE", "demo"]),
            (["--source", "replay:none\nsuch.npz"], ["none such.npz"]),
            (["--source", "replay:none.npz"], ["none.npz", "No such file"]),
            (["--source", "demo", "--baseline", "none.json"], ["none.json", "No such file"]),
        ],
    )
    def test_wrong_usage_is_2(self, arguments, words, capsys):
        try:
            code = cli.main(arguments)
        except SystemExit as end:
            code = end.code
        assert_refused(subprocess.CompletedProcess(arguments, code, *capsys.readouterr()), 2, *words)

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
    def test_thresholds_and_sinks_that_cannot_be_are_2_before_anything_is_opened(self, command, wrong, words, capsys):
        code = cli.main([*command, "--model", "none", *wrong])
        assert_refused(subprocess.CompletedProcess(command, code, *capsys.readouterr()), 2, *words)

    def test_a_port_that_cannot_be_used_is_3(self, files):
        assert_refused(run(*base_options(files), "--source", "slcan:/dev/none"), 3, "/dev/none", "no such port")
        assert_refused(run(*base_options(files), "--source", "slcan:/dev/null"), 3, "/dev/null")
        assert_refused(run(*base_options(files), "--source", "slcan:serial=NOSUCH"), 3, "NOSUCH")

    @pytest.mark.parametrize("ports", [[], ["/dev/ttyUSB0", "/dev/ttyUSB1"]])
    def test_without_source_none_or_several_adapters_are_3_and_nothing_is_emulated(
        self, monkeypatch, capsys, tmp_path, ports
    ):
        monkeypatch.setattr(bundle, "BUNDLE_DIR", tmp_path)
        seen = [Port(path, (0x0403, 0x6015), f"S{path[-1]}", "adapter") for path in ports]
        monkeypatch.setattr(source, "serial_ports", lambda: [*seen, Port("/dev/ttyS9", None, None, "n/a")])
        assert cli.main(["--sink", "jsonl:-"]) == 3
        out, err = capsys.readouterr()
        assert out == "" and err.count("\n") == 1
        for word in ("--source demo", "/dev/ttyS9", *ports):
            assert word in err

    def test_a_demo_that_is_not_installed_is_2(self, monkeypatch, capsys, tmp_path):
        monkeypatch.setattr(bundle, "BUNDLE_DIR", tmp_path)
        assert cli.main(["--source", "demo"]) == 2
        assert "demo.npz is missing" in capsys.readouterr().err

    def test_a_model_that_cannot_be_used_is_4(self, files, tmp_path):
        replay = ["--source", f"replay:{files}/rest.npz", "--model"]
        assert_refused(run(*replay, "none"), 4, "no model 'none'", "bundled: ")
        assert_refused(run(*replay, ""), 4, "no model ''", "bundled: ")
        (tmp_path / "text.onnx").write_text("text")
        assert_refused(run(*replay, tmp_path / "text.onnx"), 4, "text.onnx")
        other = write_model(tmp_path / "other.onnx", make_contract(pitch_mm=5.0))
        assert_refused(run(*replay, other), 4, "'pitch_mm' is 5.0", "4.7")

    def test_a_sink_that_cannot_be_opened_is_5_and_old_files_stay(self, files, tmp_path):
        replay = [*base_options(files), "--source", f"replay:{files}/rest.npz"]
        assert_refused(run(*replay, "--sink", f"jsonl:{tmp_path}/none/x"), 5, "none/x", "No such file")
        kept = tmp_path / "kept.jsonl"
        kept.write_text("old")
        assert_refused(run(*base_options(files), "--source", "slcan:/dev/none", "--sink", f"jsonl:{kept}"), 3)
        assert kept.read_text() == "old"

    @pytest.mark.parametrize("to", ["file", "stdout"])
    @pytest.mark.parametrize("limit", [100, 20_011])
    def test_a_disk_that_fills_leaves_whole_records(self, files, tmp_path, to, limit):
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

    def test_a_full_disk_is_5_after_the_summary(self, files):
        done = run(*base_options(files), "--source", f"replay:{files}/rest.npz", "--sink", "jsonl:/dev/full")
        lines = done.stderr.splitlines()
        assert done.returncode == 5 and lines[1].startswith("REPLAY")
        assert lines[-1] == "edge-sr: cannot write records to /dev/full: No space left on device"


class TestBaseline:
    def test_a_baseline_is_taken_kept_and_used(self, files, tmp_path):
        zero = tmp_path / "zero.json"
        done = run(
            "baseline", "--source", f"replay:{files}/rest.npz", "--rate-hz", "1000", "--skip", "5", "--out", zero
        )
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

    def test_a_moving_pad_is_3_and_nothing_is_written(self, files, tmp_path):
        moving = write_recording(tmp_path / "moving.npz", range(0, 2000, 10))
        done = run("baseline", "--source", f"replay:{moving}", "--rate-hz", "1000", "--out", tmp_path / "zero.json")
        assert_refused(done, 3, "sensor 4: nowhere free and still for 30 scans", "taxel (1, 1) z", "moved by")
        assert not (tmp_path / "zero.json").exists()

    def test_of_a_recording_a_few_free_scans_are_enough(self, files, tmp_path):
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

    def test_a_recording_that_hardly_changes_may_be_of_a_held_pad(self, tmp_path):
        """Nothing in it shows that the pad is free, so that is not stated."""
        for begins, why in (
            ([400] * 60, " to be believed: baseline in doubt: taken from this recording"),
            ([], ": no contact: its readings never reached"),
        ):
            held = write_recording(tmp_path / "held.npz", [*begins, *[0] * 110])
            done = run("replay", held)
            assert "Its readings hardly change: is the pad free, or held? If it holds something all" in done.stderr
            assert f"sensor 4 has no pattern{why}" in done.stderr

    def test_a_recording_too_short_is_3(self, files, tmp_path):
        source = f"replay:{files}/taps.npz"
        done = run("baseline", "--source", source, "--rate-hz", "1000", "--skip", "1", "--out", tmp_path / "zero.json")
        assert_refused(done, 3, "ended before 100 complete scans")

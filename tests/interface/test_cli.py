"""`edge-sr` as a user runs it: a process of its own, real pipes, real signals, a real pseudo-terminal."""

import fcntl
import json
import os
import pty
import re
import select
import signal
import struct
import subprocess
import sys
import termios
import time
from pathlib import Path

import numpy as np
import pytest
from edge_samples import BASELINE, ROOT, make_contract, make_scan, write_model

from edge.cli import main as cli
from edge.inference import bundled as bundle
from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.links import parse as source
from firmware_bridge.links.serial_ports import Port
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.zeroing.baseline import Baseline, load_baselines, save_baselines

EDGE_SR = [sys.executable, "-m", "edge.cli.main"]
TIMEOUT_S = 60


def write_recording(path: Path, presses, period_ns=10_000_000) -> Path:
    scans = [make_scan(n, press_counts=press, noise=3) for n, press in enumerate(presses)]
    np.savez(
        path,
        format=np.array("tactile-recording"),
        version=np.array(1),
        sensor=np.array(["4"] * len(scans)),
        scan=np.arange(len(scans)),
        time_ns=np.arange(len(scans)) * period_ns,
        counts=np.stack([scan.counts for scan in scans]),
    )
    return path


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A tiny model, a stored baseline, a recording of four taps and one of a pad at rest."""
    folder = tmp_path_factory.mktemp("files")
    write_model(folder / "tiny.onnx")
    write_model(folder / "sure.onnx", make_contract(interval_factor=1.6))
    save_baselines(folder / "zero.json", [BASELINE])
    write_recording(folder / "taps.npz", ([0] * 5 + [3000] * 5) * 4)
    write_recording(folder / "rest.npz", [0] * 120)
    return folder


def base_options(files):
    return ["--model", str(files / "tiny.onnx"), "--baseline", str(files / "zero.json")]


def run(*arguments, **settings):
    settings.setdefault("stdin", subprocess.DEVNULL)
    return subprocess.run(
        [*EDGE_SR, *map(str, arguments)], cwd=ROOT, capture_output=True, text=True, timeout=TIMEOUT_S, **settings
    )


def start(*arguments, **settings):
    pipes = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | settings
    return subprocess.Popen([*EDGE_SR, *map(str, arguments)], cwd=ROOT, text=True, **pipes)


def records(text):
    return [json.loads(line) for line in text.splitlines()]


def wait_for(condition):
    end_s = time.monotonic() + TIMEOUT_S
    while not condition():
        assert time.monotonic() < end_s, "it did not come"
        time.sleep(0.05)


def assert_refused(done, code, *words):
    assert done.returncode == code, done.stderr
    assert done.stdout == ""
    assert done.stderr.startswith("edge-sr: ") and done.stderr.count("\n") == 1, done.stderr
    for word in words:
        assert word in done.stderr


def test_one_tap_is_what_a_sensor_gets_unless_asked_and_the_demo_gets_four(tmp_path):
    recording = tmp_path / "rest.csv"
    header = ",".join(f"txl{taxel}_{axis}" for taxel in range(1, 17) for axis in "xyz")
    recording.write_text("\n".join([header, *[",".join(["30000.0"] * 48)] * 3, ""]))
    for name, model in ((f"replay:{recording}", "stsr-int8"), ("demo", "mtsr4-int8")):
        done = run("--source", name, "--rate-hz", "100", "--duration-s", "0.5", "--sink", "jsonl:-")
        assert {record["model"] for record in records(done.stdout)} == {model}


class TestHelp:
    @pytest.mark.parametrize("command", [[], ["record"], ["replay"], ["models"], ["baseline"], ["bench"], ["doctor"]])
    def test_help_fits_40_columns(self, command):
        done = run(*command, "--help", env=os.environ | {"COLUMNS": "40"})
        assert done.returncode == 0 and done.stderr == ""
        assert max(map(len, done.stdout.splitlines())) <= 40

    def test_help_names_all_there_is(self):
        text = run("--help").stdout
        options = "model source sink rate-hz duration-s baseline counts-per-newton contact-on-counts contact-off-counts"
        words = [f"--{name}" for name in (*options.split(" "), "idle-reset-s", "budget-us", "recalibrate")]
        for word in (*words, "slcan:/dev/ttyUSB0", "replay:FILE", "demo", "jsonl:-", "npz:FILE", "models", "reset"):
            assert word in text

    def test_help_loads_no_onnxruntime(self):
        script = (
            "import sys\nfrom edge.cli.main import main\ntry: main(['--help'])\nexcept SystemExit: pass\n"
            "sys.exit('onnxruntime' in sys.modules)"
        )
        subprocess.run(
            [sys.executable, "-c", script], cwd=ROOT, check=True, stdout=subprocess.DEVNULL, timeout=TIMEOUT_S
        )


class TestRefusals:
    @pytest.mark.parametrize(
        ("arguments", "words"),
        [
            (["--rate-hz", "0"], ["--rate-hz: '0' is not a positive number"]),
            (["--duration-s", "nan"], ["--duration-s: 'nan' is not a positive number"]),
            (["--counts-per-newton", "x"], ["--counts-per-newton: 'x' is not"]),
            (["--budget-us", "0"], ["--budget-us: '0' is not a positive number"]),
            (["--recalibrate"], ["--recalibrate measures for --budget-us, which is not there"]),
            (["--mode", "x"], ["unrecognized arguments: --mode"]),
            (["model"], ["no command 'model': did you mean models?"]),
            (["doctro"], ["no command 'doctro': did you mean doctor?"]),
            (["x.mcap"], ["no command 'x.mcap': commands are demo, record, replay"]),
            (["models", "x"], ["unrecognized arguments: x", "edge-sr models --help"]),
            (["baseline"], ["--out"]),
            (["baseline", "--out", "x", "--scans", "29"], ["'29' is not a whole number from 30"]),
            (["baseline", "--out", "x", "--source", "demo", "--scans", "99"], ["scans is 99", "from 100"]),
            (["baseline", "--out", "x", "--skip", "-1"], ["--skip"]),
            (["replay", "--view", "a.mcap"], ["'a.mcap' is no port", "write FILE or command before it"]),
            (["--view", "demo"], ["'demo' is no port"]),
            (["--view", "65536"], ["'65536' is no port: expected 0 to 65535"]),
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
            (["--sink", "csv:x"], ["'csv:x'", "jsonl:FILE", "npz:FILE"]),
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

    def test_a_full_disk_is_5_after_the_summary(self, files):
        done = run(*base_options(files), "--source", f"replay:{files}/rest.npz", "--sink", "jsonl:/dev/full")
        lines = done.stderr.splitlines()
        assert done.returncode == 5 and lines[0].startswith("REPLAY")
        assert lines[-1] == "edge-sr: cannot write records to /dev/full: No space left on device"


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
        assert re.match(r"REPLAY replay:.*taps.npz: 40 scans, \d+ patterns \(\d+ reused\), \d+ dropped", lines[0])
        assert re.search(r"rate held: (29|30)\.\d Hz \(sensor 4\), 30 Hz asked for", done.stderr)
        assert "p50" in done.stderr and "\x1b" not in done.stderr

    def test_what_was_recorded_replays_as_the_same_scans(self, files, tmp_path):
        options = [*base_options(files), "--rate-hz", "400"]
        first = run(*options, "--source", f"replay:{files}/taps.npz", "--sink", f"npz:{tmp_path}/a.npz")
        second = run(*options, "--source", f"replay:{tmp_path}/a.npz", "--sink", f"npz:{tmp_path}/b.npz")
        assert first.returncode == second.returncode == 0
        original = load_recording(files / "taps.npz").tracks[0].counts
        for name in ("a", "b"):
            np.testing.assert_array_equal(load_recording(tmp_path / f"{name}.npz").tracks[0].counts, original)

    def test_a_model_that_says_how_sure_it_is_is_recorded(self, files, tmp_path):
        done = run(
            "--model", files / "sure.onnx", "--baseline", files / "zero.json", "--source", f"replay:{files}/taps.npz",
            "--sink", "jsonl:-", "--sink", f"npz:{tmp_path}/out.npz",
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        stored = np.load(tmp_path / "out.npz")
        for row, record in enumerate(records(done.stdout)):
            if record["pattern"] is None:
                assert record["deviation"] is record["interval_mm"] is None
                assert not stored["deviation"][row].any() and np.isnan(stored["interval_mm"][row])
            else:
                np.testing.assert_allclose(record["deviation"], stored["deviation"][row], rtol=1e-4)
                np.testing.assert_allclose(
                    stored["deviation"][row], 0.01 * (1 + abs(stored["pattern"][row])), atol=1e-6
                )
                assert record["interval_mm"] == pytest.approx(stored["interval_mm"][row], abs=1e-5)
        assert stored["has_pattern"].any()

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
            "--sink", "jsonl:-", "--sink", f"jsonl:{tmp_path}/copy.jsonl", "--sink", f"npz:{tmp_path}/out.npz",
        )  # fmt: skip
        assert done.returncode == 0
        assert (tmp_path / "copy.jsonl").read_text() == done.stdout
        assert [len(track.counts) for track in load_recording(tmp_path / "out.npz").tracks] == [40, 10]

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
        used += [json.loads(line)["taps_used"] for line in process.stdout]
        assert process.wait(TIMEOUT_S) == 0
        after = used[used.index(4) :]
        assert 1 in after and after.index(1) < 30
        assert process.stderr is not None and "refused: 1 lines or messages were no command" in process.stderr.read()

    def test_two_files_are_played_together_as_of_one_source(self, files, tmp_path):
        data = dict(np.load(files / "taps.npz"))
        np.savez(tmp_path / "other.npz", **(data | {"sensor": np.array(["6"] * 40)}))
        paths = f"{files}/taps.npz,{tmp_path}/other.npz"
        done = run("replay", paths, *base_options(files), "--sink", "jsonl:-")
        assert done.returncode == 0, done.stderr
        assert sorted(record["sensor"] for record in records(done.stdout)) == ["4"] * 40 + ["6"] * 40
        assert "sensor 6 has no pattern: not zeroed, " in done.stderr

    def test_a_sensor_of_the_baseline_that_was_not_recorded_has_no_cable(self, files, tmp_path):
        other = Baseline.of("6", BASELINE.counts, BASELINE.created_unix_s, 100, "file")
        save_baselines(tmp_path / "two.json", [BASELINE, other])
        options = ["--model", files / "tiny.onnx", "--baseline", tmp_path / "two.json"]
        done = run("replay", write_recording(tmp_path / "long.npz", [0] * 80), *options)
        assert (
            "no scan from sensor 6 for 0.5 s: the recording has none of it, though there is a baseline" in done.stderr
        )
        assert "cable" not in done.stderr


class TestEnds:
    @pytest.fixture
    def emulator(self, files):
        with Emulator([load_recording(files / "taps.npz")], loop=True) as emulator:
            yield emulator

    def follow(self, emulator, files, *more):
        """A run on the emulator that has given its first records."""
        process = start(*base_options(files), "--source", f"slcan:{emulator.port}", "--sink", "jsonl:-", *more)
        assert process.stdout is not None
        first = [process.stdout.readline() for _ in range(10)]
        return process, first

    def rest(self, process):
        """What is left to read; not by communicate(), which knows nothing of what readline() has read ahead."""
        assert process.stdout is not None and process.stderr is not None
        rest, errors = process.stdout.read(), process.stderr.read()  # of errors there are too few to fill a pipe
        process.wait(TIMEOUT_S)
        return rest, errors

    @pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
    def test_signals_end_it_cleanly_with_the_summary(self, emulator, files, tmp_path, number):
        process, first = self.follow(emulator, files, "--sink", f"npz:{tmp_path}/out.npz")
        process.send_signal(number)
        rest, errors = self.rest(process)
        assert process.returncode == 0
        got = records("".join(first) + rest)
        assert [record["scan"] for record in got] == list(range(len(got)))
        assert {record["source"] for record in got} == {"emulated"}
        assert errors.startswith(f"EMULATED slcan:{emulator.port}: {len(got)} scans") and "Traceback" not in errors
        assert len(load_recording(tmp_path / "out.npz").tracks[0].counts) == len(got)

    def test_a_closed_pipe_ends_it_cleanly_with_the_summary(self, emulator, files):
        process, _ = self.follow(emulator, files)
        assert process.stdout is not None and process.stderr is not None
        process.stdout.close()
        assert process.wait(TIMEOUT_S) == 0
        errors = process.stderr.read()
        assert errors.startswith("EMULATED ") and "Traceback" not in errors and "Exception" not in errors

    def test_the_cable_out_keeps_the_records_and_is_3(self, emulator, files, tmp_path):
        process, first = self.follow(emulator, files, "--sink", f"npz:{tmp_path}/out.npz", "--give-up-s", "0")
        emulator.hang_up()
        rest, errors = self.rest(process)
        assert process.returncode == 3
        got = records("".join(first) + rest)
        assert len(load_recording(tmp_path / "out.npz").tracks[0].counts) == len(got) >= 10
        *summary, last = errors.splitlines()
        assert summary[0].startswith(f"EMULATED slcan:{emulator.port}: {len(got)} scans")
        assert last.startswith(f"edge-sr: {emulator.port}: link lost")

    def test_the_cable_back_under_another_name_goes_on_and_records_tell_of_it(self, files, tmp_path):
        """A link named by its adapter, as udev does, that leads to a new port each time."""
        port, out = tmp_path / "by-id", tmp_path / "out.jsonl"
        process = None
        for _ in range(2):
            with Emulator([load_recording(files / "taps.npz")], loop=True) as emulator:
                port.unlink(missing_ok=True)
                port.symlink_to(emulator.port)
                if process is None:
                    process = start(*base_options(files), "--source", f"slcan:{port}", "--sink", f"jsonl:{out}")
                    wait_for(lambda: out.exists() and out.read_text().count("\n") > 10)
                else:
                    wait_for(lambda: '"back"' in out.read_text().rpartition("lost")[2])
                    wait_for(lambda: out.read_text().rpartition('"back"')[2].count("\n") > 10)
        process.send_signal(signal.SIGINT)
        _, errors = self.rest(process)
        assert process.returncode == 0
        got = records(out.read_text())
        kinds = [record.get("event") for record in got if record["state"] == "event"]
        assert kinds[:2] == ["lost", "back"]
        assert "trying again until it is back" in errors and "is back after" in errors
        back = got.index(next(record for record in got if record.get("event") == "back"))
        scans = [record for record in got if record["state"] != "event"]
        assert [record["scan"] for record in scans] == list(range(len(scans)))
        assert got[back + 1]["taps_used"] <= 1 and got[back + 1]["counters"]["outages"] == 1
        assert scans[-1]["counters"]["missed"] > 0

    def test_a_port_that_never_speaks_is_told_of_with_what_to_do_and_is_3(self, files):
        leader, follower = pty.openpty()
        name = f"slcan:{os.ttyname(follower)}"
        done = run(*base_options(files), "--source", name, "--duration-s", "6")
        os.close(leader), os.close(follower)
        assert done.returncode == 3 and done.stdout == ""
        doctor = f"edge-sr doctor --source {name} says what is wrong"
        lines = done.stderr.splitlines()
        assert re.match(rf"edge-sr: no scan in [56] s: is the sensor powered .*{doctor}$", lines[1])
        assert lines[-1].startswith(f"edge-sr: no scan came from {name}: ") and lines[-1].endswith(doctor)

    def test_models_into_a_closed_pipe_stay_quiet(self, files):
        script = "import sys; from edge.cli.main import main; from edge.inference import bundled\n"
        script += f"bundled.BUNDLE_DIR = bundled.Path({str(files)!r})\nsys.exit(main(['models']))"
        reader, writer = os.pipe()
        os.close(reader)
        environment = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
        done = subprocess.run(
            [sys.executable, "-c", script],
            cwd=ROOT,
            stdout=writer,
            stderr=subprocess.PIPE,
            timeout=TIMEOUT_S,
            env=environment,
        )
        os.close(writer)
        assert (done.returncode, done.stderr) == (0, b"")


class TestTerminal:
    def on_terminal(self, folder, *arguments, columns):
        """What a terminal of that width gets on stderr, and what goes to stdout."""
        leader, follower = pty.openpty()
        fcntl.ioctl(follower, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
        environment = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES")}
        with (folder / "stdout").open("w") as output:
            process = start(
                *arguments, stderr=follower, stdin=follower, stdout=output, env=environment | {"TERM": "xterm"}
            )
        os.close(follower)
        shown = b""
        while select.select([leader], [], [], TIMEOUT_S)[0]:
            try:
                shown += os.read(leader, 65536)
            except OSError:  # the process has ended
                break
        os.close(leader)
        assert process.wait(TIMEOUT_S) == 0
        return shown.decode(), (folder / "stdout").read_text()

    def test_the_live_line_is_there_without_asking(self, files, tmp_path):
        replay = ["--source", f"replay:{files}/taps.npz"]
        shown, output = self.on_terminal(tmp_path, *base_options(files), *replay, columns=120)
        live = re.findall(r"\r([^\r\n]*)\x1b\[K", shown)
        assert live and live[-1].startswith("REPLAY | 4 contact tap 4 ") and output == ""
        assert max(map(len, live)) <= 119

    @pytest.mark.parametrize("words", ["--source replay:taps.npz", "replay taps.npz"])
    def test_asked_for_it_is_there_once(self, files, tmp_path, words):
        """Also of a file at full speed, which has a bar else."""
        replay = words.replace("taps.npz", f"{files}/taps.npz").split(" ")
        model = ["--model", str(files / "tiny.onnx")]
        shown, _ = self.on_terminal(tmp_path, *replay, *model, "--sink", "status", columns=80)
        assert len(re.findall(r"\rREPLAY [^\r\n]*\x1b\[K\r\n", shown)) == 1

    def test_it_gives_way_to_records_on_stdout(self, files, tmp_path):
        replay = ["--source", f"replay:{files}/taps.npz", "--sink", "jsonl:-"]
        shown, output = self.on_terminal(tmp_path, *base_options(files), *replay, columns=80)
        assert "\x1b" not in shown and len(records(output)) == 40


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

    def test_none_bundled_is_4(self, monkeypatch, capsys, tmp_path):
        monkeypatch.setattr(bundle, "BUNDLE_DIR", tmp_path)
        assert cli.main(["models"]) == 4
        assert "no models" in capsys.readouterr().err


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
        assert_refused(done, 3, "sensor 4: taxel (1, 1) z", "keep the pad still and free")
        assert not (tmp_path / "zero.json").exists()

    def test_of_a_recording_a_few_free_scans_are_enough(self, files, tmp_path):
        begins_in_contact = write_recording(tmp_path / "held.npz", [3000] * 50 + [0] * 40)
        done = run(
            "baseline", "--source", f"replay:{begins_in_contact}", "--rate-hz", "1000", "--out", tmp_path / "zero.json",
            "--skip", "50", "--scans", "40",
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        assert load_baselines(tmp_path / "zero.json")["4"].scans == 40

    def test_a_recording_too_short_is_3(self, files, tmp_path):
        source = f"replay:{files}/taps.npz"
        done = run("baseline", "--source", source, "--rate-hz", "1000", "--out", tmp_path / "zero.json")
        assert_refused(done, 3, "ended before 100 complete scans")


class TestDemo:
    def test_a_demo_that_ends_before_its_first_tap_says_so(self, files, capsys):
        assert cli.main(["demo", "--model", f"{files}/tiny.onnx", "--duration-s", "0.2"]) == 0
        assert capsys.readouterr().out == "\nnone of 4 taps scored: the run ended before a tap had a pattern\n"

    def test_the_demo_scores_its_taps_and_draws_the_last(self, files):
        done = run(
            "--source", "demo", "--model", files / "tiny.onnx", "--rate-hz", "300", env=os.environ | {"COLUMNS": "80"}
        )
        assert done.returncode == 0, done.stderr
        assert "demo: an emulated sensor taps" in done.stderr and "EMULATED demo: 470 scans" in done.stderr
        assert "4 of 4 taps scored" in done.stdout
        rows = re.findall(
            r"^ +(\d) +(\d+) +(\d) +(-?[\d.]+) (-?[\d.]+) +([\d.]+) +- +(\d+)$", done.stdout, re.MULTILINE
        )
        assert [(int(row[0]), int(row[2])) for row in rows] == [(n, n) for n in (1, 2, 3, 4)]
        angles_deg = [int(row[1]) for row in rows]
        assert np.diff(angles_deg).tolist() == [5, 5, 5]
        assert re.search(r"^taxels, 4 x 4 +super-resolved, 40 x 40 +truth$", done.stdout, re.MULTILINE)
        assert "\x1b" not in done.stdout and "@" in done.stdout

    def test_with_records_on_stdout_the_score_goes_to_stderr(self, files):
        done = run(
            "--source", "demo", "--model", files / "tiny.onnx", "--rate-hz", "300", "--sink", "jsonl:-",
        )  # fmt: skip
        got = records(done.stdout)
        assert len(got) == 470 and {record["source"] for record in got} == {"emulated"}
        assert "4 of 4 taps scored" in done.stderr

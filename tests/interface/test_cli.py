"""`edge-sr` as a user runs it: help, recordings, models, baselines, refusals; signals, and streams closed or full.

At the end: recordings whose pad is held or only recovers, where they are zeroed, and the remedy that is printed.
"""

import json
import os
import pty
import re
import resource
import shlex
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from bridge_samples import write_recording as write_counts
from cli_samples import EDGE_SR, TIMEOUT_S, assert_refused, base_options, files, records, run, start, write_recording
from edge_samples import BASELINE, REST, ROOT, make_contract, wait_for, write_model

from edge.api import open_recording, take_baselines
from edge.cli import listings
from edge.cli import main as cli
from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.sensor_file.model import SensorEntry, SensorFile
from firmware_bridge.sensor_file.toml_writer import save_sensor_file
from firmware_bridge.zeroing.baseline import load_baselines

__all__ = ["files"]


def test_a_sensor_gets_one_taps_model_and_the_demo_that_of_poses(tmp_path):
    recording = write_counts(tmp_path / "rest.csv", np.full((3, 3, 4, 4), 30_000))
    for name, model in ((f"replay:{recording}", "stsr-int8"), ("demo", "mtsr-int8")):
        done = run("--source", name, "--rate-hz", "100", "--duration-s", "0.5", "--sink", "jsonl:-")
        assert {record["model"] for record in records(done.stdout)} == {model}


def test_help_fits_the_terminal_and_80_columns(capsys, monkeypatch):
    for columns, most in (("1", 40), ("40", 40), ("80", 80), ("200", 80)):
        monkeypatch.setenv("COLUMNS", columns)
        for command in ("", *cli.COMMANDS):
            with pytest.raises(SystemExit, match="0"):
                cli.main([*command.split(), "--help"])
            out, errors = capsys.readouterr()
            assert errors == "" and max(map(len, out.splitlines())) <= most, command
    assert cli.main(["-h"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) < 60 and any("--source" in line for line in lines), "the usual options, on one screen"
    assert lines[-1].startswith("edge-sr --help lists all options")


@pytest.mark.parametrize("options", [[], ["--measure"]])
def test_models_are_listed_with_their_errors_and_run_times(options, bundle, limits, capsys):
    limits(listings, RATE_HZ=2000.0)
    write_model(bundle / "mtsr4.onnx")
    sure = {"1": {"psnr_db": 30.1, "coverage_90": 0.9034}}
    write_model(bundle / "stsr.onnx", make_contract(taps=1, interval_factor=1.6, test_error=sure))
    assert cli.main(["models", *options]) == 0
    head, *rows = capsys.readouterr().out.splitlines()
    size_mb = (bundle / "mtsr4.onnx").stat().st_size / 1e6
    assert rows[0].split()[:7] == ["mtsr4", "4", f"{size_mb:.1f}", "float32", "33.2", "2.10", "-"]
    assert rows[1].split()[:7] == ["stsr", "1", f"{size_mb:.1f}", "float32", "30.1", "-", "-"]
    assert max(map(len, (head, *rows[:2]))) <= 80 and ("p50 us p99 us" in head) == bool(options)
    times_us = [int(one) for one in rows[0].split()[7:]]
    assert times_us == sorted(times_us) and len(times_us) == 2 * len(options) and all(one > 0 for one in times_us)


def test_a_demo_that_ends_before_its_first_tap_says_so(files, capsys):
    assert cli.main(["demo", "--model", f"{files}/tiny.onnx", "--duration-s", "0.2"]) == 0
    assert capsys.readouterr().out == "\nnone of 4 taps scored: the run ended before a tap had a pattern\n"


KNOWN = "--model {files}/tiny.onnx --baseline {files}/zero.json"
AT_REST = "--source replay:{files}/rest.npz"
MAP = "map --source replay:none.npz --out"
NONE = "replay none.npz --model none"
ZERO = "baseline --rate-hz 1000 --out {tmp}/zero.json --source replay:"


@pytest.mark.parametrize(
    ("code", "typed", "words"),
    [
        (2, "--counts-per-newton 1e8", ["--counts-per-newton: '1e8' is not a positive number, 0.001 to 1e+06"]),
        (2, "model", ["no command 'model': did you mean models?"]),
        (2, "--source demo --view-host 0.0.0.0", ["--view-host requires --view"]),
        (5, "--source demo --view 0 --view-host 192.0.2.1", ["cannot listen on 192.0.2.1:0: ", "with --view-host"]),
        (2, "--source replay:none\nsuch.npz", ["none such.npz"]),
        (2, "doctor --sensor {tmp}/s.toml --id-map A", ["is of a XR1944"]),
        (5, f"{MAP} {{tmp}}/kept.npz", ["exists: give another name"]),
        (2, f"{MAP} {{tmp}}/m.mcap", ["ends in .npz"]),
        (2, f"{MAP} {{tmp}}/m.npz --size-mm 9000", ["pixels along a side"]),
        (2, f"{MAP} {{tmp}}/m.npz --centre-mm 0 nan", ["finite numbers"]),
        (3, f"{KNOWN} --source slcan:/dev/none --sink jsonl:{{tmp}}/kept.jsonl", ["/dev/none", "no such port"]),
        (3, f"{KNOWN} --source slcan:serial=NOSUCH", ["NOSUCH"]),
        (2, f"{ZERO}{{files}}/rest.npz --out {{tmp}}/other.onnx", ["other.onnx holds something else: give another"]),
        (3, f"{ZERO}{{tmp}}/moving.npz", ["nowhere free and still for 30 scans", "taxel (1, 1) z", "moved by"]),
        (4, f"{AT_REST} --model {{tmp}}/other.onnx", ["'pitch_mm' is 5.0", "4.7"]),
        (2, f"{NONE} --sink jsonl:- --fields force_n,patern", ["no field 'patern'", "did you mean pattern?"]),
        (2, f"{NONE} --fields force_n", ["--fields requires a sink of JSON records"]),
        (2, f"{NONE} --sink jsonl:a --sink mcap:a.mcap --sink jsonl:./a", ["'jsonl:a' and 'jsonl:./a' write to the"]),
        (2, f"{NONE} --sink zenoh:a//b", ["'a//b'", "words with '/' between"]),
    ],
)
def test_a_refusal_is_one_line_with_its_code_and_all_files_stay(code, typed, words, files, tmp_path):
    write_model(tmp_path / "other.onnx", make_contract(pitch_mm=5.0))
    (tmp_path / "kept.npz").write_text("old")
    (tmp_path / "kept.jsonl").write_text("old")
    save_sensor_file(tmp_path / "s.toml", SensorFile("XR1944", sensors={"4": SensorEntry()}))
    write_recording(tmp_path / "moving.npz", range(0, 2000, 10))
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert_refused(run(*typed.format(files=files, tmp=tmp_path).split(" ")), code, *words)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_full_disk_is_5_after_the_summary(files):
    done = run(*base_options(files), "--source", f"replay:{files}/rest.npz", "--sink", "jsonl:/dev/full")
    lines = done.stderr.splitlines()
    assert lines[0] == "edge-sr: model tiny has no checks: act on no pattern of it"
    assert done.returncode == 5 and lines[1].startswith("REPLAY")
    assert lines[-1] == "edge-sr: cannot write records to /dev/full: No space left on device"
    with Path("/dev/full").open("w") as full:
        process = start(*base_options(files), "--source", f"replay:{files}/rest.npz", "--sink", "jsonl:-", stdout=full)
        assert "cannot write records to stdout: No space left" in process.communicate()[1] and process.returncode == 5


def test_of_a_recording_a_few_free_scans_are_enough(files, tmp_path):
    begins_in_contact = write_recording(tmp_path / "held.npz", [3000] * 50 + [0] * 40)
    zero = tmp_path / "free.json"
    zero.write_text('{"format": "tactile-baseline"}')
    done = run("baseline", "--source", f"replay:{begins_in_contact}", "--out", zero)
    assert done.returncode == 0 and "sensor 4: zeroed from its scans 5" in done.stderr
    assert done.stderr.count("where the pad is still and pressed least\n") == 1
    assert f"the former file is now {zero}.bak" in done.stdout
    assert (tmp_path / "free.json.bak").read_text() == '{"format": "tactile-baseline"}'
    baseline = load_baselines(zero)["4"]
    assert np.abs(baseline.counts - BASELINE.counts).max() < 5
    # A baseline of a recording without a date has no age.
    assert np.isnan(baseline.created_unix_s)
    with open_recording(files / "rest.npz") as source:
        assert np.isnan(take_baselines(source)["4"].created_unix_s)
    for paced in ([], ["--paced"]):
        done = run("replay", begins_in_contact, *paced, "--model", files / "tiny.onnx", "--sink", "jsonl:-")
        got = [one for one in records(done.stdout) if one["state"] != "event"]
        assert {(one["baseline_origin"], one["baseline_age_s"]) for one in got} == {("recording", None)}


def test_the_baseline_of_a_pad_that_may_be_held_is_in_doubt(tmp_path):
    done = run("replay", write_recording(tmp_path / "held.npz", [*[400] * 60, *[0] * 110]))
    assert "sensor 4 has no pattern to be believed: baseline in doubt: taken from this recording" in done.stderr


def test_the_example_is_a_grip_of_two_emulated_fingers():
    done = run("replay", "--example", "--sink", "jsonl:-", "--fields", "trusted,force_counts")
    assert done.returncode == 0 and "grip.npz was recorded from an emulated sensor" in done.stderr
    got = [one for one in records(done.stdout) if one["state"] != "event"]
    for sensor in "46":
        held = [one for one in got if one["sensor"] == sensor and one["state"] == "contact"]
        assert len(held) > 300 and sum(one["trusted"] is True for one in held) > 0.9 * len(held)


@pytest.fixture
def emulator(files):
    with Emulator([load_recording(files / "taps.npz")], loop=True) as emulator:
        yield emulator


def follow(emulator, files, *more):
    process = start(*base_options(files), "--source", f"slcan:{emulator.port}", "--sink", "jsonl:-", *more)
    return process, [process.stdout.readline() for _ in range(10)]


@pytest.mark.parametrize(("hang_up", "code"), [(True, 0), (False, 3)])
def test_a_hang_up_and_a_cable_out_keep_all_records(emulator, files, tmp_path, hang_up, code):
    """A hang-up as Ctrl-C and SIGTERM do, which tests of keys and of poses send."""
    process, first = follow(emulator, files, "--sink", f"mcap:{tmp_path}/out.mcap", "--give-up-s", "0")
    if hang_up:
        process.send_signal(signal.SIGHUP)
    else:
        emulator.hang_up()
    # Not by communicate(), which ignores the text that readline() has read ahead.
    rest, errors = process.stdout.read(), process.stderr.read()
    assert process.wait(TIMEOUT_S) == code and "Traceback" not in errors
    got = records("".join(first) + rest)
    assert [record["scan"] for record in got] == list(range(len(got)))
    assert {record["source"] for record in got} == {"emulated"}
    assert len(load_recording(tmp_path / "out.mcap").tracks[0].counts) == len(got) >= 10
    assert f"\nEMULATED slcan:{emulator.port}: {len(got)} scans" in errors
    assert (f"\nedge-sr: {emulator.port}: link lost" in errors) != hang_up


def test_ignored_signals_end_nothing_and_a_closed_pipe_does(emulator, files):
    """As under nohup, or in the background of a shell without jobs."""
    numbers = (signal.SIGHUP, signal.SIGINT, signal.SIGUSR1)
    before = {number: signal.signal(number, signal.SIG_IGN) for number in numbers}
    try:
        process, _ = follow(emulator, files)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    for number in numbers:
        process.send_signal(number)
    got = records("".join(process.stdout.readline() for _ in range(100)))
    assert len(got) == 100 and not [one for one in got if one["state"] == "event"]
    process.stdout.close()
    assert process.wait(TIMEOUT_S) == 0
    errors = process.stderr.read()
    assert "\nEMULATED " in errors and "Traceback" not in errors and "Exception" not in errors


def test_without_a_model_the_link_is_closed_or_stays_so(emulator, tmp_path):
    """A link that is slow to open would hold up the message of a missing one; and it opens while another one loads."""
    (tmp_path / "broken.onnx").write_text("no model")
    done = run("--model", tmp_path / "broken.onnx", "--source", f"slcan:{emulator.port}")
    assert done.returncode == 4 and "broken.onnx: not a model" in done.stderr
    wait_for(lambda: not emulator.adapter.channel_open)
    received = []
    emulator.adapter.feed = lambda data: received.append(data) or b""
    done = run("--model", "nothere", "--source", f"slcan:{emulator.port}")
    assert done.returncode == 4 and done.stderr.startswith("edge-sr: no model 'nothere'") and received == []


def test_a_port_that_never_speaks_is_3_with_what_to_do(files):
    leader, follower = pty.openpty()
    name = f"slcan:{os.ttyname(follower)}"
    done = run(*base_options(files), "--source", name, "--duration-s", "6")
    os.close(leader), os.close(follower)
    assert done.returncode == 3 and done.stdout == ""
    doctor = f"edge-sr doctor --source {name} shows what is wrong"
    lines = done.stderr.splitlines()
    assert re.match(rf"edge-sr: no scan in [56] s: nothing came: is the sensor powered .*{doctor}$", lines[1])
    assert lines[-1].startswith(f"edge-sr: no scan came from {name}: ") and lines[-1].endswith(doctor)


def in_shell(redirection, *arguments, unbuffered=""):
    """A run whose streams a shell has redirected; all that is left of them is read."""
    command = ["/bin/sh", "-c", f'exec "$@" {redirection}', "sh", *EDGE_SR, *map(str, arguments)]
    environment = os.environ | {"PYTHONUNBUFFERED": unbuffered}
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=TIMEOUT_S, env=environment)


@pytest.mark.parametrize(
    ("command", "redirection", "why", "unbuffered"),
    [
        ("demo --duration-s 0.1", ">/dev/full", "No space left", ""),
        ("models", ">/dev/full", "No space left", "1"),
        ("models", ">&-", "Bad file descriptor", ""),
        ("--help", ">/dev/full", "No space left", ""),
    ],
)
def test_a_stdout_that_takes_nothing_is_5_in_one_line(command, redirection, why, unbuffered):
    done = in_shell(redirection, *command.split(" "), unbuffered=unbuffered)
    assert done.returncode == 5 and done.stdout == ""
    assert done.stderr.splitlines()[-1].startswith(f"edge-sr: cannot write to stdout: {why}"), done.stderr
    assert "Traceback" not in done.stderr and "Exception" not in done.stderr


@pytest.mark.parametrize("redirection", ["2>/dev/full", "<&- 2>&-"])
def test_without_a_stderr_stdout_has_records_and_nothing_else(files, redirection):
    options = [*base_options(files), "--source", f"replay:{files}/taps.npz", "--sink", "jsonl:-"]
    done = in_shell(redirection, *options)
    assert done.returncode == 0 and done.stderr == ""
    assert len([json.loads(line) for line in done.stdout.splitlines()]) == 40


def test_ctrl_c_while_modules_are_imported_ends_in_no_traceback(tmp_path):
    """The signal comes in the first foreign module, as no program can guard the interpreter's own start."""
    (tmp_path / "numpy.py").write_text("print('importing', flush=True)\nimport time\ntime.sleep(60)\n")
    environment = os.environ | {"PYTHONPATH": f"{tmp_path}:{ROOT}"}
    command = [sys.executable, "-m", "edge", "demo"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    process = subprocess.Popen(command, cwd=tmp_path, env=environment, text=True, **pipes)
    assert process.stdout.readline() == "importing\n"
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=TIMEOUT_S)
    assert (process.returncode, errors) == (-signal.SIGINT, "")


def test_no_control_character_of_a_file_reaches_the_terminal(tmp_path):
    """It may stand in a cell, a header, a key, or in the name of a file, which need not be UTF-8 either."""
    text = "\x1b[2J\x1b]0;title\x07\x9b2J\x1b[31m\r"
    columns = [f"txl{taxel}_{axis}" for taxel in range(1, 17) for axis in "xyz"]
    key = json.dumps(text)
    name = os.fsdecode(b"\xfc") + text
    for path, content in (
        (tmp_path / "cell.csv", ",".join(columns) + "\n" + "1," * 47 + f'"{text}"\n'),
        (tmp_path / "head.csv", f'"{text}",' + ",".join(columns[1:]) + "\n"),
        (tmp_path / f"{name}.csv", ",".join(columns) + "\n" + (",".join(["30000"] * 48) + "\n") * 40),
        (tmp_path / "key.toml", f'format = "tactile-sensor"\nversion = 1\nmodel = "uSPa44"\n{key} = 1\n[sensors.4]\n'),
    ):
        path.write_text(content, newline="")
        asked = ["--source", "demo", "--sensor", path] if path.suffix == ".toml" else ["replay", path, "--rate-hz", 100]
        done = run(*asked, "--sink", "jsonl:-")
        printed = done.stdout + done.stderr
        assert done.returncode == (0 if name in path.name else 2) and "Traceback" not in printed
        assert printed.replace("\n", "").isprintable()


def test_fewer_descriptors_than_a_run_needs_end_in_one_line():
    few = partial(resource.setrlimit, resource.RLIMIT_NOFILE, (14, 14))
    process = start("--source", "demo", "--duration-s", "1", preexec_fn=few)
    errors = process.communicate(timeout=TIMEOUT_S)[1]
    assert process.returncode == 5 and "Traceback" not in errors
    assert errors.splitlines()[-1] == "edge-sr: Too many open files: allow more of them, ulimit -n 256"


GRIP = np.zeros((3, 4, 4))
GRIP[2] = np.linspace(400, 1100, 16).reshape(4, 4)
DRIFT = np.zeros((3, 4, 4))
DRIFT[2] = 560 + 90 * np.cos(np.arange(16)).reshape(4, 4)
DRIFT[0] = -110


def write_parts(path, *parts):
    """Write a recording of (scans, counts over rest) parts, as the vendor's logger does, without times."""
    felt = np.array([felt + np.zeros((3, 4, 4)) for scans, felt in parts for _ in range(scans)])
    noise = np.random.default_rng(0).normal(0, 2, felt.shape)
    path.parent.mkdir(exist_ok=True)
    return write_counts(path, np.rint(REST + felt + noise).astype(int))


def moving(scans):
    """Parts of a grip that moves all the time, as real ones do."""
    return [(1, GRIP * (1 + 0.04 * np.sin(number / 3))) for number in range(scans)]


def played(files, *arguments):
    done = run("replay", *arguments, "--model", files / "tiny.onnx", "--sink", "jsonl:-")
    assert done.returncode == 0, done.stderr
    return [one for one in records(done.stdout) if one["state"] != "event"], done.stderr


def test_the_printed_remedy_for_a_recording_of_a_held_pad_works(files, tmp_path):
    held = write_parts(tmp_path / "monday/left.csv", *moving(150))
    released = write_parts(tmp_path / "tuesday/released.csv", *moving(90), (90, DRIFT))
    shown, stderr = played(files, held, "--rate-hz", "60")
    assert not any(one["contact"] or one["trusted"] for one in shown) and {one["state"] for one in shown} != {"idle"}
    first, second = re.findall(r"edge-sr ((?:baseline|replay) .*?)(?:;| shows)", stderr)
    zero = str(tmp_path / "zero.json")
    done = run(*shlex.split(first.replace("OTHER", str(released)).replace("zero.json", zero)))
    assert done.returncode == 0, done.stderr
    shown, _ = played(files, *shlex.split(second.replace("zero.json", zero))[1:])
    assert {one["state"] for one in shown} == {"baseline_in_doubt"} and not any(one["trusted"] for one in shown)
    assert all(one["pattern"] is not None for one in shown)
    shown, _ = played(files, released, "--rate-hz", "60")
    assert {one["state"] for one in shown[:89]} == {"contact"} and {one["state"] for one in shown[95:]} == {"idle"}


def test_a_pad_that_only_recovers_gives_patterns(files, tmp_path):
    falls = [(1, GRIP * share) for share in (0.8, 0.5, 0.2)]
    recovers = [(1, np.array([0, 0, 30.0 * (1 - n / 35)])[:, None, None]) for n in range(36)]
    path = write_parts(tmp_path / "left.csv", *moving(20), *falls, *recovers)
    shown, stderr = played(files, path, "--rate-hz", "60")
    assert {one["state"] for one in shown[:21]} == {"contact"} and {one["state"] for one in shown[26:]} == {"idle"}
    assert re.search(r"pressed least; it recovers there: a taxel may be off by \d+ counts", stderr)

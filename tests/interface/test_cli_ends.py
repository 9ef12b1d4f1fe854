"""Ends of `edge-sr`: signals, streams that are closed or full, and the terminal that it leaves, of real processes."""

import json
import os
import pty
import re
import resource
import signal
import subprocess
import sys
from functools import partial

import pytest
from cli_samples import TIMEOUT_S, base_options, files, records, run, start
from edge_samples import ROOT, wait_for

from edge.cli import main as cli
from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.recording.formats import load_recording

__all__ = ["files"]


class TestEnds:
    @pytest.fixture
    def emulator(self, files):
        with Emulator([load_recording(files / "taps.npz")], loop=True) as emulator:
            yield emulator

    def follow(self, emulator, files, *more):
        """Return a run on the emulator and its first records."""
        process = start(*base_options(files), "--source", f"slcan:{emulator.port}", "--sink", "jsonl:-", *more)
        first = [process.stdout.readline() for _ in range(10)]
        return process, first

    def rest(self, process):
        """Return the unread rest; not by communicate(), which ignores the text that readline() has read ahead."""
        rest, errors = process.stdout.read(), process.stderr.read()  # of errors there are too few to fill a pipe
        process.wait(TIMEOUT_S)
        return rest, errors

    def test_a_hang_up_ends_it_cleanly_with_the_summary(self, emulator, files, tmp_path):
        """As Ctrl-C and SIGTERM do, which tests of keys and of poses send."""
        process, first = self.follow(emulator, files, "--sink", f"mcap:{tmp_path}/out.mcap")
        process.send_signal(signal.SIGHUP)
        rest, errors = self.rest(process)
        assert process.returncode == 0
        got = records("".join(first) + rest)
        assert [record["scan"] for record in got] == list(range(len(got)))
        assert {record["source"] for record in got} == {"emulated"}
        assert f"\nEMULATED slcan:{emulator.port}: {len(got)} scans" in errors and "Traceback" not in errors
        assert len(load_recording(tmp_path / "out.mcap").tracks[0].counts) == len(got)

    def test_a_signal_that_the_parent_wants_ignored_is_ignored(self, emulator, files):
        """As under nohup, or in the background of a shell without jobs."""
        numbers = (signal.SIGHUP, signal.SIGINT, signal.SIGUSR1)
        before = {number: signal.signal(number, signal.SIG_IGN) for number in numbers}
        try:
            process, _ = self.follow(emulator, files)
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
        for number in numbers:
            process.send_signal(number)
        got = records("".join(process.stdout.readline() for _ in range(100)))
        assert len(got) == 100 and not [one for one in got if one["state"] == "event"]
        process.send_signal(signal.SIGTERM)
        self.rest(process)
        assert process.returncode == 0

    def test_a_closed_pipe_ends_it_cleanly_with_the_summary(self, emulator, files):
        process, _ = self.follow(emulator, files)
        process.stdout.close()
        assert process.wait(TIMEOUT_S) == 0
        errors = process.stderr.read()
        assert "\nEMULATED " in errors and "Traceback" not in errors and "Exception" not in errors

    def test_the_cable_out_keeps_the_records_and_is_3(self, emulator, files, tmp_path):
        process, first = self.follow(emulator, files, "--sink", f"mcap:{tmp_path}/out.mcap", "--give-up-s", "0")
        emulator.hang_up()
        rest, errors = self.rest(process)
        assert process.returncode == 3
        got = records("".join(first) + rest)
        assert len(load_recording(tmp_path / "out.mcap").tracks[0].counts) == len(got) >= 10
        _, *summary, last = errors.splitlines()
        assert summary[0].startswith(f"EMULATED slcan:{emulator.port}: {len(got)} scans")
        assert last.startswith(f"edge-sr: {emulator.port}: link lost")

    def test_a_model_that_does_not_exist_ends_before_the_link_is_opened(self, emulator, capsys):
        """A link that is slow to open would hold up the message."""
        received = []
        emulator.adapter.feed = lambda data: received.append(data) or b""
        assert cli.main(["--model", "nothere", "--source", f"slcan:{emulator.port}"]) == 4
        assert capsys.readouterr().err.startswith("edge-sr: no model 'nothere'") and received == []

    def test_a_model_that_cannot_be_used_leaves_the_channel_closed(self, emulator, tmp_path):
        """The link opens while the model loads."""
        (tmp_path / "broken.onnx").write_text("no model")
        done = run("--model", tmp_path / "broken.onnx", "--source", f"slcan:{emulator.port}")
        assert done.returncode == 4 and "broken.onnx: not a model" in done.stderr
        wait_for(lambda: not emulator.adapter.channel_open)

    def test_a_port_that_never_speaks_is_told_of_with_what_to_do_and_is_3(self, files):
        leader, follower = pty.openpty()
        name = f"slcan:{os.ttyname(follower)}"
        done = run(*base_options(files), "--source", name, "--duration-s", "6")
        os.close(leader), os.close(follower)
        assert done.returncode == 3 and done.stdout == ""
        doctor = f"edge-sr doctor --source {name} shows what is wrong"
        lines = done.stderr.splitlines()
        assert re.match(rf"edge-sr: no scan in [56] s: nothing came: is the sensor powered .*{doctor}$", lines[1])
        assert lines[-1].startswith(f"edge-sr: no scan came from {name}: ") and lines[-1].endswith(doctor)

    def test_models_into_a_closed_pipe_stay_quiet(self):
        reader, writer = os.pipe()
        os.close(reader)
        with start("models", stdout=writer) as process:
            os.close(writer)
            assert process.stderr.read() == ""
        assert process.returncode == 0


def in_shell(redirection, *arguments, unbuffered):
    """A run whose streams a shell has redirected; all that is left of them is read."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    environment |= {"PYTHONUNBUFFERED": "1"} if unbuffered else {}
    return subprocess.run(
        ["/bin/sh", "-c", f'exec "$@" {redirection}', "sh",
         sys.executable, "-m", "edge.cli.main", *map(str, arguments)],
        cwd=ROOT, capture_output=True, text=True, timeout=TIMEOUT_S, stdin=subprocess.DEVNULL, env=environment,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("command", "redirection", "why", "unbuffered"),
    [
        ("demo --duration-s 0.1", ">/dev/full", "No space left", False),
        ("models", ">/dev/full", "No space left", True),
        ("models", ">&-", "Bad file descriptor", False),
        ("--help", ">/dev/full", "No space left", False),
    ],
)
def test_a_stdout_that_takes_nothing_is_5_in_one_line(command, redirection, why, unbuffered):
    done = in_shell(redirection, *command.split(" "), unbuffered=unbuffered)
    assert done.returncode == 5 and done.stdout == ""
    assert done.stderr.splitlines()[-1].startswith(f"edge-sr: cannot write to stdout: {why}"), done.stderr
    assert "Traceback" not in done.stderr and "Exception" not in done.stderr


@pytest.mark.parametrize("redirection", ["2>/dev/full", "<&- 2>&-"])
def test_without_a_stderr_there_are_records_on_stdout_and_nothing_else(files, redirection):
    options = [*base_options(files), "--source", f"replay:{files}/taps.npz", "--sink", "jsonl:-"]
    done = in_shell(redirection, *options, unbuffered=False)
    assert done.returncode == 0 and done.stderr == ""
    assert len([json.loads(line) for line in done.stdout.splitlines()]) == 40


def test_ctrl_c_while_modules_are_imported_ends_in_no_traceback(tmp_path):
    """The signal comes in the first foreign module, as no program can guard the interpreter's own start."""
    (tmp_path / "numpy.py").write_text("print('importing', flush=True)\nimport time\ntime.sleep(60)\n")
    environment = os.environ | {"PYTHONPATH": f"{tmp_path}:{ROOT}"}
    command = [sys.executable, "-m", "edge", "demo"]
    process = subprocess.Popen(
        command, cwd=tmp_path, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
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
        (
            tmp_path / "key.toml",
            f'format = "tactile-sensor"\nversion = 1\nmodel = "uSPa44"\n{key} = 1\n[sensors.4]\n',
        ),
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

"""Standard streams that are closed or full, and Ctrl-C before anything listens for it: real ones, of real processes."""

import json
import os
import resource
import signal
import subprocess
import sys

import pytest
from cli_samples import EDGE_SR, TIMEOUT_S, base_options, files
from edge_samples import ROOT

__all__ = ["files"]

REPLAY = ["replay", "{files}/taps.npz"]


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
        ("doctor --source demo --no-press --drift-s 1", ">&-", "Bad file descriptor", True),
        ("--help", ">/dev/full", "No space left", False),
    ],
)
def test_a_stdout_that_takes_nothing_is_5_in_one_line(command, redirection, why, unbuffered):
    done = in_shell(redirection, *command.split(" "), unbuffered=unbuffered)
    assert done.returncode == 5 and done.stdout == ""
    assert done.stderr.splitlines()[-1].startswith(f"edge-sr: cannot write to stdout: {why}"), done.stderr
    assert "Traceback" not in done.stderr and "Exception" not in done.stderr


@pytest.mark.parametrize("redirection", ["2>&-", "2>/dev/full", "<&- 2>&-", "2</dev/null"])
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
    assert process.stdout is not None and process.stdout.readline() == "importing\n"
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=TIMEOUT_S)
    assert (process.returncode, errors) == (-signal.SIGINT, "")


@pytest.mark.parametrize("text", ["\x1b[2J", "\x1b]0;title\x07", "\x9b2J", "\x1b[31m\r"])
def test_no_control_character_of_a_file_reaches_the_terminal(tmp_path, text):
    """It may stand in a cell, a header, a key, or in the name of a file, which need not be UTF-8 either."""
    columns = [f"txl{taxel}_{axis}" for taxel in range(1, 17) for axis in "xyz"]
    quoted = json.dumps(text)
    name = os.fsdecode(b"\xfc") + text
    for path, content in (
        (tmp_path / "cell.csv", ",".join(columns) + "\n" + "1," * 47 + f'"{text}"\n'),
        (tmp_path / "head.csv", f'"{text}",' + ",".join(columns[1:]) + "\n"),
        (tmp_path / f"{name}.csv", ",".join(columns) + "\n" + (",".join(["30000"] * 48) + "\n") * 40),
        (
            tmp_path / "key.toml",
            f'format = "tactile-sensor"\nversion = 1\nmodel = "uSPa44"\n{quoted} = 1\n[sensors.4]\n',
        ),
    ):
        path.write_text(content, newline="")
        asked = (
            ["--source", "demo", "--sensor", path] if path.suffix == ".toml" else ["replay", path, "--rate-hz", "100"]
        )
        done = subprocess.run([*EDGE_SR, *map(str, asked), "--sink", "jsonl:-"], capture_output=True, cwd=ROOT)
        printed = (done.stdout + done.stderr).decode()
        assert done.returncode == (0 if name in path.name else 2) and "Traceback" not in printed
        assert text not in printed and printed.replace("\n", "").isprintable()


def test_odd_surroundings_end_in_one_line():
    """A terminal one column wide, and fewer descriptors than a run needs."""
    helped = subprocess.run(
        [*EDGE_SR, "--help"], capture_output=True, text=True, cwd=ROOT, env=os.environ | {"COLUMNS": "1"}
    )
    assert (helped.returncode, helped.stderr) == (0, "") and "--source" in helped.stdout
    done = subprocess.run(
        [*EDGE_SR, "--source", "demo", "--duration-s", "1"],
        capture_output=True,
        text=True,
        cwd=ROOT,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_NOFILE, (14, 14)),
    )
    assert done.returncode == 5 and "Traceback" not in done.stderr
    assert done.stderr.splitlines()[-1] == "edge-sr: Too many open files: allow more of them, ulimit -n 256"

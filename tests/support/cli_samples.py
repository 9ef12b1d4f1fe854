"""Runs of `edge-sr`, in this process or in one of their own, and files for them."""

import contextlib
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from bridge_samples import write_npz
from edge_samples import BASELINE, ROOT, make_contract, make_scan, write_model

from edge.cli import main as cli
from firmware_bridge.zeroing.baseline import save_baselines

EDGE_SR = [sys.executable, "-m", "edge.cli.main"]
TIMEOUT_S = 60


def write_recording(path: Path, presses, period_ns=10_000_000) -> Path:
    counts = np.stack([make_scan(n, press_counts=press, noise=3).counts for n, press in enumerate(presses)])
    return write_npz(path, counts, np.arange(len(counts)) * period_ns)


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


def run(*arguments, **environment):
    """Run `edge-sr` in this process to its end; its streams are files, since records go past `sys.stdout`."""
    with (
        tempfile.TemporaryFile("w+", encoding="utf-8") as out,
        tempfile.TemporaryFile("w+", encoding="utf-8") as err,
        mock.patch.dict(os.environ, environment),
    ):
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            try:
                code = cli.main([*map(str, arguments)])
            except SystemExit as end:
                code = end.code
        for file in (out, err):
            file.seek(0)
        return subprocess.CompletedProcess(arguments, code if isinstance(code, int) else 0, out.read(), err.read())


def start(*arguments, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, **settings):
    command = [*EDGE_SR, *map(str, arguments)]
    return subprocess.Popen(command, cwd=ROOT, text=True, stdin=stdin, stdout=stdout, stderr=stderr, **settings)


def records(text):
    return [json.loads(line) for line in text.splitlines()]


def assert_refused(done, code, *words):
    assert done.returncode == code, done.stderr
    assert done.stdout == ""
    assert done.stderr.startswith("edge-sr: ") and done.stderr.count("\n") == 1, done.stderr
    for word in words:
        assert word in done.stderr

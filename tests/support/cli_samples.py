"""Runs of `edge-sr` in a process of their own, and files for them."""

import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from edge_samples import BASELINE, ROOT, make_contract, make_scan, write_model

from firmware_bridge.zeroing.baseline import save_baselines

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


def start(*arguments, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, **settings):
    command = [*EDGE_SR, *map(str, arguments)]
    return subprocess.Popen(command, cwd=ROOT, text=True, stdin=stdin, stdout=stdout, stderr=stderr, **settings)


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

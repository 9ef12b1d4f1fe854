"""Recordings whose pad is held or only recovers: where they are zeroed, and the remedy that is printed."""

import json
import re
import shlex

import numpy as np
import pytest
from bridge_samples import write_recording
from cli_samples import records, run
from edge_samples import REST, write_model

from edge.api import load_baselines, open_recording, take_baselines

GRIP = np.zeros((3, 4, 4))
GRIP[2] = np.linspace(400, 1100, 16).reshape(4, 4)
DRIFT = np.zeros((3, 4, 4))
DRIFT[2] = 560 + 90 * np.cos(np.arange(16)).reshape(4, 4)
DRIFT[0] = -110


def write_parts(path, *parts):
    """Write a recording of (scans, counts over rest) parts, as the vendor's logger does, without times."""
    felt = np.array([felt + np.zeros((3, 4, 4)) for scans, felt in parts for _ in range(scans)])
    noise = np.random.default_rng(0).normal(0, 2, felt.shape)
    return write_recording(path, np.rint(REST + felt + noise).astype(int))


def moving(scans):
    """Parts of a grip that moves all the time, as real ones do."""
    return [(1, GRIP * (1 + 0.04 * np.sin(number / 3))) for number in range(scans)]


@pytest.fixture
def folder(tmp_path):
    write_model(tmp_path / "tiny.onnx")
    (tmp_path / "monday").mkdir()
    (tmp_path / "tuesday").mkdir()
    return tmp_path


def played(folder, *arguments):
    done = run("replay", *arguments, "--model", folder / "tiny.onnx", "--sink", "jsonl:-")
    assert done.returncode == 0, done.stderr
    return [one for one in records(done.stdout) if one["state"] != "event"], done.stderr


def test_the_printed_remedy_for_a_recording_of_a_held_pad_works(folder):
    held = write_parts(folder / "monday" / "left.csv", *moving(150))
    released = write_parts(folder / "tuesday" / "released.csv", *moving(90), (90, DRIFT))
    shown, stderr = played(folder, held, "--rate-hz", "60")
    assert not any(one["contact"] or one["trusted"] for one in shown) and {one["state"] for one in shown} != {"idle"}
    first, second = re.findall(r"edge-sr ((?:baseline|replay) .*?)(?:;| shows)", stderr)
    zero = str(folder / "zero.json")
    done = run(*shlex.split(first.replace("OTHER", str(released)).replace("zero.json", zero)))
    assert done.returncode == 0, done.stderr
    shown, _ = played(folder, *shlex.split(second.replace("zero.json", zero))[1:])
    assert {one["state"] for one in shown} == {"baseline_in_doubt"} and not any(one["trusted"] for one in shown)
    assert all(one["pattern"] is not None for one in shown)
    shown, _ = played(folder, released, "--rate-hz", "60")
    assert {one["state"] for one in shown[:89]} == {"contact"} and {one["state"] for one in shown[95:]} == {"idle"}


def test_a_recordings_baseline_has_no_age_and_the_former_stays(folder):
    path, zero = write_parts(folder / "left.csv", (120, 0)), folder / "zero.json"
    zero.write_text('{"format": "tactile-baseline"}')
    done = run("baseline", "--source", f"replay:{path}", "--rate-hz", "600", "--out", zero)
    assert done.returncode == 0 and f"the former file is now {zero}.bak" in done.stdout, done.stderr
    assert (folder / "zero.json.bak").read_text() == '{"format": "tactile-baseline"}'
    assert json.loads(zero.read_text())["baselines"][0]["created_unix_s"] is None
    assert np.isnan(load_baselines(zero)["left"].created_unix_s)
    with open_recording(path, rate_hz=60) as source:
        assert np.isnan(take_baselines(source)["left"].created_unix_s)


def test_a_pad_that_only_recovers_gives_patterns(folder):
    falls = [(1, GRIP * share) for share in (0.8, 0.5, 0.2)]
    recovers = [(1, np.array([0, 0, 30.0 * (1 - n / 35)])[:, None, None]) for n in range(36)]
    path = write_parts(folder / "left.csv", *moving(20), *falls, *recovers)
    shown, stderr = played(folder, path, "--rate-hz", "60")
    assert {one["state"] for one in shown[:21]} == {"contact"} and {one["state"] for one in shown[26:]} == {"idle"}
    assert re.search(r"pressed least; it recovers there: a taxel may be off by \d+ counts", stderr)

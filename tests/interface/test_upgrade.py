"""Files that version 0.1.0 wrote, each used as a user of today would: a recording of 140 scans, its last 30 pressed.

The press is the same on every taxel, as no touch is: since this is noticed its baseline is in doubt, and its patterns
are still made. Its commands `baseline`, `doctor --out`, `--sink npz:` and `--sink mcap:` wrote them from one CSV file.
"""

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from bridge_samples import write_recording
from cli_samples import records, run
from edge_samples import REST, write_model

from edge.api import load_baselines, open_recording, take_baselines
from edge.cli import main as cli

FILES = Path(__file__).parent / "first_version"
PRESSED_COUNTS = 3200
RECORDED = {"press.npz": "77541fa2", "press.mcap": "f2d780d9"}
KEPT = {("--baseline", "zero.json"): "2f189ebe", ("--sensor", "sensor.toml"): "437eeea8"}


def replayed(tmp_path, *arguments):
    out = tmp_path / "out.jsonl"
    assert cli.main(["replay", *arguments, "--model", "stsr-small-int8", "--sink", f"jsonl:{out}"]) == 0
    return [json.loads(line) for line in out.read_text().splitlines()]


def check_press(records):
    assert [record["scan"] for record in records] == list(range(140)) and {one["sensor"] for one in records} == {"4"}
    pressed = [record for record in records if record["pattern"]]
    assert [record["scan"] for record in pressed] == list(range(110, 140))
    assert {record["state"] for record in pressed} == {"baseline_in_doubt"}
    assert pressed[-1]["force_counts"] == pytest.approx(PRESSED_COUNTS, abs=40)


@pytest.mark.parametrize("name", RECORDED)
def test_a_recording_replays_with_the_baseline_it_was_made_with(name, tmp_path):
    records = replayed(tmp_path, str(FILES / name))
    check_press(records)
    assert records[-1]["baseline"] == RECORDED[name]


def test_the_date_of_a_recording_is_printed(capsys):
    assert cli.main(["replay", str(FILES / "press.mcap"), "--model", "stsr-small-int8"]) == 0
    assert re.search(r"^recorded on 2026-\d\d-\d\d at \d\d:\d\d$", capsys.readouterr().err, re.MULTILINE)


@pytest.mark.parametrize("option", KEPT)
def test_baseline_and_sensor_file_zero_a_recording(option, tmp_path):
    flag, name = option
    # Its own baseline left out: the file's is used from the first scan.
    records = replayed(tmp_path, str(FILES / "press.npz"), flag, str(FILES / name))
    check_press(records)
    assert {record["baseline"] for record in records} == {KEPT[option]}
    assert {record["state"] for record in records} == {"idle", "baseline_in_doubt"}


def test_a_file_that_is_replaced_stays_and_the_user_reads_where(tmp_path, capsys):
    former = (FILES / "zero.json").read_bytes()
    zero, known = tmp_path / "zero.json", tmp_path / "sensor.toml"
    zero.write_bytes(former)
    known.write_bytes((FILES / "sensor.toml").read_bytes())
    recording = ("--source", f"replay:{FILES / 'press.npz'}")
    assert cli.main(["baseline", *recording, "--out", str(zero)]) == 0
    assert f"the former file is now {zero}.bak" in capsys.readouterr().out
    assert (tmp_path / "zero.json.bak").read_bytes() == former
    cli.main(["doctor", *recording, "--drift-s", "1.05", "--sensor", str(known), "--out", str(known)])
    assert f"the former file is now {known}.bak" in capsys.readouterr().out
    assert (tmp_path / "sensor.toml.bak").read_bytes() == (FILES / "sensor.toml").read_bytes()


GRIP = np.zeros((3, 4, 4))
GRIP[2] = np.linspace(400, 1100, 16).reshape(4, 4)
DRIFT = np.zeros((3, 4, 4))
DRIFT[2] = 560 + 90 * np.cos(np.arange(16)).reshape(4, 4)
DRIFT[0] = -110


def write_parts(path, *parts, seed=0):
    """Write a recording of (scans, counts over rest) parts, as the vendor's logger does, without times."""
    felt = np.array([felt + np.zeros((3, 4, 4)) for scans, felt in parts for _ in range(scans)])
    return write_recording(
        path, np.rint(REST + felt + np.random.default_rng(seed).normal(0, 2, felt.shape)).astype(int)
    )


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
    words = shlex.split(first.replace("OTHER", str(released)).replace("zero.json", str(folder / "zero.json")))
    done = run(*words)
    assert done.returncode == 0, done.stderr
    words = shlex.split(second.replace("zero.json", str(folder / "zero.json")))
    shown, _ = played(folder, *words[1:])
    assert {one["state"] for one in shown} == {"baseline_in_doubt"} and not any(one["trusted"] for one in shown)
    assert all(one["pattern"] is not None for one in shown)
    shown, _ = played(folder, released, "--rate-hz", "60")
    assert {one["state"] for one in shown[:89]} == {"contact"} and {one["state"] for one in shown[95:]} == {"idle"}


def test_the_age_of_a_recordings_baseline_is_unknown(folder):
    path = write_parts(folder / "left.csv", (120, 0))
    done = run("baseline", "--source", f"replay:{path}", "--rate-hz", "600", "--out", folder / "zero.json")
    assert done.returncode == 0, done.stderr
    assert json.loads((folder / "zero.json").read_text())["baselines"][0]["created_unix_s"] is None
    assert np.isnan(load_baselines(folder / "zero.json")["left"].created_unix_s)
    with open_recording(path, rate_hz=60) as source:
        assert np.isnan(take_baselines(source)["left"].created_unix_s)


def test_a_pad_that_only_recovers_gives_patterns(folder):
    falls = [(1, GRIP * share) for share in (0.8, 0.5, 0.2)]
    recovers = [(1, np.array([0, 0, 30.0 * (1 - n / 35)])[:, None, None]) for n in range(36)]
    path = write_parts(folder / "left.csv", *moving(20), *falls, *recovers)
    shown, stderr = played(folder, path, "--rate-hz", "60")
    assert {one["state"] for one in shown[:21]} == {"contact"} and {one["state"] for one in shown[26:]} == {"idle"}
    assert re.search(r"pressed least; it recovers there: a taxel may be off by \d+ counts", stderr)

"""Files that version 0.1.0 wrote, each used as a user of today would: a recording of 140 scans, its last 30 pressed.

The press is the same on every taxel, as no touch is: since this is noticed its baseline is in doubt, and its patterns
are still made. Its commands `baseline`, `doctor --out`, `--sink npz:` and `--sink mcap:` wrote them from one CSV file.
"""

import json
import re
from pathlib import Path

import pytest

from edge.cli import main as cli
from edge.cli.run_command import recorded_text

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


def test_the_age_of_a_recording_is_printed(capsys):
    assert cli.main(["replay", str(FILES / "press.mcap"), "--model", "stsr-small-int8"]) == 0
    assert re.search(r"^recorded on 2026-\d\d-\d\d at \d\d:\d\d, .* ago$", capsys.readouterr().err, re.MULTILINE)
    ages = {hours: recorded_text(1.79e9, 1.79e9 + 3600 * hours).partition(", ")[2] for hours in (0.5, 5, 47, 48, 8760)}
    assert list(ages.values()) == ["within the last hour", "5 h ago", "47 h ago", "2 days ago", "365 days ago"]


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
    known.write_text("[no sensor file")
    recording = ("--source", f"replay:{FILES / 'press.npz'}")
    assert cli.main(["baseline", *recording, "--out", str(zero), "--scans", "30"]) == 0
    assert f"the former file is now {zero}.bak" in capsys.readouterr().out
    assert (tmp_path / "zero.json.bak").read_bytes() == former
    cli.main(["doctor", *recording, "--drift-s", "1.05", "--out", str(known)])
    assert f"the former file is now {known}.bak" in capsys.readouterr().out
    assert (tmp_path / "sensor.toml.bak").read_text() == "[no sensor file"

"""`edge-sr` among faults: a short run keeps every promise, and the emulator logs its faults truly."""

import json
import os
import select
import signal
import subprocess
import sys
import time

import fault_sinks
import pytest
from bridge_samples import make_recording, write_recording
from edge_samples import ROOT
from fault_accounts import counted_at_the_end
from fault_emulator import FaultyEmulator
from fault_emulator import main as emulate
from fault_injector import Injector
from fault_judge import judge
from fault_page import promises
from fault_run import run_among_faults
from fault_stretches import parse_stretches
from fault_truth import ROW, Truth
from faults import main

from firmware_bridge.errors import LinkLostError
from firmware_bridge.links.slcan_serial import SlcanSerialLink

# The real thing.


def test_a_short_run_keeps_every_promise(tmp_path, monkeypatch):
    """All promises except those of time, as the load of this machine is unknown."""
    faults = (
        "lost@1+1,repeated@1+1,foreign@1.2+1,dead=4.3@1.5+.6,stuck=6.9@1.5+.7,garbage=.1@2.2+.5,truncated@2.3+.5,"
        "merged@2.4+.5,non-ascii@2.5+.5,reordered@2.6+.4,flipped@2.7+.3,bursts@3+.4,silent=6@3.2+.3,"
        "rename@3.8+.3,bus-off@5+.3,reset@5.6+.1,vanished=1@7.2+.3,vanished=1@8+60"
    )
    # Records without patterns fill the disk, too: patterns are most of a record, and a busy machine computes few.
    monkeypatch.setattr(fault_sinks, "ROOM_BYTES", 400_000)
    ran = run_among_faults(faults, 5, tmp_path)
    assert ran.told is not None
    found = judge(ran.seen, ran.told)
    kept = promises(ran, found, ran.told)
    # One promise is of time, which is never asserted.
    assert [promise for promise in kept if not promise.kept and "within" not in promise.text] == [], ran.said
    # A busy machine computes few patterns, but every scan in contact has a record.
    touching = sum(one.head["state"] in ("contact", "dropped") for one in ran.seen if one.counts is not None)
    assert found.records > 400 and touching > 200
    assert set(ran.told.accounts["begun"]) >= {"rename", "reset", "garbage", "bus-off"}
    assert {one.head["event"] for one in ran.seen if one.counts is None} >= {"back", "lost", "silent", "sink"}


def test_the_command_refuses_what_cannot_be(capsys):
    with pytest.raises(SystemExit):
        main(["0.1"])
    assert "expected .25 or more" in capsys.readouterr().err


def test_kill_9_leaves_whole_records(tmp_path):
    """All but the last line of a file of records are whole."""
    recording = write_recording(tmp_path / "played.csv", make_recording(200).tracks[0].counts, rate_hz=400)
    command = [sys.executable, "-m", "edge.cli.main", "--source", f"replay:{recording}", "--rate-hz", "400"]
    command += ["--sink", f"jsonl:{tmp_path}/out.jsonl", "--sink", f"mcap:{tmp_path}/out.mcap", "--sink", "jsonl:-"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, stdin=subprocess.DEVNULL, env=environment
    ) as process:
        assert process.stdout is not None
        shown = [json.loads(process.stdout.readline()) for _ in range(30 + os.getpid() % 50)]
        process.send_signal(signal.SIGKILL)
        shown += [json.loads(line) for line in process.stdout.read().split(b"\n")[:-1]]
    assert process.returncode == -signal.SIGKILL
    lines = (tmp_path / "out.jsonl").read_bytes().split(b"\n")[:-1]
    assert [json.loads(line)["scan"] for line in lines] == list(range(len(lines)))
    # Written before the last that was shown: sinks are served in their order.
    assert len(lines) >= len(shown) >= 30


# The emulator's part.


def spoilt(faults: str) -> Injector:
    return Injector(parse_stretches(faults), Truth())


def read_for(link: SlcanSerialLink, seconds: float) -> list:
    scans, end_s = [], time.monotonic() + seconds
    while time.monotonic() < end_s:
        scans += link.read(0.05)
    return scans


def until_lost(link: SlcanSerialLink) -> list:
    scans, end_s = [], time.monotonic() + 60
    with pytest.raises(LinkLostError):
        while time.monotonic() < end_s:
            scans += link.read(0.05)
    return scans


@pytest.mark.parametrize("fault", ["unplug", "rename"])
def test_the_cable_comes_out_and_back(tmp_path, fault):
    path = tmp_path / "usb-adapter"
    faults = spoilt(f"{fault}@.1+.2")
    with FaultyEmulator([make_recording(100)], loop=True, link=path, faults=faults) as emulator:
        assert emulator.port == str(path) and path.is_symlink()
        before = path.readlink()
        link = SlcanSerialLink(str(path))
        with link:
            first = until_lost(link)
        end_s = time.monotonic() + 60
        while not path.exists() and time.monotonic() < end_s:
            time.sleep(0.01)
        assert fault == "unplug" or path.readlink() != before
        with link:
            second = []
            while not second:
                second = link.read(1.0)
    assert first and all(scan.whole for scan in second)
    assert faults.truth.openings == 2 and faults.truth.fates["unheard"] > 0 == faults.truth.fates["overflow"]
    assert not path.exists()


def test_what_a_reset_cuts_off_is_no_bad_line(tmp_path):
    """A client that opens again has left before the adapter refuses to close."""
    faults = spoilt("merged=1@0+.1,reset@.1+.1")
    with FaultyEmulator([make_recording(100)], loop=True, faults=faults) as emulator:
        link = SlcanSerialLink(emulator.port)
        with link:
            read_for(link, 0.4)
            assert faults.truth.fates["merged"] > 0
        with link:
            read_for(link, 0.2)
            link.__exit__(None, None, None)
    counted = link.counters()
    counted["bad_lines"] += counted["non_ascii_lines"]
    told = faults.truth.counters()
    assert {name: counted[name] for name in told} == told and told["skipped_bytes"] > 0


def test_an_adapter_that_was_reset_is_silent_until_it_is_opened_again(tmp_path):
    faults = spoilt("reset@.1+.1")
    with FaultyEmulator([make_recording(100)], loop=True, faults=faults) as emulator:
        link = SlcanSerialLink(emulator.port)
        with link:
            read_for(link, 0.4)
            assert not emulator.adapter.channel_open
            assert link.read(0.05) == []
        with link:
            assert read_for(link, 0.2)
    assert faults.truth.openings == 2


def test_the_emulator_tells_the_truth_on_disk(tmp_path):
    recording = write_recording(tmp_path / "played.csv", make_recording(20).tracks[0].counts, rate_hz=100)
    command = [sys.executable, str(ROOT / "tests/system/fault_emulator.py"), "--faults", "lost=.5@0+1", "--seed", "3"]
    command += ["--truth", str(tmp_path / "truth"), "--link", str(tmp_path / "port"), str(recording)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, env=os.environ | {"PYTHONPATH": str(ROOT)}, text=True
    ) as process:
        assert process.stdout is not None and select.select([process.stdout], [], [], 20)[0]
        with SlcanSerialLink(process.stdout.readline().strip()) as link:
            until_lost(link)
            counted = link.counters()
    told = json.loads((tmp_path / "truth" / "accounts.json").read_text())
    assert told["counters"]["frames"] == counted["frames"] == told["fates"]["intact"]
    assert told["fates"]["intact"] + told["fates"]["lost"] == 320 and told["begun"] == {"lost": 1}
    assert len((tmp_path / "truth" / "frames.bin").read_bytes()) == 320 * ROW.itemsize


def test_the_emulator_refuses_faults_that_cannot_be(tmp_path, capsys):
    recording = write_recording(tmp_path / "played.csv", make_recording(20).tracks[0].counts, rate_hz=100)
    with pytest.raises(SystemExit):
        emulate(["--faults", "loss@1+1", str(recording)])
    assert "expected one of: lost" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        emulate(["--truth", str(tmp_path), "--buses", "2", str(recording), str(recording)])
    assert "--truth is of one bus, and --buses is 2" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        emulate(["--truth", "/proc/x", str(recording)])
    assert "/proc/x: cannot be written: No such file" in capsys.readouterr().err


def test_what_came_behind_the_last_record_is_in_the_summary():
    said = "EMULATED x: 5 scans\nreceived: frames 120, bad_lines 3, outages 1\nedge-sr: link lost\n"
    assert counted_at_the_end(said) == {"frames": 120, "bad_lines": 3, "outages": 1}
    assert counted_at_the_end("nothing") == {}
    assert counted_at_the_end("received: nothing\n") == {}

"""Whole program for a minute, or EDGE_SOAK_MINUTES; `make test` runs it next to the other tests.

Therefore nothing is asserted that these can do to it: no time, and of latency only that its quiet quarter has not
grown beyond what they may take.
"""

import json
import os
import subprocess
import sys
from dataclasses import replace

import hand_soak
import pytest
from edge_samples import ROOT
from soak import Window, evaluated

from edge.bench.program import Line

MINUTES = float(os.environ.get("EDGE_SOAK_MINUTES", "1"))

HAND_MINUTES = 0.1

STILL = [Window(5.0 * (n + 1), 78.0 + 0.1 * (n % 2), 1000.0 + 100 * (n % 3), 3, 9, 0) for n in range(12)]


@pytest.mark.soak
@pytest.mark.timeout(60 * MINUTES + 240)
def test_memory_stays_flat_and_latency_does_not_drift():
    command = [sys.executable, "tests/system/soak.py", str(MINUTES)]
    done = subprocess.run(
        command, cwd=ROOT, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["minutes"] >= 0.95 * MINUTES
    windows = found["windows"]
    assert found["memory_mb_per_minute"] - found["memory_half"] < 0.2, found
    assert max(window["resident_mb"] for window in windows) < 100
    assert found["latency_ratio"] < 5, found
    assert {(window["threads"], window["descriptors"]) for window in windows} == {
        (windows[0]["threads"], windows[0]["descriptors"])
    }
    assert windows[-1]["overruns"] == 0


def test_accounts_of_a_hand_among_faults_are_consistent():
    """Sixteen sensors on four buses; each scan is in a record or in a counter, each frame in a scan or in a counter."""
    found, accounts, counters = hand_soak.soak(HAND_MINUTES, 16, seed=1)
    assert accounts.broken == []
    assert len(accounts.records) == 16 and sum(accounts.records.values()) > 1000
    assert counters["frames"] > 16 * 1000 and max(window.resident_mb for window in found.windows) < hand_soak.MOST_MB
    assert counters["torn_wire"] + counters["outages"] + counters["duplicates"] > 0, "there were faults"


def counted(scan, **counters):
    names = (
        "unwritten",
        "overruns",
        "foreign",
        "missing_taxels",
        "duplicates",
        "abandoned",
        "unconfirmed",
        "resynchronised",
    )
    usual = {"scans": scan + 1, "readings": 16 * scan + 16, "frames": 16 * scan + 16} | dict.fromkeys(names, 0)
    return Line(0, {"sensor": "4", "scan": scan, "counters": usual | counters})


@pytest.mark.parametrize(
    ("lines", "what"),
    [
        ([counted(0), counted(1)], None),
        ([counted(0), counted(3, unwritten=2)], None),
        ([counted(0), counted(3, unwritten=1)], "left no trace"),
        ([counted(0), counted(0)], "came twice"),
        ([counted(0, frames=17)], "17 frames are not 16 readings"),
        ([counted(0, readings=70, frames=70)], "54 readings are of no scan"),
        ([counted(0, resynchronised=1)], "-1 readings are of no scan"),
    ],
)
def test_an_account_that_does_not_fit_is_seen(lines, what):
    accounts = hand_soak.Accounts(sensors=1)
    accounts.follow(lines)
    assert (what is None and accounts.broken == []) or what in accounts.broken[0]


def test_what_does_not_change_is_flat():
    found = evaluated(STILL)
    assert found.minutes == 1.0
    assert abs(found.memory_mb_per_minute) < found.memory_half < 0.2
    assert found.latency_ratio == pytest.approx(1.0, abs=0.1)


def test_a_leak_and_a_drift_are_seen_by_what_they_are():
    leaking = evaluated([replace(window, resident_mb=78.0 + 0.04 * n) for n, window in enumerate(STILL)])
    assert leaking.memory_mb_per_minute == pytest.approx(12 * 0.04)
    assert leaking.memory_half == pytest.approx(0.0, abs=1e-6)
    drifting = evaluated([replace(window, quiet_us=1000.0 * 1.1**n) for n, window in enumerate(STILL)])
    assert drifting.latency_ratio == pytest.approx(1.1**8)


def test_open_scans_of_sensors_without_a_record_yet_are_no_fault():
    """On a slow machine the first record comes while all sensors are read already."""
    accounts = hand_soak.Accounts(sensors=2)
    accounts.follow([counted(0, readings=16 + 20, frames=16 + 20)])
    assert accounts.broken == []

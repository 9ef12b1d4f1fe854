"""`edge-sr` among faults of the wire keeps its promises; and the survey of mutants."""

import os
import subprocess
import sys

import pytest
from bridge_samples import make_recording
from chaos import Chaos
from chaos_wire import NAMES, FaultyBus, numbered, stretches
from edge_samples import ROOT

from firmware_bridge.emulation.pty_port import EmulatorThread
from firmware_bridge.emulation.slcan_emulator import bus_timeline, controllers_of
from firmware_bridge.links.slcan_serial import SlcanSerialLink

SOAK_MINUTES = float(os.environ.get("EDGE_SOAK_MINUTES", "1"))
FAULTS = (
    "gaps@1+1.5,lost@1+1,repeated@1+1,foreign@1.2+1,dead@1.5+.6,garbage=.1@2.2+.5,truncated@2.3+.5,merged@2.4+.5,"
    "non-ascii@2.5+.5,reordered@2.6+.4,gaps@2.8+.4,bursts@3+.4,silent@3.2+.3,rename@3.8+.3,bus-off@5+.3,reset@5.6+.1,"
    "vanished=1@7.2+.3,gaps@7.6+1,unplug@9+.3"
)


def test_a_run_among_all_faults_keeps_every_promise():
    """Six sensors on two buses; nothing of time is asserted, as the load of this machine is unknown."""
    run = Chaos(6, seed=5, faults=FAULTS)
    assert run.play(11.0) == []
    assert set(run.faults) == set(NAMES) and set(run.judge.events) >= {"lost", "back"}
    # A busy machine computes few patterns, but every scan has a record.
    assert run.judge.records.total() > 1000 and run.judge.whole > 300 and run.judge.missing > 100
    assert run.judge.counters["frames"] > 16 * 1000


@pytest.mark.soak
@pytest.mark.timeout(60 * SOAK_MINUTES + 240)
def test_memory_stays_flat_and_latency_does_not_drift():
    """A minute without faults, or EDGE_SOAK_MINUTES, beside the other tests: no time is asserted but its growth."""
    run = Chaos(1, seed=1, faults="")
    assert run.play(60 * SOAK_MINUTES) == []
    slope, half = run.growth()
    assert slope - half < 0.3 and max(mb for _, mb, *_ in run.windows) < 100, run.windows
    assert run.latency_ratio() < 5 and len({held for _, _, held, _ in run.windows}) == 1, "threads and descriptors"


def test_a_recording_is_played_among_faults_for_your_own_program(tmp_path):
    recording = make_recording(100)
    frames = bus_timeline(controllers_of([recording], 400), loop=True)
    bus = FaultyBus(numbered(frames), stretches("lost=.5@0+60", 1), 1, tmp_path / "port")
    with EmulatorThread([bus]), SlcanSerialLink(str(tmp_path / "port")) as link:
        scans = []
        while len(scans) < 20:
            scans += link.read(0.1)
    assert not all(scan.whole for scan in scans) and bus.begun == {"lost": 1}


def test_a_survey_of_one_module_is_a_page():
    """python tests/system/mutation_survey.py slcan --mutants 1"""
    command = [sys.executable, "tests/system/mutation_survey.py", "slcan", "--mutants", "1"]
    page = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert page.startswith("# ") and "firmware_bridge.can.slcan" in page

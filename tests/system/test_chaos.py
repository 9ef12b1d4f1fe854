"""`edge-sr` among faults of the wire keeps its promises, and the judge sees where one is broken."""

import os

import pytest
from bridge_samples import make_recording
from chaos import Chaos, promises
from chaos_judge import HELD_CYCLES, Judge, telling
from chaos_wire import NAMES, FaultyBus, Sent, numbered, stretches

from firmware_bridge.can.slcan import CanFrame
from firmware_bridge.emulation.pty_port import EmulatorThread
from firmware_bridge.emulation.slcan_emulator import bus_timeline, controllers_of
from firmware_bridge.links.slcan_serial import SlcanSerialLink
from firmware_bridge.scans.can_id_maps import USPA44_MAP

SOAK_MINUTES = float(os.environ.get("EDGE_SOAK_MINUTES", "1"))
FAULTS = (
    "gaps@1+1.5,lost@1+1,repeated@1+1,foreign@1.2+1,dead@1.5+.6,garbage=.1@2.2+.5,truncated@2.3+.5,merged@2.4+.5,"
    "non-ascii@2.5+.5,reordered@2.6+.4,gaps@2.8+.4,bursts@3+.4,silent@3.2+.3,rename@3.8+.3,bus-off@5+.3,reset@5.6+.1,"
    "vanished=1@7.2+.3,gaps@7.6+1,unplug@9+.3"
)


def test_a_run_among_all_faults_keeps_every_promise():
    """Six sensors on two buses; nothing of time is asserted, as the load of this machine is unknown."""
    run = Chaos(6, seed=5, faults=FAULTS).play(11.0)
    assert promises(run, 0.2, 6) == []
    assert set(run.faults) == set(NAMES) and set(run.judge.events) >= {"lost", "back"}
    # A busy machine computes few patterns, but every scan has a record.
    assert run.judge.records.total() > 1000 and run.judge.whole > 300 and run.judge.missing > 100
    assert run.judge.counters["frames"] > 16 * 1000


@pytest.mark.soak
@pytest.mark.timeout(60 * SOAK_MINUTES + 240)
def test_memory_stays_flat_and_latency_does_not_drift():
    """A minute without faults, or EDGE_SOAK_MINUTES, beside the other tests: no time is asserted but its growth."""
    run = Chaos(1, seed=1, faults="").play(60 * SOAK_MINUTES)
    slope, half = run.growth()
    assert promises(run, SOAK_MINUTES, 1) == [] and slope - half < 0.3, run.windows
    assert max(mb for _, mb, *_ in run.windows) < 100 and run.latency_ratio() < 5
    assert len({held for _, _, held, _ in run.windows}) == 1, "threads and descriptors"


def judged(changes=lambda record: record, cycles=(3, 4)):
    """A judge that has seen two whole scans of a sensor in contact, the last of them changed."""
    judge, counts = Judge(), telling(0, touched=False)
    for cycle in range(40):
        for can_id, taxel in USPA44_MAP.wire_order("4"):
            words = b"".join(int(value).to_bytes(2, "big") for value in counts[cycle, taxel])
            judge.sent("", Sent(0.0, CanFrame(can_id, b"\0" + words + b"\0"), cycle), 10_000_000 * cycle)
    for number, cycle in enumerate(cycles):
        record = {"state": "contact", "sensor": "4", "scan": number, "fresh": 0xFFFF, "dead": {}, "note": None}
        record |= {"time_ns": 10_000_000 * cycle, "device_time_ns": 1, "latency_us": 1000.0}
        record |= {"counts": counts[cycle].T.reshape(3, 4, 4).tolist(), "counters": {"unwritten": 0, "overruns": 0}}
        judge.take(changes(record) if number else record)
    return judge


def with_taxel_of(cycle):
    def change(record):
        for axis, value in enumerate(telling(0, touched=False)[cycle, 5].tolist()):
            record["counts"][axis][1][1] = value
        return record

    return change


@pytest.mark.parametrize(
    ("changes", "cycles", "why"),
    [
        (lambda record: record, (3, 4), None),
        (with_taxel_of(7), (3, 8), "a whole scan of cycles [7, 8]"),
        (with_taxel_of(3), (3, 4), "taxel 5 has cycle 3 a second time"),
        (with_taxel_of(41), (3, 4), "which was never sent"),
        (lambda record: record | {"scan": 0}, (3, 4), "a number a second time"),
        (lambda record: record | {"scan": 3}, (3, 4), "2 scans before it left no trace"),
        (lambda record: record | {"scan": 3, "counters": {"unwritten": 2, "overruns": 0}}, (3, 4), None),
        (lambda record: record | {"fresh": 0xFFFF & ~32}, (3, 4 + HELD_CYCLES), "taxel 5 is held from cycle 3"),
        (lambda record: record | {"fresh": 0xFFFF & ~32, "dead": {"5": "silent"}}, (3, 4 + HELD_CYCLES), None),
        (lambda record: record | {"fresh": 0}, (3, 4), "a pattern without a fresh reading"),
        (lambda record: with_taxel_of(7)(record) | {"device_time_ns": None}, (3, 30), "a pattern of cycles 7 to 30"),
        (lambda record: record | {"latency_us": 2e5}, (3, 4), "ready 200 ms after its newest reading"),
        (lambda record: record | {"latency_us": 2e5, "note": "was 0.20 s old when it arrived"}, (3, 4), None),
    ],
)
def test_what_is_not_kept_is_seen(changes, cycles, why):
    broken = judged(changes, cycles).broken
    assert (not broken) if why is None else why in "; ".join(broken), broken


@pytest.mark.parametrize(
    ("counters", "why"),
    [
        ({}, None),
        ({"frames": 31, "readings": 31}, "31 of 32 handed frames are counted"),
        ({"readings": 31}, "32 frames are not 31 readings"),
        ({"duplicates": 16}, "-16 readings are of no scan and of no counter"),
        ({"missing_taxels": 1}, "counters say {'scans': 2, 'missing_taxels': 1}, records 2 and 0"),
    ],
)
def test_accounts_that_do_not_fit_are_seen(counters, why):
    judge, bus = judged(), FaultyBus([], [], 1)
    bus.handed, bus.over = 32, True
    told = {"frames": 32, "readings": 32, "scans": 2, "missing_taxels": 0} | counters
    judge.close([bus], f"received: {', '.join(f'{name} {number}' for name, number in told.items())}\n", ["4"])
    assert (not judge.broken) if why is None else why in "; ".join(judge.broken), judge.broken


def test_a_recording_is_played_among_faults_for_your_own_program(tmp_path):
    recording = make_recording(100)
    frames = bus_timeline(controllers_of([recording], 400), jitter_s=0.0, seed=1, loop=True)
    bus = FaultyBus(numbered(frames), stretches("lost=.5@0+60", 1), 1, tmp_path / "port")
    with EmulatorThread([bus]), SlcanSerialLink(str(tmp_path / "port")) as link:
        scans = []
        while len(scans) < 20:
            scans += link.read(0.1)
    assert not all(scan.whole for scan in scans) and bus.begun == {"lost": 1}


def test_a_mixture_holds_every_fault_and_ends_in_calm():
    found = stretches("mixed@5+100", seed=3)
    assert {one.name for one in found} == set(NAMES) and found[0].start_s >= 5
    assert max(one.end_s for one in found) <= 102
    assert found == stretches("mixed@5+100", seed=3) != stretches("mixed@5+100", seed=4)

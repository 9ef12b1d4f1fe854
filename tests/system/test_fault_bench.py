"""`edge-sr` among faults: that what is found is found, and, in a short run, that nothing is."""

import json
import math
import os
import select
import signal
import subprocess
import sys
import time

import numpy as np
import orjson
import pytest
from bridge_samples import make_recording, write_recording
from edge_samples import ROOT
from fault_accounts import CONSISTENT, DIFFERENT, EQUAL, accounts, counted_at_the_end
from fault_judge import judge
from fault_outages import seconds_to_use
from fault_page import promises, show, show_server, vanished_scans
from fault_played import telling_counts
from fault_records import Ran, Seen, Size, read_record
from fault_run import run_among_faults
from fault_server import ServerRan, judge_server
from faults import main

from edge.sinks.npz import gather
from firmware_bridge.emulation.fault_log import Told
from firmware_bridge.emulation.faults.injector import Injector
from firmware_bridge.emulation.faults.stretches import LINK_FAULTS, parse_stretches
from firmware_bridge.emulation.faults.truth import FATES, ROW, Truth
from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.errors import LinkLostError
from firmware_bridge.links.slcan_serial import SlcanSerialLink
from firmware_bridge.scans.can_id_maps import USPA44_MAP

PERIOD_NS = 10_000_000
COUNTERS = ("frames", "foreign", "bad_lines", "skipped_bytes", "duplicates")
ALL = 0xFFFF


class Forged:
    """A run of one sensor that went well, to be spoilt in one place."""

    def __init__(self, cycles: int = 20):
        counts = telling_counts(0)[:cycles].reshape(cycles, 3, 16)
        self.rows = np.zeros(16 * cycles, dtype=ROW)
        self.seen: list[Seen] = []
        self.events: list[dict] = []
        for cycle in range(cycles):
            for at, (can_id, taxel) in enumerate(USPA44_MAP.wire_order("4")):
                row = self.rows[16 * cycle + at]
                row["can_id"], row["cycle"], row["bus_us"] = can_id, cycle, 10_000 * cycle + 130 * at
                row["handed_ns"], row["xyz"] = PERIOD_NS * cycle + 130_000 * at, counts[cycle, :, taxel]
            self.seen.append(self.record(cycle, counts[cycle].T))

    def record(self, number: int, counts: np.ndarray, **changes) -> Seen:
        time_ns = PERIOD_NS * number + 2_000_000
        counters = dict.fromkeys(
            (*COUNTERS, "non_ascii_lines", "readings", "unconfirmed", "abandoned", "missing_taxels", "missed"), 0
        )
        counters |= {"frames": 16 * (number + 1), "readings": 16 * (number + 1), "scans": number + 1}
        head = {"sensor": "4", "scan": number, "time_ns": time_ns, "fresh": ALL, "renewed": ALL, "dead": {}}
        head["device_time_ns"] = time_ns - 1_000_000
        return Seen(time_ns + 1_000_000, head | {"counters": counters} | changes, counts.astype(np.int32), True)

    def change(self, number: int, **changes) -> None:
        """Say something else in the head of a record."""
        one = self.seen[number]
        self.seen[number] = one._replace(head=one.head | changes)

    @property
    def told(self) -> Told:
        fates = {FATES[fate]: int((self.rows["fate"] == fate).sum()) for fate in set(self.rows["fate"].tolist())}
        counters = dict.fromkeys(COUNTERS, 0) | {"frames": sum(fates.get(name, 0) for name in FATES[:6])}
        account = {"counters": counters, "fates": fates, "begun": {}, "noise": 0, "openings": 1}
        return Told(self.rows, self.events, account)

    def judged(self):
        return judge(self.seen, self.told)


def differing(found, forged: Forged) -> list[str]:
    return [book.name for book in accounts(found, forged.told) if book.verdict == DIFFERENT]


def test_a_good_run_is_found_good():
    forged = Forged()
    found = forged.judged()
    assert (found.records, found.patterns, found.whole_patterns, found.shown) == (20, 20, 20, 320)
    assert found.made_up == found.missing == found.unshown == found.open_at_end == 0 and not found.false_patterns
    assert (found.whole, found.mixed) == (20, [])
    assert {account.verdict for account in accounts(found, forged.told)} == {EQUAL}
    assert vanished_scans(found, forged.told) == 0
    assert max(found.spread_ms) == pytest.approx(15 * 0.13)


def test_a_reading_that_was_never_sent_is_found():
    forged = Forged()
    forged.seen[7].counts[3, 2] += 1
    found = forged.judged()
    assert found.made_up == 1 and "sensor 4, scan 7: taxel 3 reads" in found.false_patterns[0]
    assert differing(found, forged) == ["readings in no record"]


def test_a_reading_of_another_taxel_or_shown_twice_is_found():
    forged = Forged()
    forged.seen[7].counts[3] = forged.seen[7].counts[4]
    forged.seen[9].counts[:] = forged.seen[8].counts
    assert forged.judged().made_up == 17


def test_a_lost_frame_that_is_shown_all_the_same_is_found():
    forged = Forged()
    forged.rows["fate"][5 * 16 + 2] = FATES.index("lost")
    assert forged.judged().made_up == 1
    taxel = USPA44_MAP.taxels[int(forged.rows["can_id"][5 * 16 + 2])][1]
    forged.change(5, fresh=ALL & ~(1 << taxel), renewed=ALL & ~(1 << taxel))
    found = forged.judged()
    assert (found.made_up, found.missing, found.told_patterns, len(found.false_patterns)) == (0, 1, 1, 0)
    assert max(found.held_ms) == pytest.approx(10, abs=2)


def test_a_reading_that_is_held_for_too_long_is_found():
    forged = Forged(cycles=30)
    for number in range(5, 30):
        forged.change(number, fresh=ALL & ~2, renewed=ALL & ~2)
    found = forged.judged()
    assert len(found.false_patterns) == 30 - 19 and "taxel 1 is held for 152 ms" in found.false_patterns[0]
    for number in range(5, 30):
        forged.change(number, dead={"1": "silent"})
    assert not forged.judged().false_patterns


def test_readings_that_lie_apart_are_found():
    forged = Forged()
    forged.rows["bus_us"][10 * 16 + 8 :] += 150_000
    assert not forged.judged().false_patterns, "handed on at once: the emulator was late"
    forged.rows["handed_ns"][10 * 16 + 8 :] += 150_000_000
    found = forged.judged()
    assert len(found.false_patterns) == 1 and "scan 10: its readings are 15" in found.false_patterns[0]


def test_what_no_reader_can_know_is_counted_apart():
    forged = Forged()
    forged.rows["fate"][5 * 16 + 2] = FATES.index("flipped")
    forged.rows["fate"][6 * 16 + 2] = FATES.index("stuck")
    found = forged.judged()
    assert (found.flipped_patterns, found.stuck_patterns, len(found.false_patterns)) == (1, 1, 0)


@pytest.mark.parametrize("first", [5, 8])
def test_of_a_stuck_taxels_like_readings_one_that_an_outage_swallowed_is_not_told_from_the_next(first):
    """Cycle 8 is swallowed: one in which it is stuck already, or the last in which it is not."""
    forged = Forged()
    (place, taxel), *_ = ((at, taxel) for at, (_, taxel) in enumerate(USPA44_MAP.wire_order("4")) if taxel == 2)
    for cycle in range(first, 20):
        row = forged.rows[16 * cycle + place]
        row["xyz"] = forged.rows[16 * first + place]["xyz"]
        row["fate"] = FATES.index("stuck" if cycle > first else "intact")
        forged.seen[cycle].counts[taxel] = row["xyz"]
    del forged.seen[8]
    forged.rows["bus_us"][9 * 16 :] += 300_000
    forged.rows["handed_ns"][9 * 16 :] += 300_000_000
    found = forged.judged()
    assert not found.false_patterns and found.unshown == 16
    assert found.stuck_patterns == (20 - 9 if first == 8 else 20 - 6 - 1)
    forged.rows["fate"][9 * 16 + place] = forged.rows["fate"][10 * 16 + place] = FATES.index("intact")
    assert forged.judged().false_patterns, "a taxel that is not stuck sent the one or the other"


def test_a_record_that_is_missing_is_found():
    forged = Forged()
    del forged.seen[7]
    found = forged.judged()
    assert found.unshown == 16
    assert differing(found, forged) == ["readings in no record", "records of scans"]


def test_of_records_that_were_left_out_missing_taxels_alone_are_not_known():
    forged = Forged()
    lost = forged.rows[16 * 7 + 2 : 16 * 7 + 5]
    lost["fate"] = FATES.index("lost")
    counters = forged.seen[-1].head["counters"]
    counters |= {"unwritten": 1, "missing_taxels": 3, "frames": 317, "readings": 317}
    del forged.seen[7]
    books = {book.name: book for book in accounts(forged.judged(), forged.told)}
    consistent = [name for name, book in books.items() if book.verdict == CONSISTENT]
    assert consistent == ["taxels missing in records"] and differing(forged.judged(), forged) == []
    assert books[consistent[0]].tolerance == "-16 in records left out"
    assert (books["readings in no record"].told, books["readings in no record"].counted) == (13, 13)
    for missing in (2, 4, -1, 17):  # what is off by one is found in the readings, and what no record can hold at once
        counters["missing_taxels"] = missing
        assert "readings in no record" in differing(forged.judged(), forged)
    assert "taxels missing in records" in differing(forged.judged(), forged)
    counters["missing_taxels"] = 3
    del forged.seen[8]
    assert differing(forged.judged(), forged) == ["readings in no record", "records of scans"]


def test_a_line_that_was_left_out_may_be_an_event():
    forged = Forged()
    forged.seen[-1].head["counters"]["unwritten"] = 2
    del forged.seen[7]
    books = {book.name: book for book in accounts(forged.judged(), forged.told)}
    assert books["records of scans"].verdict == CONSISTENT and differing(forged.judged(), forged) == []
    assert books["records of scans"].tolerance == "+1 events left out"
    forged.seen[-1].head["counters"]["unwritten"] = 0
    forged.seen[-1].head["counters"]["scans"] = 18
    assert "records of scans" in differing(forged.judged(), forged)


def test_what_an_opening_dropped_while_the_injector_did_not_run_is_consistent():
    """Seen on a busy machine: 56 frames that the one had as read, and the other had dropped."""
    forged = Forged()
    counters = forged.seen[-1].head["counters"]
    counters |= {"frames": 304, "readings": 304, "scans": 19, "reopenings": 1, "skipped_bytes": 19}
    del forged.seen[7]
    struck = ["frames", "bytes of no frame", "readings", "readings in no record"]
    assert differing(forged.judged(), forged) == struck
    counters["dropped_bytes"] = 16 * 26 + 3
    books = accounts(forged.judged(), forged.told)
    assert [book.name for book in books if book.verdict == CONSISTENT] == struck and not differing(
        forged.judged(), forged
    )
    assert books[0].tolerance == "+16 dropped at openings"
    counters |= {"frames": 303, "readings": 303}
    assert differing(forged.judged(), forged) == ["frames", "readings"]


def mixing(first: int = 9, cycle: int = 12) -> Forged:
    """The last record mixes: its taxels, from the one at this place on, are of the cycle after."""
    forged = Forged()
    for _, taxel in USPA44_MAP.wire_order("4")[first:]:
        forged.seen[cycle].counts[taxel] = forged.seen[cycle + 1].counts[taxel]
    del forged.seen[cycle + 1 :]
    return forged


def test_a_whole_scan_of_two_cycles_is_found():
    found = mixing().judged()
    assert found.whole == 13 and found.made_up == 0 and not found.false_patterns
    assert len(found.mixed) == 1 and found.mixed[0].startswith("sensor 4, scan 12: cycle 12: taxels [")
    torn = mixing()
    torn.change(12, fresh=ALL & ~1, renewed=ALL & ~1)
    assert torn.judged().mixed == [], "it is not given as whole"


def test_whole_scans_whose_cycle_cannot_be_known_are_counted_apart():
    unstamped = mixing()
    unstamped.change(12, device_time_ns=None)
    found = unstamped.judged()
    assert (found.mixed, found.unstamped, found.unstamped_mixed) == ([], 1, 1)
    for fate in ("flipped", "stuck"):
        forged = mixing(first=15)
        forged.rows["fate"][16 * 13 + 15] = FATES.index(fate)
        found = forged.judged()
        counts = (found.flipped_whole, found.stuck_whole)
        assert found.mixed == [] and counts == ((1, 0) if fate == "flipped" else (0, 1))
        forged = mixing(first=14)  # the other one is of two cycles all the same
        forged.rows["fate"][16 * 13 + 15] = FATES.index(fate)
        assert len(forged.judged().mixed) == 1


def test_a_stuck_reading_that_was_repeated_or_held_back_too_tells_no_cycle():
    forged = Forged()
    places = [16 * cycle + 15 for cycle in range(9, 12)]
    forged.rows["xyz"][places] = forged.rows["xyz"][places[0]]
    forged.rows["fate"][places[1:]] = FATES.index("repeated")
    taxel = USPA44_MAP.wire_order("4")[15][1]
    for cycle in (10, 11):
        forged.seen[cycle].counts[taxel] = forged.seen[9].counts[taxel]
    del forged.seen[9]  # so that what is shown lags by one
    found = forged.judged()
    assert found.mixed == [] and found.stuck_whole == 2


def test_frames_counted_wrong_are_found():
    forged = Forged()
    forged.seen[-1].head["counters"]["bad_lines"] = 1
    assert differing(forged.judged(), forged) == ["lines that are no frame"]


def outage(name: str, begin_s: float, end_s: float) -> list[dict]:
    stretch = f"{name}@{begin_s}"
    return [
        {"time_ns": int(1e9 * time_s), "what": what, "fault": name, "stretch": stretch}
        for what, time_s in (("begin", begin_s), ("end", end_s))
    ]


def test_the_time_until_a_link_is_used_again():
    forged = Forged(cycles=200)
    for number in range(50, 120):  # handed on while it was out, and read much later
        forged.rows["handed_ns"][16 * number : 16 * number + 16] = 0
    forged.events = outage("unplug", 0.5, 1.0)
    assert seconds_to_use(forged.judged(), forged.told, ["unplug"]) == [pytest.approx(0.202)]
    assert seconds_to_use(forged.judged(), forged.told, ["rename"]) == []
    forged.events += outage("bus-off", 1.1, 1.15)
    assert seconds_to_use(forged.judged(), forged.told, ["unplug"]) == []
    forged.events = outage("reset", 1.0, 1.6)
    assert seconds_to_use(forged.judged(), forged.told, ["reset"]) == [pytest.approx(0.202)]


def test_a_link_that_never_comes_back_took_for_ever():
    forged = Forged()  # the last reading is handed on at .192 s
    never = outage("unplug", 0.3, 0.5)
    cases = [
        (never, [math.inf]),
        ([*never, *outage("vanished=1", 2.0, 2.3)], [math.inf]),  # the pause at the end, after the link was due
        ([*never, *outage("bus-off", 0.4, 0.9)], [math.inf]),  # it ended, and still nothing came
        ([*never, *outage("vanished=1", 0.7, 60)[:1]], []),  # silenced before the link was due
        ([*never, *outage("vanished=1", 1.6, 60)[:1]], [math.inf]),
        (never[:1], []),  # still out
        (outage("reset", 0.3, 0.4)[:1], [math.inf]),  # over at once
    ]
    for forged.events, times in cases:
        assert seconds_to_use(forged.judged(), forged.told, LINK_FAULTS) == times


def test_a_later_outage_excuses_no_wait_that_was_too_long():
    forged = Forged(cycles=300)
    forged.rows["handed_ns"][16 * 50 : 16 * 250] = 0
    forged.events = outage("unplug", 0.5, 1.0) + outage("bus-off", 2.1, 2.2)
    assert seconds_to_use(forged.judged(), forged.told, ["unplug"]) == [pytest.approx(1.502)]


def test_every_promise_can_be_broken():
    forged = Forged()
    forged.events = outage("reset", 0.05, 0.06)
    told = forged.told
    sizes = [Size(float(n), 70.0 + n, 5, 9 + n) for n in range(90)]
    steady = [Size(float(n), 70.0, 5, 9) for n in range(90)]
    said = "edge-sr: full.npz: File too large; the other sinks go on\n"
    good = Ran(exit_code=5, said=4 * said, seen=[*forged.seen], sizes=steady, told=told)
    assert all(promise.kept for promise in promises(good, judge(good.seen, told), told))
    assert show(good, judge(good.seen, told), told, lambda text: None)
    old = [forged.seen[1], forged.seen[0]]
    bad = Ran(
        exit_code=1,
        said=3 * said,
        seen=old,
        sizes=sizes,
        told=told,
        broken=["full.jsonl: line 3"],
        clock_steps_s=[3600, -7200],
    )
    bad.seen[-1].counts[0, 0] = 0
    bad.seen[0].counts[3] = forged.seen[2].counts[3]
    forged.events = outage("unplug", -2.0, -1.5)
    kept = [promise.kept for promise in promises(bad, judge(bad.seen, forged.told), forged.told)]
    assert kept == [False] * 10


def unkept(ran: Ran, told: Told) -> list[str]:
    return [promise.text.split(",")[0] for promise in promises(ran, judge(ran.seen, told), told) if not promise.kept]


def test_what_was_not_measured_is_not_kept():
    forged = Forged()
    said = 4 * "; the other sinks go on\n"
    ran = Ran(exit_code=5, said=said, seen=forged.seen, told=forged.told)
    assert unkept(ran, forged.told) == ["a link that is back"]
    forged.events = outage("reset", 0.05, 0.06)
    assert unkept(ran, forged.told) == []
    ran.seen = [one._replace(drawn=False) for one in forged.seen]
    assert unkept(ran, forged.told) == ["no pattern from stale or made-up readings without saying so"]
    for number in range(len(forged.seen)):
        forged.change(number, fresh=0, renewed=0)
    ran.seen = forged.seen
    assert "no reading is made up" in unkept(ran, forged.told)


@pytest.mark.parametrize("name", LINK_FAULTS)
def test_every_break_of_the_link_is_judged(name):
    forged = Forged(cycles=300)
    forged.rows["handed_ns"][16 * 50 : 16 * 250] = 0
    forged.events = outage(name, 0.5, 0.6)
    ran = Ran(exit_code=5, said=4 * "; the other sinks go on\n", seen=forged.seen, told=forged.told)
    assert unkept(ran, forged.told) == ["a link that is back"]


def served(**changes) -> ServerRan:
    counts = telling_counts(0)[:5].reshape(5, 3, 16).transpose(0, 2, 1)
    seen = [
        Seen(0, {"fresh": ALL, "time_ns": 1000 * cycle + 10, "counters": {}}, counts[cycle].copy(), True)
        for cycle in range(5)
    ]
    told_ns = {cycle: 1000 * cycle for cycle in range(5)}
    return ServerRan(**{"exit_code": 0, "seen": seen, "told_ns": told_ns, "down": [("killed", 900, 1500)]} | changes)


def test_a_server_run_is_judged_by_what_was_told():
    ran = served()
    found = judge_server(ran)
    assert (found.records, found.patterns, found.made_up, found.apart) == (5, 5, 0, 0)
    assert found.back_s == [pytest.approx(510e-9)]
    assert show_server(ran, found, lambda text: None)
    early = served(told_ns={cycle: 2000 * cycle for cycle in range(5)})
    assert judge_server(early).made_up == 16 * 4, "told before the server said it"
    ran.seen[2].counts[3, 0] += 1
    assert judge_server(ran).made_up == 1 and not show_server(ran, judge_server(ran), lambda text: None)
    apart = served(told_ns=dict.fromkeys(range(40), 0))
    apart.seen[4].counts[5] = telling_counts(0)[20].reshape(3, 16)[:, 5]
    assert judge_server(apart).apart == 1
    undrawn = [one._replace(drawn=False) for one in served().seen]
    for nothing, noes in ((served(seen=[], down=[]), 3), (served(seen=undrawn), 1), (served(down=[]), 1)):
        lines: list[str] = []
        assert not show_server(nothing, judge_server(nothing), lines.append)
        assert sum(text.endswith("| no |") for text in lines) == noes


def test_a_record_is_read_without_its_maps():
    line = orjson.dumps({"state": "idle", "counts": [[[1, None]] + [[0] * 7] * 2] * 3, "pattern": None, "deviation": 1})
    seen = read_record(line, 5)
    assert seen.counts is not None and seen.counts[:3].tolist() == [[1, 1, 1], [-1, -1, -1], [0, 0, 0]]
    assert seen.head == {"state": "idle"} and not seen.drawn and seen.read_ns == 5


# The real thing.


def test_a_short_run_keeps_every_promise(tmp_path):
    """Everything at once but time: what this machine does meanwhile, nobody knows."""
    faults = (
        "lost@1+1,repeated@1+1,foreign@1.2+1,dead=4.3@1.5+.6,stuck=6.9@1.5+.7,garbage=.1@2.2+.5,truncated@2.3+.5,"
        "merged@2.4+.5,non-ascii@2.5+.5,reordered@2.6+.4,flipped@2.7+.3,bursts@3+.4,silent=6@3.2+.3,"
        "rename@3.8+.3,bus-off@5+.3,reset@5.6+.1,vanished=1@7.2+.3,vanished=1@8+60"
    )
    ran = run_among_faults(faults, 5, tmp_path)
    assert ran.told is not None
    found = judge(ran.seen, ran.told)
    kept = promises(ran, found, ran.told)
    # One promise is of time, which is never asserted.
    assert [promise for promise in kept if not promise.kept and "within" not in promise.text] == [], ran.said
    assert found.records > 400 and found.patterns > 50
    assert set(ran.told.accounts["begun"]) >= {"rename", "reset", "garbage", "bus-off"}
    assert sorted({one.head["event"] for one in ran.seen if one.counts is None}) >= ["back", "lost", "silent", "sink"]


def test_the_command_refuses_what_cannot_be(capsys):
    with pytest.raises(SystemExit):
        main(["0.1"])
    assert "expected .25 or more" in capsys.readouterr().err


def test_kill_9_leaves_whole_records(tmp_path):
    """Of a file of records all but the last line, of an npz every row that was begun and ended."""
    recording = write_recording(tmp_path / "played.csv", make_recording(200).tracks[0].counts, rate_hz=400)
    command = [sys.executable, "-m", "edge.cli.main", "--source", f"replay:{recording}", "--rate-hz", "400"]
    command += ["--sink", f"jsonl:{tmp_path}/out.jsonl", "--sink", f"npz:{tmp_path}/out.npz", "--sink", "jsonl:-"]
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
    rows = gather(tmp_path / "out.npz")
    with np.load(tmp_path / "out.npz") as recorded:
        assert recorded["scan"].tolist() == list(range(rows))
    # Written before the last that was shown: sinks are served in their order.
    assert len(lines) >= len(shown) <= rows and len(shown) >= 30


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
    with Emulator([make_recording(100)], loop=True, link=path, faults=faults) as emulator:
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
    """Whoever opens anew has left before the adapter refuses to close."""
    faults = spoilt("merged=1@0+.1,reset@.1+.1")
    with Emulator([make_recording(100)], loop=True, faults=faults) as emulator:
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
    with Emulator([make_recording(100)], loop=True, faults=faults) as emulator:
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
    command = [sys.executable, "-m", "firmware_bridge.emulation.slcan_main", "--faults", "lost=.5@0+1", "--seed", "3"]
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
    from firmware_bridge.emulation.slcan_main import main as emulate

    recording = write_recording(tmp_path / "played.csv", make_recording(20).tracks[0].counts, rate_hz=100)
    with pytest.raises(SystemExit):
        emulate(["--faults", "loss@1+1", str(recording)])
    assert "expected one of: lost" in capsys.readouterr().err


def test_what_came_behind_the_last_record_is_in_the_summary():
    said = "EMULATED x: 5 scans\nreceived: frames 120, bad_lines 3, outages 1\nedge-sr: link lost\n"
    assert counted_at_the_end(said) == {"frames": 120, "bad_lines": 3, "outages": 1}
    assert counted_at_the_end("nothing") == {}
    assert counted_at_the_end("received: nothing\n") == {}

"""Evaluation of outages and of a server run."""

import math

import orjson
import pytest
from fault_forged import ALL, Forged, outage
from fault_judge import judge
from fault_log import Told
from fault_outages import seconds_to_use
from fault_page import promises, show, show_server
from fault_played import telling_counts
from fault_records import Ran, Seen, Size, read_record
from fault_server import ServerRan, judge_server
from fault_stretches import LINK_FAULTS


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
    said = "edge-sr: full.mcap: File too large; the other sinks continue\n"
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
    said = 4 * "; the other sinks continue\n"
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
    ran = Ran(exit_code=5, said=4 * "; the other sinks continue\n", seen=forged.seen, told=forged.told)
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

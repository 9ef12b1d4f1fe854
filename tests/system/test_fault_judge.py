"""Evaluation of records among faults: each break of a promise is detected."""

from dataclasses import replace

import pytest
from edge_samples import make_scan
from fault_accounts import CONSISTENT, EQUAL, accounts
from fault_forged import ALL, Forged, differing
from fault_page import vanished_scans
from fault_truth import FATES

from edge.perception.scan_notes import age_notes, waited_note
from firmware_bridge.scans.can_id_maps import USPA44_MAP


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


def test_a_reading_that_the_emulator_wrote_late_is_held_from_then_on():
    """The emulator looked at the clock, and then did not get the processor: no reader can know."""
    forged = Forged(cycles=30)
    for number in range(5, 30):
        forged.change(number, fresh=ALL & ~2, renewed=ALL & ~2)
    (at,) = (at for at, (_, taxel) in enumerate(USPA44_MAP.wire_order("4")) if taxel == 1)
    for cycle in range(5):
        forged.rows["written_ns"][16 * cycle + at] += 200_000_000
    assert not forged.judged().false_patterns


def test_a_reading_that_came_in_a_record_which_was_left_out_is_no_older_than_that():
    """The evaluation itself read too slowly for a while: what it missed, the program had received."""
    forged = Forged(cycles=60)
    torn = {"fresh": 0b1110, "renewed": 0b1110}
    forged.change(40, **torn)
    assert not forged.judged().false_patterns
    del forged.seen[10:40]
    found = forged.judged()
    assert found.left_out == 30 and not found.false_patterns and max(found.held_ms) < 20
    forged.change(10, scan=10)  # scan 40, after 9: nothing was left out
    found = forged.judged()
    assert len(found.false_patterns) == 1 and "scan 10: taxel 0 is held for 31" in found.false_patterns[0]
    forged.change(10, scan=40)
    forged.rows["fate"][16 * 15 : 16 * 40] = FATES.index("lost")  # nor can those records hold what never came
    assert "scan 40: taxel 0 is held for 26" in forged.judged().false_patterns[0]


def test_of_the_first_records_left_out_nothing_is_known_but_what_was_sent():
    forged = Forged()
    forged.change(5, fresh=ALL & ~2, renewed=ALL & ~2)
    del forged.seen[:5]
    assert not forged.judged().false_patterns
    forged.rows["fate"][: 16 * 5] = FATES.index("lost")
    assert "taxel 1 is held, but was never received" in forged.judged().false_patterns[0]


@pytest.mark.parametrize(
    ("note", "false"),
    [
        (None, 1),
        ("taxel 3 silent: estimated from its neighbours", 1),
        (waited_note(200_000_000).text, 0),
        (f"{waited_note(200_000_000).text}; drift", 0),
        (age_notes(replace(make_scan(0), device_ns=make_scan(0).time_ns - 200_000_000))[0].text, 0),
        (age_notes(replace(make_scan(0), unread_ns=200_000_000))[0].text, 0),
    ],
)
def test_a_pattern_that_was_ready_late_says_so(note, false):
    forged = Forged()
    forged.change(7, latency_us=145_000.0)
    assert not forged.judged().false_patterns
    forged.change(7, latency_us=200_000.0, note=note)
    found = forged.judged()
    assert len(found.false_patterns) == false and max(found.ready_ms) == pytest.approx(200, abs=2)
    forged.change(7, latency_us=1000.0)
    forged.seen[7] = forged.seen[7]._replace(
        head=forged.seen[7].head | {"time_ns": forged.seen[7].head["time_ns"] + 200_000_000}
    )
    assert len(forged.judged().false_patterns) == false, "it arrived late"


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
    """Cycle 8 is lost: one in which it is stuck already, or the last in which it is not."""
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
    assert (books["readings in no record"].injected, books["readings in no record"].counted) == (13, 13)
    for missing in (
        2,
        4,
        -1,
        17,
    ):  # a count that is off by one is detected in the readings, and so is what no record can hold at once
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
    """A busy machine once had 56 frames that the injector had as read, and the program had dropped."""
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
    """Return a run whose last record mixes: its taxels, from the one at this place on, are of the cycle after."""
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

"""Taxels without a reading: silent, late, held or at the end of their range."""

import dataclasses

import numpy as np
import pytest
from edge_samples import (
    BASELINE,
    PERIOD_NS,
    FakeModel,
    make_scan,
)
from runtime_samples import PRESS, make_runtime

from edge.perception.result import mask_bits
from edge.perception.taxel_health import BACK_SCANS, HOLD_SCANS, RANGE_ENDS, TAXEL_SILENT_SCANS


def test_a_taxel_silent_from_the_start_does_not_stop_the_others_from_being_zeroed_but_half_of_them_do():
    runtime = make_runtime(baselines=None)
    results = [runtime.push(make_scan(n, noise=4, absent=(0,))) for n in range(TAXEL_SILENT_SCANS + 100)]
    assert [result.state for result in results] == ["zeroing"] * (TAXEL_SILENT_SCANS + 98) + ["incomplete"] * 2
    baseline = results[-1].baseline
    assert baseline is not None
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(baseline.counts[2])), [0])
    back = [runtime.push(make_scan(500 + n, noise=4)) for n in range(2 * BACK_SCANS)][-1]
    assert (back.state, back.dead) == ("incomplete", {0: "unzeroed"})
    assert back.note == "no pattern, taxel 0 not zeroed: zero again"
    runtime = make_runtime(baselines=None)
    half = tuple(range(8))
    assert {runtime.push(make_scan(n, noise=4, absent=half)).state for n in range(400)} == {"zeroing"}


def test_an_absent_taxel_keeps_its_last_reading_for_a_while():
    runtime = make_runtime()
    runtime.push(make_scan(0, press_counts=PRESS))
    for number in range(1, HOLD_SCANS + 1):
        result = runtime.push(make_scan(number, press_counts=PRESS, absent=(5,)))
        assert result.state == "contact" and result.force_counts == PRESS
        assert mask_bits(result.scan.fresh) == 0xFFFF - (1 << 5)
    result = runtime.push(make_scan(9, press_counts=PRESS, absent=(5,)))
    assert result.state == "incomplete"
    assert result.pattern is result.contact is result.force_counts is None and result.baseline is BASELINE
    states = [runtime.push(make_scan(10 + n, press_counts=PRESS)).state for n in range(BACK_SCANS)]
    assert states == ["incomplete"] * (BACK_SCANS - 1) + ["contact"]


def test_the_held_reading_is_the_newest_not_the_first():
    runtime = make_runtime()
    for number, press in enumerate([2000, 4000]):
        runtime.push(make_scan(number, press_counts=press))
    assert runtime.push(make_scan(2, absent=(5,))).force_counts == 4000


@pytest.mark.parametrize("stamped", [True, False])
def test_a_reading_that_came_late_is_held_since_it_was_taken(stamped):
    """Readings that a delayed reader fetches together were not taken together."""
    runtime = make_runtime()
    runtime.push(make_scan(0, press_counts=PRESS))
    came_ns, late_ns = 50 * PERIOD_NS, 35 * PERIOD_NS
    late = make_scan(1, press_counts=PRESS, time_ns=came_ns)
    taken = {"device_ns": came_ns - late_ns} if stamped else {"unread_ns": late_ns}
    assert "old when it arrived" in runtime.push(dataclasses.replace(late, **taken)).note
    torn = make_scan(2, press_counts=PRESS, absent=(0, 1), time_ns=came_ns + PERIOD_NS)
    result = runtime.push(dataclasses.replace(torn, device_ns=torn.time_ns if stamped else None))
    assert result.pattern is None and result.dead == {0: "silent", 1: "silent"}


def test_a_taxel_never_heard_gives_no_pattern_ever():
    model = FakeModel()
    runtime = make_runtime(model)
    states = {runtime.push(make_scan(n, press_counts=PRESS, absent=(0,))).state for n in range(20)}
    assert states == {"incomplete"} and model.windows == []


@pytest.mark.parametrize(
    ("silent", "remedy"), [([8, 9, 10, 11, 12, 13, 14, 15], "try another --id-map"), ([5], "it may be broken")]
)
@pytest.mark.parametrize("baselines", [{}, {"4": BASELINE}])
def test_a_taxel_that_stays_silent_is_named(silent, remedy, baselines):
    runtime = make_runtime(baselines=baselines)
    notes = [runtime.push(make_scan(number, absent=tuple(silent))).note for number in range(TAXEL_SILENT_SCANS)]
    named = f"no pattern, taxel {', '.join(map(str, silent))} silent"
    assert notes[HOLD_SCANS - 1] is None and notes[HOLD_SCANS] == named
    assert notes[-1] == f"no pattern, taxel {', '.join(map(str, silent))} silent: {remedy}"
    for number in range(BACK_SCANS):
        back = runtime.push(make_scan(TAXEL_SILENT_SCANS + number))
    assert back.note is None


def saturated(number, counts, taxel=5):
    scan = make_scan(number, press_counts=PRESS)
    raw = scan.counts.copy()
    raw[2].flat[taxel] = counts
    return dataclasses.replace(scan, counts=raw)


@pytest.mark.parametrize("counts", RANGE_ENDS)
def test_a_chip_at_the_end_of_its_range_has_no_reading(counts):
    """The last reading is held for a while, as of a silent taxel; then there is no pattern, and the taxel is named."""
    runtime = make_runtime()
    pattern = runtime.push(make_scan(0, press_counts=PRESS)).pattern
    for number in range(1, HOLD_SCANS + 1):
        held = runtime.push(saturated(number, counts))
        np.testing.assert_array_equal(held.pattern, pattern)
        assert (
            held.notes[0].text
            == "its last reading is held, taxel 5 at the end of its range: overloaded, too near a magnet, or broken"
        )
    gone = runtime.push(saturated(HOLD_SCANS + 1, counts))
    assert (gone.state, gone.pattern, gone.contact) == ("incomplete", None, None)
    assert gone.note == "no pattern, taxel 5 at the end of its range: overloaded, too near a magnet, or broken"
    for number in range(BACK_SCANS):
        back = runtime.push(make_scan(HOLD_SCANS + 2 + number, press_counts=PRESS))
    assert back.state == "contact" and len(back.notes) == 1 and back.dead == {}


def test_a_count_from_the_end_is_a_reading():
    runtime = make_runtime()
    for number in range(HOLD_SCANS + 2):
        result = runtime.push(saturated(number, 65534))
    assert result.state == "contact"


def test_taxels_that_are_silent_are_named_beside_one_at_the_end_of_its_range():
    runtime = make_runtime()
    half = tuple(range(8, 16))
    for number in range(TAXEL_SILENT_SCANS):
        scan = make_scan(number, absent=half)
        raw = scan.counts.copy()
        raw[2].flat[5] = RANGE_ENDS[1]
        note = runtime.push(dataclasses.replace(scan, counts=raw)).note
    assert "taxel 5 at the end of its range" in note
    assert note.endswith("taxel 8, 9, 10, 11, 12, 13, 14, 15 silent: try another --id-map")

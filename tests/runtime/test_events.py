"""Events and notes: each of one of a closed set of kinds, from the runtime to the page and the docs."""

import re

import pytest
from edge_samples import BASELINE, ROOT, FakeModel, make_scan

from edge.perception.event import KINDS, NOTE_KINDS, Event, Note, joined
from edge.perception.runtime import Runtime
from firmware_bridge.silence import TAXEL_SILENT_SCANS as SILENT_SCANS

PAGE = [path for path in (ROOT / "edge" / "view").rglob("*") if path.suffix in (".html", ".js")]


def test_a_kind_that_is_not_in_the_list_is_refused():
    with pytest.raises(ValueError, match="'runtime', expected one of back, baseline_cleared, baseline_doubted"):
        Event(0, "runtime", None, "told")
    with pytest.raises(ValueError, match="note kind is 'old', expected one of baseline_in_doubt"):
        Note("old", "told")


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_every_kind_has_a_text_and_the_docs_name_it(kind):
    assert Event(0, kind, "4", "detail").text
    assert f"`{kind}`" in (ROOT / "docs" / "formats.md").read_text()


@pytest.mark.parametrize("kind", sorted(NOTE_KINDS))
def test_the_docs_name_every_kind_of_note(kind):
    assert f"`{kind}`" in (ROOT / "docs" / "live.md").read_text()


def test_the_page_goes_by_kinds_that_there_are():
    page = "".join(path.read_text() for path in PAGE)
    lists = re.findall(r"COUNTED = \[(.*?)\]|\[([^\]]*)\]\.includes\(event\)|event === (\"\w+\")", page)
    named = set(re.findall(r'"(\w+)"', str(lists)))
    assert {"refused", "in_contact", "rest_level", "lost"} <= named <= KINDS
    notes = set(re.findall(r"\(kind\) => kind !== \"(\w+)\"", page))
    assert notes and notes <= NOTE_KINDS


def test_a_result_has_what_happened_before_it_at_its_own_time_and_once():
    runtime = Runtime(FakeModel(), source="device", baselines={"4": BASELINE})
    runtime.zero()
    first = runtime.push(make_scan(0))
    assert [(event.kind, event.sensor) for event in first.events] == [("refused", None)]
    runtime.reset()
    runtime.zero("9")
    runtime.zero("4")
    runtime.lose_touch()
    scan = make_scan(3)
    result = runtime.push(scan)
    told = [("reset", None), ("refused", None), ("given_up", "4")]
    assert [(event.kind, event.sensor) for event in result.events] == told
    assert {event.time_ns for event in result.events} == {scan.time_ns}
    assert result.event == joined(result.events) == "; ".join(event.text for event in result.events)
    after = runtime.push(make_scan(4))
    assert after.events == () and after.event is None


def test_notes_are_kinds_beside_their_text():
    runtime = Runtime(FakeModel(), source="device", baselines={"6": BASELINE})
    result = runtime.push(make_scan(0, absent=(5,)))
    kinds = [note.kind for note in result.notes]
    assert kinds == ["no_stored_baseline"] and result.note == result.notes[0].text
    for number in range(1, SILENT_SCANS + 2):
        result = runtime.push(make_scan(number, absent=(5,)))
    assert result.notes[0].kind == "dead" and result.note == joined(result.notes)

"""Events and notes: each of one of a closed set of kinds, from the runtime to the page and the docs."""
# pyright: reportArgumentType=false

import re

import pytest
from edge_samples import ROOT
from runtime_samples import Pushed

from edge.perception.event import KINDS, NOTE_KINDS, Event, Note, joined

PAGE = [path for path in (ROOT / "edge" / "view").rglob("*") if path.suffix in (".html", ".js")]


def test_each_kind_has_a_text_and_a_place_in_the_docs():
    with pytest.raises(ValueError, match="'runtime', expected one of back, baseline_cleared, baseline_doubted"):
        Event(0, "runtime", None, "told")
    with pytest.raises(ValueError, match="note kind is 'old', expected one of baseline_in_doubt"):
        Note("old", "told")
    assert all(Event(0, kind, "4", "detail").text for kind in KINDS)
    for kinds, page in ((KINDS, "formats.md"), (NOTE_KINDS, "live.md")):
        text = (ROOT / "docs" / page).read_text()
        assert not {kind for kind in kinds if f"`{kind}`" not in text}


def test_the_page_goes_by_kinds_that_there_are():
    page = "".join(path.read_text() for path in PAGE)
    lists = re.findall(r"COUNTED = \[(.*?)\]|\[([^\]]*)\]\.includes\(event\)|event === (\"\w+\")", page)
    named = set(re.findall(r'"(\w+)"', str(lists)))
    assert {"refused", "in_contact", "rest_level", "lost"} <= named <= KINDS
    notes = set(re.findall(r"\(kind\) => kind !== \"(\w+)\"", page))
    assert notes and notes <= NOTE_KINDS


def test_a_result_has_once_what_happened_before_it():
    pad = Pushed()
    pad.runtime.zero()
    first = pad.push()
    assert [(event.kind, event.sensor) for event in first.events] == [("refused", None)]
    assert first.event == "zeroing refused: no scan has arrived yet"
    pad.runtime.reset()
    pad.runtime.zero("9")
    pad.runtime.zero("4")
    pad.runtime.lose_touch()
    result = pad.push()
    told = [("reset", None), ("refused", None), ("given_up", "4")]
    assert [(event.kind, event.sensor) for event in result.events] == told
    assert {event.time_ns for event in result.events} == {result.scan.time_ns}
    assert result.event == joined(result.events) == "; ".join(event.text for event in result.events)
    after = pad.push()
    assert after.events == () and after.event is None

"""Live page of patterns that are not to be believed, and of contacts that are too light to check."""

import re
from dataclasses import replace
from io import BytesIO
from itertools import count

import numpy as np
import pytest
from browser_samples import PERIOD_NS, browser, live, logged, number, open_page, part, playwright, word
from matplotlib.image import imread
from view_samples import CONTRACT, Press, live_page

from edge.perception.event import Event, Note

__all__ = ["browser", "open_page"]


def red_share(page):
    """Return the share of red in a picture of the pattern."""
    picture = imread(BytesIO(part(page, "field").screenshot()))
    return float(np.mean((picture[..., 0] > 0.55) & (picture[..., 0] > 2 * picture[..., 1])))


@pytest.mark.parametrize("viewport", [(1280, 800), (844, 390)])
def test_a_pattern_that_is_not_believed_cannot_be_taken_for_one_that_is(open_page, tmp_path, viewport):
    checked = replace(CONTRACT, trust={"made": "of something"})
    verdicts = {
        True: {"trusted": True, "mismatch": 0.021, "tap_mismatch": (0.0, 0.25)},
        False: {"trusted": False, "mismatch": 0.4, "untrusted_reason": "unfamiliar"},
        None: {"trusted": None},
    }
    with live_page(tmp_path, contract=checked) as shown:
        made, numbers, verdict = Press().next(), count(1), [True]

        def again():
            """Return the same contact; pressed for so long by one taxel alone, a sensor would not believe it."""
            again = next(numbers)
            scan = replace(made.scan, number=again, time_ns=again * PERIOD_NS)
            return replace(made, scan=scan, **verdicts[verdict[0]])

        shown.press.next = again
        with shown.playing():
            page = open_page(shown.view.url, viewport=dict(zip(("width", "height"), viewport, strict=True)))
            live(page)
            playwright.expect(number(page, "trusted")).to_have_text("yes")
            playwright.expect(number(page, "mismatch")).to_have_text("2.1\u202f%")
            playwright.expect(number(page, "tap_mismatch")).to_have_text("0.00, 0.25")
            playwright.expect(part(page, "verdict")).to_be_hidden()
            playwright.expect(number(page, "reused_from")).to_have_text("new")
            assert red_share(page) < 0.01
            verdict[0] = False
            word(page, "contact, not believed")
            playwright.expect(part(page, "verdict")).to_have_text(
                "not to be believed: readings like no contact (a magnet or steel near? the id map? the axes?)"
            )
            playwright.expect(part(page, "verdict")).to_be_in_viewport()
            playwright.expect(page.locator("#live")).to_have_text("sensor 4: contact, not believed")
            playwright.expect(number(page, "trusted")).to_have_text("no: unfamiliar")
            playwright.expect(number(page, "reused_from")).to_have_text("new")
            assert red_share(page) > 0.25
            page.keyboard.press("Space")
            word(page, "paused")
            assert red_share(page) > 0.25, "it stays what it was while it is looked at"
            page.keyboard.press("Space")
            verdict[0] = None
            playwright.expect(part(page, "verdict")).to_have_text(
                "too light to check whether the pattern is to be believed"
            )
            playwright.expect(number(page, "trusted")).to_have_text("too light to check")
            word(page, "contact")
            assert red_share(page) < 0.01
    with live_page(tmp_path) as shown, shown.playing():
        page = open_page(shown.view.url)
        live(page)
        playwright.expect(part(page, "verdict")).to_have_text("not checked: the model has no checks")
        playwright.expect(number(page, "trusted")).to_have_text(re.compile("not checked|\u2013"))


def test_while_the_baseline_is_in_doubt_the_pattern_is_grey_with_the_reason_and_the_key_on_it(open_page, tmp_path):
    doubt = {"state": "baseline_in_doubt", "contact": None, "trusted": False, "untrusted_reason": "baseline"}
    text = "baseline in doubt: most taxels are off it; free the pad and zero again"
    with live_page(tmp_path) as shown:
        made, numbers = Press().next(), count(1)

        def again():
            number = next(numbers)
            scan = replace(made.scan, number=number, time_ns=number * PERIOD_NS)
            return replace(made, scan=scan, notes=(Note("baseline_in_doubt", text),), area_mm2=None, **doubt)

        shown.press.next = again
        with shown.playing():
            page = open_page(shown.view.url)
            word(page, "baseline in doubt")
            playwright.expect(part(page, "stamp")).to_have_text(f"{text} (key z)")
            playwright.expect(part(page, "stamp")).to_be_visible()
            playwright.expect(part(page, "verdict")).to_be_hidden()
            playwright.expect(number(page, "trusted")).to_have_text("no: baseline")
            picture = imread(BytesIO(part(page, "field").screenshot()))[..., :3]
            assert np.ptp(picture, axis=2).max() < 0.1, "a colour"


def test_a_dropped_tap_is_told_as_an_event_and_a_suspected_sensor_in_red(open_page, tmp_path):
    with live_page(tmp_path) as shown:
        page = open_page(shown.view.url)
        for kind, detail in (
            ("tap_dropped", "the tap before does not belong to this contact, and is forgotten"),
            ("suspected", ""),
        ):
            for sink in shown.view.sinks:
                sink.tell(Event(0, kind, "4", detail), {})
        logged(page, "sensor 4: the tap before does not belong to this contact, and is forgotten")
        playwright.expect(page.locator("#log .bad")).to_have_text(
            re.compile("several contacts in a row read like none")
        )

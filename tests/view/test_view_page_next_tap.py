"""Live page of where to touch next: the number, and the pad's outline over the last pattern."""

from dataclasses import replace
from itertools import count

from browser_samples import PERIOD_NS, browser, number, open_page, part, playwright
from view_samples import Press, live_page

from edge.perception.result import NextTap

__all__ = ["browser", "open_page"]

ALPHA = """(canvas, [x, y]) =>
  canvas.getContext("2d").getImageData(Math.round(x * canvas.width) - 2, Math.round(y * canvas.height) - 2, 5, 5)
    .data.filter((_, index) => index % 4 === 3).reduce((sum, one) => sum + one, 0)"""
DRAWN = """([x, y]) => {
  const canvas = document.querySelector('[data-part="over"]');
  return canvas.getContext("2d").getImageData(x * canvas.width, y * canvas.height, 1, 1).data[3] > 0;
}"""
CENTRE, ACROSS = 0.5, 2.35 / 18.8


def drawn(page, x, y):
    return part(page, "over").evaluate(ALPHA, [x, y]) > 0


def test_the_pad_is_outlined_where_to_touch_next_until_the_next_tap(open_page, tmp_path):
    with live_page(tmp_path) as shown:
        press, numbers = Press(), count(3)
        idle, contact = press.next(0), press.next(3000)
        proposed: list[NextTap | str | None] = [None]

        def following():
            """Return one contact, or idle scans after it; pressed for so long, a sensor would not believe it."""
            again = next(numbers)
            made = contact if proposed[0] == "contact" else idle
            made = replace(made, scan=replace(made.scan, number=again, time_ns=again * PERIOD_NS))
            return replace(made, next_tap=proposed[0]) if isinstance(proposed[0], NextTap) else made

        shown.press.next = following
        with shown.playing():
            page = open_page(shown.view.url)
            for word, state in ((None, "idle"), ("contact", "contact"), (None, "idle")):
                proposed[0] = word
                playwright.expect(part(page, "word")).to_have_text(state)
            playwright.expect(number(page, "next_tap")).to_have_text("\u2013")
            # On the arrow, which begins at the centre, and on the outline's left edge and its upper one.
            arrow, left, upper = (CENTRE + ACROSS / 2, CENTRE + ACROSS / 2), (ACROSS, 0.6), (0.6, ACROSS)
            mirrored = (CENTRE - ACROSS / 2, CENTRE - ACROSS / 2)
            assert not drawn(page, *arrow)
            proposed[0] = NextTap(2.35, 2.35, 0.0)
            playwright.expect(number(page, "next_tap")).to_have_text("2.4\u202fmm right, 2.4\u202fmm down")
            page.wait_for_function(DRAWN, arg=list(arrow))
            edges = [any(drawn(page, x + step / 40, y) for step in range(4)) for x, y in (upper,)]
            edges += [any(drawn(page, x, y + step / 40) for step in range(4)) for x, y in (left,)]
            assert edges == [True, True] and not drawn(page, *mirrored)
            proposed[0] = NextTap(-2.35, -2.35, 0.0)
            playwright.expect(number(page, "next_tap")).to_contain_text("2.4\u202fmm left, 2.4\u202fmm up")
            page.wait_for_function(DRAWN, arg=list(mirrored))
            assert not drawn(page, *arrow)
            proposed[0] = "contact"
            playwright.expect(part(page, "word")).to_have_text("contact")
            playwright.expect(number(page, "next_tap")).to_have_text("\u2013")
            assert not drawn(page, *mirrored)

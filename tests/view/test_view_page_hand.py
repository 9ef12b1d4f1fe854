"""A hand on the live page: a grid of pads, of which one at a time is opened."""

import numpy as np
from browser_samples import (
    PHONE,
    RGBA,
    SIZES,
    browser,
    colours_of,
    demo,
    emulated,
    folder,
    live,
    noise,
    open_page,
    part,
    playwright,
    pressed,
    resize,
    then_held,
)

__all__ = ["browser", "demo", "folder", "open_page"]

HAND = ("4", "6", "8", "10")
INSIDE = """() => [...document.querySelectorAll(".pad")].map(one => one.getBoundingClientRect())
  .every(({left, top, right, bottom, width}) =>
    width >= 72 && left >= 0 && top >= 0 && right <= innerWidth && bottom <= innerHeight)"""


def test_four_pads_of_a_hand_are_opened_one_at_a_time(demo, folder, open_page):
    rest = demo["counts"][:1] + noise(200, seed=2)
    quiet = np.concatenate([rest[:150], np.full_like(rest[:1], -1).repeat(400, axis=0)])
    broken = rest.copy()
    broken[:, :, 1, 2] = 65_535
    with emulated(folder, then_held(demo, pressed(demo)[0]), broken, rest, quiet) as run:
        page = open_page(run.url)

        def pad(sensor):
            return page.locator(f'[data-pad="{sensor}"]')

        def opened():
            return page.eval_on_selector_all(".sensor:not([hidden])", "all => all.map(one => one.dataset.sensor)")

        def reads(sensor, yes):
            playwright.expect(pad(sensor).locator(".link")).to_have_attribute("data-up", yes)

        playwright.expect(pad("4")).to_have_attribute("data-state", "contact")
        playwright.expect(page.locator("#hand .pad")).to_have_count(4)
        assert page.eval_on_selector_all("#hand .pad", "all => all.map(one => one.dataset.pad)") == list(HAND)
        assert opened() == []
        for width, height in (PHONE, *SIZES):
            resize(page, width, height)
            page.wait_for_function(INSIDE)
        colours = colours_of(pad("4").locator("canvas").evaluate(RGBA)).reshape(-1, 4)
        assert len(np.unique(colours, axis=0)) > 20, "a pattern"
        pad("4").click()
        live(page)
        playwright.expect(part(page, "dead", "4")).to_be_hidden()
        assert opened() == ["4"]
        page.keyboard.press("]")
        assert opened() == ["6"] and pad("6").get_attribute("aria-pressed") == "true"
        playwright.expect(part(page, "dead", "6").filter(has_text="taxel 6 saturated")).to_be_visible()
        page.keyboard.press("[")
        page.keyboard.press("[")
        assert opened() == ["10"]
        playwright.expect(pad("10")).to_have_attribute("data-state", "silent")
        reads("10", "no")
        reads("8", "yes")
        page.keyboard.press("Escape")
        assert opened() == []
        run.emulator.hang_up()
        for sensor in HAND:
            reads(sensor, "no")

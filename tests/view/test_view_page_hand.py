"""A hand on the live page: a grid of pads, of which one at a time is opened."""

import numpy as np
from browser_samples import browser, demo, emulated, folder, live, noise, open_page, playwright, pressed, then_held

__all__ = ["browser", "demo", "folder", "open_page"]

SENSORS = ("4", "6", "8", "10")
SIZES = ((390, 844), (844, 390), (1024, 600), (1280, 800), (2560, 1300))
INSIDE = """all => all.map(one => one.getBoundingClientRect()).every(({left, top, right, bottom, width}) =>
  width >= 72 && left >= 0 && top >= 0 && right <= innerWidth && bottom <= innerHeight)"""

PIXELS = "one => [...one.getContext('2d').getImageData(0, 0, one.width, one.height).data]"


def pad(page, sensor):
    return page.locator(f'[data-pad="{sensor}"]')


def opened(page):
    return page.eval_on_selector_all(".sensor:not([hidden])", "all => all.map(one => one.dataset.sensor)")


def test_four_pads_are_small_fields_with_their_states_and_one_is_opened_at_a_time(demo, folder, open_page):
    rest = demo["counts"][:1] + noise(200, seed=2)
    quiet = np.concatenate([rest[:150], np.full_like(rest[:1], -1).repeat(400, axis=0)])
    with emulated(folder, then_held(demo, pressed(demo)[0]), rest, rest, quiet) as run:
        page = open_page(run.url)
        playwright.expect(pad(page, "4")).to_have_attribute("data-state", "contact")
        playwright.expect(page.locator("#hand .pad")).to_have_count(4)
        assert page.eval_on_selector_all("#hand .pad", "all => all.map(one => one.dataset.pad)") == list(SENSORS)
        assert opened(page) == []
        for width, height in SIZES:
            page.set_viewport_size({"width": width, "height": height})
            page.wait_for_function(f"() => ({INSIDE})([...document.querySelectorAll('.pad')])")
        seen = page.eval_on_selector('[data-pad="4"] canvas', PIXELS)
        assert len(set(zip(seen[::4], seen[1::4], strict=True))) > 20, "a pattern"
        pad(page, "4").click()
        live(page)
        assert opened(page) == ["4"]
        page.keyboard.press("]")
        assert opened(page) == ["6"] and pad(page, "6").get_attribute("aria-pressed") == "true"
        page.keyboard.press("[")
        page.keyboard.press("[")
        assert opened(page) == ["10"]
        playwright.expect(pad(page, "10")).to_have_attribute("data-state", "silent")
        playwright.expect(pad(page, "10").locator(".link")).to_have_attribute("data-up", "no")
        playwright.expect(pad(page, "8").locator(".link")).to_have_attribute("data-up", "yes")
        page.keyboard.press("Escape")
        assert opened(page) == []
        run.emulator.hang_up()
        for sensor in SENSORS:
            playwright.expect(pad(page, sensor).locator(".link")).to_have_attribute("data-up", "no")

"""Sensors on the live page: zeroing by hand, two sensors, dead taxels and a cable that is out."""

import json

from browser_samples import (
    TOKEN,
    browser,
    demo,
    emulated,
    folder,
    live,
    logged,
    noise,
    number,
    open_page,
    painted,
    part,
    playwright,
    pressed,
    resize,
    then_held,
    word,
)

__all__ = ["browser", "demo", "folder", "open_page"]

SIDES = """all => all.map(one => one.getBoundingClientRect())
  .map(({left, top, right, bottom}) => [left, top, right, bottom])"""


def sent_by(page):
    """Return a growing list of the messages that the page's next sockets send."""
    sent = []
    page.on("websocket", lambda socket: socket.on("framesent", lambda text: sent.append(json.loads(text))))
    return sent


def test_zero_by_button_and_by_key_with_a_token_that_is_not_left_in_the_address(demo, folder, open_page):
    with emulated(folder, demo["counts"][:100], options=["--view-token", TOKEN]) as run:
        assert TOKEN in run.url
        page = open_page(run.url)
        word(page, "idle")
        assert page.url == run.url.partition("?")[0]
        stored = number(page, "baseline").inner_text()
        page.locator("#zero").click()
        playwright.expect(number(page, "baseline")).not_to_have_text(stored)
        playwright.expect(number(page, "baseline_origin")).to_have_text("on demand")
        first = number(page, "baseline").inner_text()
        page.keyboard.press("z")
        playwright.expect(number(page, "baseline")).not_to_have_text(first)


def test_zero_in_contact_is_refused_and_forced_by_another_button_alone(demo, folder, open_page):
    with emulated(folder, then_held(demo, pressed(demo)[0])) as run:
        page = open_page(run.url)
        live(page)
        stored = number(page, "baseline").inner_text()
        playwright.expect(page.locator("#force")).to_be_hidden()
        page.keyboard.press("Shift+Z")  # nothing was refused yet
        page.keyboard.press("z")
        playwright.expect(page.locator("#refusal")).to_contain_text("sensor 4 is in contact")
        logged(page, "zeroing refused")
        page.keyboard.press("z")
        playwright.expect(page.locator("#force")).to_be_visible()
        assert number(page, "baseline").inner_text() == stored
        page.get_by_role("button", name="Zero despite contact").click()
        playwright.expect(page.locator("#refusal")).to_be_hidden()
        playwright.expect(number(page, "baseline")).not_to_have_text(stored)
        word(page, "idle")
        for pressed_key, text in (("s", "idle"), ("Space", "paused")):  # a pause makes no old pattern look new
            page.keyboard.press(pressed_key)
            word(page, text)
            playwright.expect(part(page, "field")).to_have_class("field old")
            playwright.expect(part(page, "stamp")).to_contain_text("last contact")


def test_who_asked_may_force_and_only_what_was_refused(demo, folder, open_page):
    with emulated(folder, then_held(demo, pressed(demo)[0]), demo["counts"][:1] + noise(200, seed=2)) as run:
        page, other = open_page(run.url), open_page(run.url)
        sent = sent_by(page)
        page.reload()
        for one in (page, other):
            live(one)
            word(one, "idle", "6")
        part(page, "zero", "6").click()
        part(other, "zero").click()
        playwright.expect(other.locator("#force")).to_be_visible()
        logged(page, "zeroing refused")
        playwright.expect(page.locator("#refusal")).to_contain_text("sensor 4 is in contact")
        playwright.expect(page.locator("#force")).to_be_hidden()
        page.keyboard.press("Shift+Z")
        page.keyboard.press("z")
        playwright.expect(page.locator("#force")).to_be_visible()
        playwright.expect(page.locator("#refusal")).not_to_contain_text("sensor 6")
        page.keyboard.press("Shift+Z")
        playwright.expect(number(page, "baseline_origin")).to_have_text("on demand")
        page.keyboard.press("Shift+Z")  # once
        page.keyboard.press("r")
        logged(other, "earlier taps forgotten")
        painted(page)  # after all that it has sent is known here
        assert sent == [
            {"cmd": "zero", "sensor": "6"},
            {"cmd": "zero"},
            {"cmd": "zero", "sensor": "4", "force": True},
            {"cmd": "reset"},
        ]


def test_two_sensors_a_dead_taxel_and_a_cable_that_is_out(demo, folder, open_page):
    counts = pressed(demo)[0]
    broken = then_held(demo, counts)
    broken[:, :, 1, 2] = 65_535
    with emulated(folder, then_held(demo, counts), broken) as run:
        page = open_page(run.url)
        live(page)
        live(page, "6")
        playwright.expect(part(page, "dead", "6").filter(has_text="taxel 6 saturated")).to_be_visible()
        playwright.expect(part(page, "dead", "4")).to_be_hidden()
        (left, top, right, _), (other_left, other_top, *_) = page.eval_on_selector_all(".sensor", SIDES)
        assert top == other_top and right < other_left
        resize(page, 390, 844)
        (left, _, _, bottom), (other_left, other_top, *_) = page.eval_on_selector_all(".sensor", SIDES)
        assert left == other_left and bottom < other_top
        run.emulator.hang_up()
        for sensor in "46":
            word(page, "no scan for", sensor)
            playwright.expect(part(page, "link", sensor)).to_contain_text("no scan for")
            playwright.expect(page.locator("#link")).to_contain_text("; no scan from ")
            playwright.expect(page.locator("#link")).to_have_attribute("data-up", "part")
            playwright.expect(part(page, "field", sensor)).to_have_attribute("data-live", "no")
        logged(page, "link lost")

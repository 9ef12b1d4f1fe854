"""The live page as a person sees it: headless Chromium, and a real `edge-sr` that reads emulated sensors."""

import json
import re

import browser_samples as web
import numpy as np
import pytest
from browser_samples import browser, demo, folder, open_page
from edge_samples import wait_for

__all__ = ["browser", "demo", "folder", "open_page"]

# Unknown to the page's own program, its newest socket is kept.
WATCH_SOCKETS = """
  const Socket = window.WebSocket;
  window.WebSocket = class extends Socket {
    constructor(...given) { super(...given); window.newest = this; }
  };
"""
TOLD = """text => [...document.querySelectorAll("#log li")]
  .filter((line) => line.textContent.includes(text))
  .reduce((sum, line) => sum + Number(line.dataset.times), 0)"""
WATCH_REFUSAL = """() => {
  window.refusals = 0;
  const watch = { attributeFilter: ["hidden"], childList: true, subtree: true };
  new MutationObserver(() => window.refusals++).observe(document.querySelector("#refusal"), watch);
}"""
AS_SHOWN = "canvas => Math.abs(canvas.width - canvas.clientWidth * devicePixelRatio) < 2"
SIDES = """all => all.map(one => one.getBoundingClientRect())
  .map(({left, top, right, bottom}) => [left, top, right, bottom])"""


@pytest.fixture(scope="module")
def held(demo, folder):
    """A run whose pad is pressed onto the demo's figure all the time, once it was seen free, and its pattern."""
    counts, pattern = web.pressed(demo)
    with web.emulated(folder, web.then_held(demo, counts)) as run:
        run.pattern = pattern
        yield run


def test_a_held_pad_is_shown_and_measured(held, open_page):
    page = open_page(held.url)
    web.live(page)
    web.word(page, "contact")

    # The pattern, on its own scale.
    scale = web.expect(web.part(page, "pattern-high"))
    scale.to_contain_text("largest so far")
    shown = web.shares(web.part(page, "pattern").evaluate(web.RGBA))
    assert shown.shape == (40, 40) and shown.max() > 0.9 and web.likeness(shown, held.pattern) > 0.99
    high_mm = float(web.part(page, "pattern-high").inner_text().partition("\u202f")[0])
    assert np.sqrt(np.mean((high_mm * shown - held.pattern) ** 2)) < 0.01  # [mm]

    # Maps, traces and numbers are there, and move.
    force = web.part(page, "force-now")
    web.expect(force).not_to_have_text(force.inner_text())
    for name in ("interval_mm", "run_time_us", "latency_us", "rate_hz"):
        web.expect(web.number(page, name)).to_contain_text(re.compile(r"[1-9]"))
    web.expect(page.locator("#about")).to_contain_text("stsr-int8")
    web.expect(web.number(page, "baseline_origin")).to_have_text("file")
    for name in ("shear", "force-plot", "area-plot", "over"):
        assert web.part(page, name).evaluate(web.PAINTED) > 50, name
    for name, shape in (("taxels", (4, 4)), ("deviation", (40, 40))):
        rgba = web.colours_of(web.part(page, name).evaluate(web.RGBA))
        assert rgba.shape[:2] == shape and len(np.unique(rgba.reshape(-1, 4), axis=0)) > 5

    # Shear is drawn in place of the area.
    toggle = web.part(page, "shear_toggle")
    for state in ("true", "false"):
        toggle.click()
        web.expect(toggle).to_have_attribute("aria-pressed", state)
        assert web.part(page, "area-plot").evaluate(web.PAINTED) > 50

    # The pointer reads a pixel, and numbers are explained.
    web.part(page, "field").hover()
    live_text = re.compile(r"x (\S+), y (\S+)\u202fmm: (\S+)\u202fmm \u00b1 (\S+)\u202fmm")
    # Shown with the next frame, which says "not live" or "no pattern" where this machine was busy.
    x, y, value, doubt = wait_for(lambda: live_text.fullmatch(web.part(page, "readout").inner_text())).groups()
    row, col = (round(float(one.replace("\u2212", "-")) / 0.47 + 19.5) for one in (y, x))  # of 40, 0.47 mm wide
    assert abs(float(value) - held.pattern[row, col]) < 0.05 and float(doubt) > 0
    page.mouse.move(5, 5)
    web.expect(web.part(page, "readout")).to_contain_text("hover")
    term = page.locator('[data-sensor="4"]').get_by_text("late", exact=True)
    web.expect(term).to_have_attribute("title", re.compile("later than one scan period"))

    # A keyboard is enough.
    page.keyboard.press("?")
    web.expect(page.locator("#manual")).to_be_visible()
    page.keyboard.press("Escape")
    web.expect(page.locator("#manual")).to_be_hidden()
    page.locator("#zero").focus()
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.id") == "reset"
    assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") == "solid"

    # Nothing runs over on any screen, and a phone reads by touch.
    for width, height in web.SIZES:
        web.fits(page, width, height)
    web.fits(page, *web.PHONE)
    assert web.part(page, "force-plot").evaluate(AS_SHOWN) and web.part(page, "force-plot").evaluate(web.PAINTED) > 50
    field = web.part(page, "field").bounding_box()
    assert field["width"] > 330 and field["y"] + field["height"] < page.locator("#keys").bounding_box()["y"]

    phone = dict(zip(("width", "height"), web.PHONE, strict=True))
    other = open_page(held.url, viewport=phone, has_touch=True, is_mobile=True)
    web.expect(page.locator("#link")).to_have_text("connected, 2 viewers")
    web.live(other)
    web.part(other, "readout").filter(has_text="tap the pattern").wait_for()
    box = web.part(other, "field").bounding_box()
    # By its place in the field, which moves on the page while lines above it come and go.
    web.part(other, "field").tap(position={"x": box["width"] / 4, "y": box["height"] / 4})
    web.expect(web.part(other, "readout")).to_have_text(re.compile("^x \u22124\\.\\d, y \u22124\\.\\d\\smm"))
    assert other.evaluate(web.RUNS_OVER) == 0


def test_a_reconnect_repeats_nothing(held, open_page):
    page, other = open_page(held.url, script=WATCH_SOCKETS), open_page(held.url)
    web.live(page)
    web.live(other)
    for times in (1, 2):
        other.keyboard.press("z")
        wait_for(lambda times=times: page.evaluate(TOLD, "zeroing refused") == times)
    web.expect(page.locator("#refusal")).to_be_hidden()
    page.evaluate(WATCH_REFUSAL)
    page.evaluate("newest.close()")
    web.logged(page, "connected again")
    other.keyboard.press("r")
    web.logged(page, "earlier taps forgotten")  # after all that a newcomer is sent
    assert page.evaluate(TOLD, "zeroing refused") == 2 and page.evaluate("refusals") == 0
    web.live(page)


def zero(page, sensor, ask):
    """Ask, and again where a busy machine left the sensor silent meanwhile, until there is a new baseline."""
    baseline = web.number(page, "baseline", sensor)
    before = baseline.inner_text()
    while baseline.inner_text() == before:
        given_up = page.evaluate(TOLD, "given up")
        ask()
        wait_for(lambda told=given_up: baseline.inner_text() != before or page.evaluate(TOLD, "given up") > told)


def test_two_sensors_are_zeroed_forced_and_lost(demo, folder, open_page):
    tracks = web.then_held(demo, web.pressed(demo)[0]), demo["counts"][:1] + web.noise(200, seed=2)
    with web.emulated(folder, *tracks, options=["--view-token", web.TOKEN]) as run:
        assert web.TOKEN in run.url
        page, other = open_page(run.url), open_page(run.url)
        assert page.url == run.url.partition("?")[0], "a token is not left in the address"
        sent = []
        page.on("websocket", lambda socket: socket.on("framesent", lambda text: sent.append(json.loads(text))))
        page.reload()
        for one in (page, other):
            web.live(one)
            web.word(one, "idle", "6")
        (left, top, right, _), (other_left, other_top, *_) = page.eval_on_selector_all(".sensor", SIDES)
        assert top == other_top and right < other_left

        # Each is zeroed by its button; where it is in contact this is refused, and offered to who asked alone.
        stored = web.number(page, "baseline").inner_text()
        web.expect(page.locator("#force")).to_be_hidden()
        page.keyboard.press("Shift+Z")  # nothing was refused yet
        zero(page, "6", web.part(page, "zero", "6").click)
        web.expect(web.number(page, "baseline_origin", "6")).to_have_text("on demand")
        assert sent[0] == {"cmd": "zero", "sensor": "6"}
        del sent[:]
        web.part(other, "zero").click()
        web.expect(other.locator("#force")).to_be_visible()
        web.logged(page, "zeroing refused")
        web.expect(page.locator("#refusal")).to_contain_text("sensor 4 is in contact")
        web.expect(page.locator("#force")).to_be_hidden()
        page.keyboard.press("Shift+Z")
        page.keyboard.press("z")
        web.expect(page.locator("#force")).to_be_visible()
        web.expect(page.locator("#refusal")).not_to_contain_text("sensor 6")
        assert web.number(page, "baseline").inner_text() == stored

        def force():
            if len(sent) < 2:
                page.keyboard.press("Shift+Z")
                other.get_by_role("button", name="Zero despite contact").click()
            else:
                page.locator("#zero").click()
                page.locator("#force").click()

        zero(page, "4", force)
        web.expect(other.locator("#refusal")).to_be_hidden()
        web.expect(page.locator("#refusal")).to_be_hidden()
        web.expect(web.number(page, "baseline_origin")).to_have_text("on demand")
        web.word(page, "idle")
        assert sent[:2] == [{"cmd": "zero"}, {"cmd": "zero", "sensor": "4", "force": True}]
        del sent[:]
        page.keyboard.press("Shift+Z")  # once
        page.keyboard.press("r")
        web.logged(other, "earlier taps forgotten")
        web.painted(page)  # after all that it has sent is known here
        assert sent == [{"cmd": "reset"}]

        web.expect(web.part(page, "field")).to_have_class("field old")
        web.expect(web.part(page, "stamp")).to_contain_text("last contact")

        # On a phone one is below the other; both are silent without their cable.
        web.resize(page, *web.PHONE)
        (left, _, _, bottom), (other_left, other_top, *_) = page.eval_on_selector_all(".sensor", SIDES)
        assert left == other_left and bottom < other_top
        run.emulator.hang_up()
        for sensor in "46":
            web.word(page, "no scan for", sensor)
            web.expect(web.part(page, "link", sensor)).to_contain_text("no scan for")
            web.expect(web.part(page, "field", sensor)).to_have_attribute("data-live", "no")
        web.expect(page.locator("#link")).to_contain_text("; no scan from ")
        web.expect(page.locator("#link")).to_have_attribute("data-up", "part")
        web.logged(page, "link lost")

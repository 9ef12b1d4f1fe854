"""The live page as a person sees it: headless Chromium with a real `edge-sr` that reads an emulated sensor."""

import os
import re
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from browser_samples import (
    PERIOD_NS,
    RGBA,
    browser,
    colours_of,
    demo,
    emulated,
    folder,
    likeness,
    live,
    logged,
    number,
    open_page,
    part,
    playwright,
    pressed,
    shares,
    then_held,
    word,
)
from edge_samples import make_pad_contract
from view_samples import Press, live_page, wait_for

from edge.perception.wrench import Wrench
from edge.sinks.binary_message import unpack
from edge.view.static_page import page_script
from firmware_bridge.recording.formats import load_recording

__all__ = ["browser", "demo", "folder", "open_page"]
RECONNECTS = 200
FIRST_RECONNECTS = 30
"""Reconnects after which all that is made once exists."""

# Unknown to the page's own program, its sockets are counted but not kept, and its waits are shortened.
WATCH_SOCKETS = """
  const Socket = window.WebSocket;
  window.sockets = [];
  window.newest = () => window.sockets.at(-1).deref();
  window.WebSocket = class extends Socket {
    constructor(...given) { super(...given); window.sockets.push(new WeakRef(this)); }
  };
  const wait = window.setTimeout;
  window.setTimeout = (act, ms, ...given) => wait(act, ms / 50, ...given);
"""


@pytest.fixture(scope="module")
def held(demo, folder):
    """A run whose pad is pressed onto the demo's figure all the time, once it was seen free, and its pattern."""
    counts, pattern = pressed(demo)
    with emulated(folder, then_held(demo, counts), options=["--view-record-dir", folder]) as run:
        run.pattern, run.folder = pattern, folder
        yield run


@pytest.fixture
def page(held, open_page):
    """A page that shows the run with the pad held."""
    page = open_page(held.url)
    live(page)
    return page


PAINTED = """canvas => canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height)
  .data.filter((value, at) => at % 4 === 3 && value).length"""

RESIZED = f"""async (canvas) => {{
  const before = canvas.width;
  canvas.closest(".sensor").style.width = "700px";
  await new Promise((go_on) => requestAnimationFrame(() => setTimeout(go_on, 0)));
  return [canvas.width !== before, ({PAINTED})(canvas) > 50];
}}"""
"""The next frame already has every canvas in its new size, and painted."""

INKED = """canvas => {
  const { data, width, height } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  const ink = getComputedStyle(document.documentElement).getPropertyValue("--force").trim();
  const want = [1, 3, 5].map((at) => parseInt(ink.slice(at, at + 2), 16));
  const near = (at) => data[at + 3] > 100 && want.every((value, channel) => Math.abs(data[at + channel] - value) < 12);
  return Array.from({ length: width }, (_, x) =>
    Array.from({ length: height }, (_, y) => 4 * (y * width + x)).some(near));
}"""
TOLD = """([text, times]) => times === [...document.querySelectorAll("#log li")]
  .filter((line) => line.textContent.includes(text))
  .reduce((sum, line) => sum + Number(line.dataset.times), 0)"""
WATCH_REFUSAL = """() => {
  window.refusals = 0;
  const watch = { attributeFilter: ["hidden"], childList: true, subtree: true };
  new MutationObserver(() => window.refusals++).observe(document.querySelector("#refusal"), watch);
}"""


def frames_of(page):
    """Return a growing list of the headers that the page's next sockets receive."""
    heard = []
    page.on("websocket", lambda socket: socket.on("framereceived", lambda data: heard.append(unpack(data)[0])))
    return heard


class TestHeld:
    def test_the_canvas_shows_the_pattern_on_the_models_scale_or_on_its_own(self, page, held):
        word(page, "contact")
        playwright.expect(part(page, "pattern-high")).to_contain_text("largest so far")
        page.keyboard.press("s")
        playwright.expect(part(page, "pattern-high")).to_contain_text("full scale")
        shown = shares(part(page, "pattern").evaluate(RGBA))
        assert shown.shape == (40, 40) and likeness(shown, held.pattern) > 0.99
        assert np.sqrt(np.mean((0.5 * shown - held.pattern) ** 2)) < 0.01  # [mm], of .5 full scale
        playwright.expect(part(page, "pattern-high")).to_contain_text("0.50\u202fmm, full scale")
        page.keyboard.press("s")
        playwright.expect(part(page, "pattern-high")).to_contain_text("largest so far")
        wait_for(lambda: shares(part(page, "pattern").evaluate(RGBA)).max() > 0.9)  # painted with the next frame
        stretched = shares(part(page, "pattern").evaluate(RGBA))
        assert shown.max() < 0.7 and likeness(stretched, held.pattern) > 0.99
        page.keyboard.press("s")
        page.reload()
        live(page)
        playwright.expect(part(page, "pattern-high")).to_contain_text("full scale")

    def test_maps_traces_and_numbers_are_there_and_move(self, page):
        before = part(page, "force-now").inner_text()
        playwright.expect(part(page, "force-now")).not_to_have_text(before)
        for name in ("interval_mm", "expected_rmse_mm", "run_time_us", "latency_us", "rate_hz"):
            playwright.expect(number(page, name)).to_contain_text(re.compile(r"[1-9]"))
        playwright.expect(number(page, "model")).to_have_text("stsr-int8")
        playwright.expect(number(page, "baseline_origin")).to_have_text("file")
        for name in ("shear", "force-plot", "area-plot", "over"):
            assert part(page, name).evaluate(PAINTED) > 50, name
        for name in ("taxels", "deviation"):
            rgba = colours_of(part(page, name).evaluate(RGBA))
            assert rgba.shape[:2] == ((4, 4) if name == "taxels" else (40, 40))
            assert len(np.unique(rgba.reshape(-1, 4), axis=0)) > 5
        assert part(page, "over").evaluate(RESIZED) == [True, True]

    def test_a_value_above_a_limit_is_marked_and_logged_once(self, page):
        limit = part(page, "force-limit")
        marked = page.locator(".traces > div[data-over=yes]")
        limit.fill("1000000")
        limit.press("e")  # no key of the page, as in any field
        limit.fill("10")
        limit.blur()
        playwright.expect(marked).to_have_count(1)
        logged(page, "force above the limit of 10")
        assert page.locator("dialog[open]").count() == 0
        before = part(page, "force-now").inner_text()
        playwright.expect(part(page, "force-now")).not_to_have_text(before)
        assert page.locator("#log li", has_text="above the limit").count() == 1
        page.reload()
        live(page)
        playwright.expect(marked).to_have_count(1)
        limit.fill("")
        limit.blur()
        playwright.expect(marked).to_have_count(0)

    def test_shear_is_drawn_in_place_of_the_area(self, page):
        heard = frames_of(page)
        page.reload()
        live(page)
        wait_for(lambda: any(point[4] is not None for header in heard for point in header.get("trace", [])))
        toggle, plot = part(page, "shear_toggle"), part(page, "area-plot")
        page.keyboard.press("Space")  # else it moves by itself
        word(page, "paused")
        images = [plot.evaluate("canvas => canvas.toDataURL()")]
        for state in ("true", "false"):
            toggle.click()
            playwright.expect(toggle).to_have_attribute("aria-pressed", state)
            images.append(plot.evaluate("canvas => canvas.toDataURL()"))
        assert images[0] == images[2] != images[1]
        page.keyboard.press("Space")

    def test_arrow_keys_read_a_pixel(self, page, held):
        part(page, "field").focus()
        page.keyboard.press("ArrowLeft")
        page.keyboard.press("Shift+ArrowDown")
        live_text = re.compile(r"x (\S+), y (2\.6)\u202fmm: (\S+)\u202fmm \u00b1 (\S+)\u202fmm")
        # Shown with the next frame, which says "not live" or "no pattern" where this machine made the program pause.
        x, y, value, doubt = wait_for(lambda: live_text.fullmatch(part(page, "readout").inner_text())).groups()
        assert (x.replace("\u2212", "-"), y) == ("-0.2", "2.6")  # pixel 19, 25 of 40, .47 mm wide
        assert abs(float(value) - held.pattern[25, 19]) < 0.02 and float(doubt) > 0
        playwright.expect(page.locator("#live")).to_contain_text("mm")
        page.keyboard.press("Escape")
        playwright.expect(part(page, "readout")).to_contain_text("arrow keys")

    def test_pause_freezes_this_page_alone_through_a_reconnect(self, held, open_page):
        page, other = open_page(held.url, script=WATCH_SOCKETS), open_page(held.url)
        heard = frames_of(page)
        page.reload()
        live(page)
        live(other)
        page.keyboard.press("Space")
        word(page, "paused")
        frozen = self.shown(page)
        before = part(other, "force-now").inner_text()
        playwright.expect(part(other, "force-now")).not_to_have_text(before)
        page.wait_for_timeout(1200)  # more than a hole that the trace would show
        self.reconnect(page, 1)
        self.ask(page, "is it held?")  # answered after the pause that the page asked for again
        del heard[:]
        before = part(other, "force-now").inner_text()
        playwright.expect(part(other, "force-now")).not_to_have_text(before)
        self.ask(page, "still?")
        assert [header["kind"] for header in heard if header["kind"] == "result"] == []
        assert frozen == self.shown(page)
        assert part(page, "field").get_attribute("data-live") == "no"
        playwright.expect(page.locator("#trouble")).to_contain_text("paused")
        page.locator("#pause").click()
        live(page)
        playwright.expect(part(page, "force-now")).not_to_have_text(frozen[-1])
        # A held pad draws a line: frames missed meanwhile leave no hole of 0.7 s in it, nor in the other page's.
        here, there = (max(np.diff(np.flatnonzero(part(one, "force-plot").evaluate(INKED)))) for one in (page, other))
        assert here < there + 0.07 * part(page, "force-plot").evaluate("canvas => canvas.width")

    def test_a_held_trace_stays_as_it_is_though_more_comes_for_its_last_point(self, page):
        source = page_script().decode()
        parts = r"^const (?:LONGEST_S|POINTS|STEP_S) .*\n|^class Trace \{\n(?:.*\n)*?\}\n"
        before, held, after = page.evaluate(
            f"""() => {{
              {"".join(re.findall(parts, source, re.MULTILINE))}
              const trace = new Trace();
              const shown = () => {{
                const points = [];
                trace.each("force_counts", 10, (seconds, value) => points.push([seconds, value]));
                return points;
              }};
              trace.add([[1, 5, 0, 0]]);
              trace.hold(true);
              const before = shown();
              trace.add([[1, 9, 0, 0], [1.001, 8, 0, 0], [1.5, 7, 0, 0]]);
              const held = shown();
              trace.hold(false);
              return [before, held, shown()];
            }}"""
        )
        assert before == held == [[1, 5]] and after == [[1, 5], [1.001, 8], [1.5, 7]]

    def test_a_reconnect_tells_nothing_twice(self, page, held, open_page):
        other = open_page(held.url, script=WATCH_SOCKETS)
        live(other)
        for times in (1, 2):
            page.keyboard.press("z")
            other.wait_for_function(TOLD, arg=["zeroing refused", times])
        playwright.expect(other.locator("#refusal")).to_be_hidden()
        other.evaluate(WATCH_REFUSAL)
        self.reconnect(other, 1)
        page.keyboard.press("r")
        logged(other, "earlier taps forgotten")  # after all that a newcomer is sent
        assert other.evaluate(TOLD, ["zeroing refused", 2])
        assert other.evaluate("refusals") == 0

    def test_a_recording_is_made_and_told_to_all_who_look(self, page, held, open_page):
        other = open_page(held.url)
        playwright.expect(other.locator("#link")).to_have_text("connected, 2 viewers")
        page.keyboard.press("Shift+R")
        playwright.expect(other.locator("#record")).to_have_attribute("aria-pressed", "true")
        logged(other, "recording into")
        playwright.expect(other.locator("#record")).to_contain_text(re.compile(r"Recording [1-9]\d*\ss, \d\.\d\sMB"))
        page.locator("#record").click()
        playwright.expect(other.locator("#record")).to_have_attribute("aria-pressed", "false")
        logged(page, "recorded into")
        text = page.locator("#log li").filter(has_text="recorded into").first.inner_text()
        path = Path(re.search(r"recorded into (\S+)", text)[1])
        assert path.parent == held.folder and len(load_recording(path).tracks[0].counts) >= 10

    def test_a_keyboard_is_enough(self, page):
        page.keyboard.press("?")
        playwright.expect(page.locator("#manual")).to_be_visible()
        page.keyboard.press("Escape")
        playwright.expect(page.locator("#manual")).to_be_hidden()
        playwright.expect(page.locator("#history")).to_be_visible()  # there is a past to look back on
        reached = []
        for _ in range(24):
            page.keyboard.press("Tab")
            reached.append(page.evaluate("document.activeElement.id || document.activeElement.dataset.part"))
        want = ["zero", "reset", "record", "pause", "scale", "relief", "save", "help", "back", "field", "span", "log"]
        assert [name for name in reached if name in want][: len(want)] == want
        page.locator("#scale").focus()
        assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") == "solid"
        before = page.locator("#scale").inner_text()
        page.keyboard.press("Space")  # presses the button that has the focus, and pauses nothing
        playwright.expect(page.locator("#scale")).not_to_have_text(before)
        word(page, "contact")

    def test_a_phone_scrolls_one_way(self, held, open_page):
        page = open_page(held.url, viewport={"width": 390, "height": 844})
        live(page)
        assert page.evaluate("document.documentElement.scrollWidth") == 390
        wide = "all => all.filter(one => one.offsetParent && one.getBoundingClientRect().right > 390.5).length"
        assert page.eval_on_selector_all("body *:not(.unseen)", wide) == 0
        assert all(box["height"] >= 40 for box in (one.bounding_box() for one in page.locator("#keys button").all()))
        field = part(page, "field").bounding_box()
        assert field["width"] > 330 and field["y"] + field["height"] < page.locator("#keys").bounding_box()["y"]

    def test_200_reconnects_leave_nothing(self, held, open_page):
        page = open_page(held.url, script=WATCH_SOCKETS, viewport={"width": 390, "height": 300})
        live(page)
        devtools = page.context.new_cdp_session(page)
        devtools.send("Performance.enable")
        self.reconnect(page, FIRST_RECONNECTS)
        before, files = self.kept(devtools), open_files(held)
        self.reconnect(page, RECONNECTS - FIRST_RECONNECTS)
        live(page)
        playwright.expect(page.locator("#link")).to_have_text("connected")
        after = self.kept(devtools)
        assert page.evaluate("sockets.length") == RECONNECTS + 1
        page.wait_for_function("gc(), sockets.filter((one) => one.deref() !== undefined).length <= 2")
        assert after["JSEventListeners"] <= before["JSEventListeners"] + 5
        assert after["Nodes"] <= before["Nodes"] + 50
        assert after["JSHeapUsedSize"] < before["JSHeapUsedSize"] + 1_000_000
        wait_for(lambda: open_files(held) <= files + 2)
        logged(page, "connected again")

    def reconnect(self, page, times):
        page.evaluate(
            """async (times) => {
              for (let time = 0; time < times; time++) {
                const before = window.sockets.length;
                window.newest().close();
                while (window.sockets.length === before) await new Promise((go_on) => setTimeout(go_on, 50));
                const heard = (go_on) => window.newest().addEventListener("message", go_on, { once: true });
                await new Promise(heard);
              }
            }""",
            times,
        )

    def shown(self, page):
        return [part(page, name).evaluate(RGBA) for name in ("pattern", "force-plot")] + [
            part(page, "force-now").inner_text()
        ]

    def ask(self, page, question):
        """Sends what is no command, and returns when the program has answered it."""
        page.evaluate("question => newest().send(question)", question)
        logged(page, question)

    def kept(self, devtools):
        """Return Chromium's counts after garbage collection: the least of a few, as frames come meanwhile."""
        counted = []
        for _ in range(4):
            devtools.send("HeapProfiler.collectGarbage")
            metrics = devtools.send("Performance.getMetrics")["metrics"]
            counted.append({metric["name"]: metric["value"] for metric in metrics})
        return {name: min(once[name] for once in counted) for name in counted[0]}


def open_files(run):
    return len(os.listdir(f"/proc/{run.pid}/fd"))  # noqa: PTH208


# Alpha of what is drawn over a pattern, at a share of its width and height.
OVER = """(canvas, [x, y]) =>
  canvas.getContext("2d").getImageData(Math.round(x * canvas.width), Math.round(y * canvas.height), 1, 1).data[3]"""


def test_force_and_torque_are_told_and_drawn_where_the_model_gives_them(open_page, tmp_path):
    contract = make_pad_contract(interval_factor=1.6)
    wrench = Wrench((0.3, 0.0, 0.4), (-0.94, 0.94, -1.25), (-2.35, -2.35))
    with live_page(tmp_path, contract=contract) as shown:
        made, numbers = replace(Press(contract=contract).next(), wrench=wrench), count(1)

        def again():
            """The same contact; pressed for so long by one taxel alone, a sensor would not believe it."""
            number = next(numbers)
            return replace(made, scan=replace(made.scan, number=number, time_ns=number * PERIOD_NS))

        shown.press.next = again
        with shown.playing():
            page = open_page(shown.view.url)
            live(page)
            for name, text in {
                "wrench_force": r"0\.30, 0\.00, 0\.40\sN",
                "wrench_torque": r"\u22120\.9, 0\.9\sN\smm",
                "wrench_twist": r"\u22121\.[23]\sN\smm",
                "centre_of_pressure_mm": r"\u22122\.[34], \u22122\.[34]\smm",
                "wrench_origin": "nominal",
            }.items():
                playwright.expect(number(page, name)).to_have_text(re.compile(f"^{text}$"))
            centre = 0.5 - 2.35 / 18.8
            over = part(page, "over")
            assert over.evaluate(OVER, [centre + 0.1, centre]), "the arrow of the shear, .24 of the width to the right"
            assert not over.evaluate(OVER, [centre - 0.1, centre]) and not over.evaluate(OVER, [centre + 0.3, centre])
    with live_page(tmp_path) as shown, shown.playing():
        page = open_page(shown.view.url)
        live(page)
        assert number(page, "wrench_force").count() == 0

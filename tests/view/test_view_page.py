"""The live page as a person sees it: headless Chromium before a real `edge-sr` that reads an emulated sensor."""

import contextlib
import importlib.util
import json
import os
import re
import shutil
import signal
import struct
import subprocess
import sys
import threading
from dataclasses import replace
from importlib import import_module
from itertools import count
from pathlib import Path
from queue import Empty, Queue

import numpy as np
import pytest
from edge_samples import ROOT, make_pad_contract
from view_samples import Press, live_page, wait_for
from websockets.sync.client import connect

from edge.inference.bundled import demo_recording
from edge.perception.wrench import Wrench
from edge.sinks.binary_message import unpack
from edge.terminal.heatmap import colours
from edge.terminal.progress_bar import Progress
from edge.view.server import MOST_VIEWERS
from edge.view.static_page import page_script
from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.geometry import USPA44
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.scans.scan import ScanSeries
from firmware_bridge.zeroing.baseline import BaselineEstimator, save_baselines

CHROMIUM = shutil.which("chromium")
if os.environ.get("EDGE_BROWSER") != "1":  # whoever says 1 has both, and that one is missing is no reason to skip
    if CHROMIUM is None:
        pytest.skip("no chromium here: apt-get install chromium", allow_module_level=True)
    pytest.importorskip("playwright.sync_api")
playwright = import_module("playwright.sync_api")

TIMEOUT_MS = 60_000
PERIOD_NS = 10_000_000
TOKEN = "of-twelve-letters"
RECONNECTS = 200
FIRST_RECONNECTS = 30
"""Until all that is made once is there."""
NOISE_COUNTS = 3
"""Of a pad that is pressed and held: a taxel that repeats itself would be taken for a stuck one."""

# What the page's own program is not told of: its sockets are counted and none is held, and its waits are shortened.
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
def browser():
    playwright.expect.set_options(timeout=TIMEOUT_MS)  # as all that is waited for: the machine may be busy
    with playwright.sync_playwright() as engine:
        chromium = engine.chromium.launch(executable_path=CHROMIUM, args=["--js-flags=--expose-gc"])
        yield chromium
        chromium.close()


@pytest.fixture
def open_page(browser):
    """Opens pages; in none of them may a request leave the server, or an error come."""
    asked, wrong, contexts = [], [], []

    def open_page(url, **settings):
        script = settings.pop("script", None)
        context = browser.new_context(**{"viewport": {"width": 1280, "height": 800}} | settings)
        contexts.append(context)
        context.set_default_timeout(TIMEOUT_MS)
        if script is not None:
            context.add_init_script(script)
        page = context.new_page()
        page.on("request", lambda request: asked.append(request.url))
        page.on("websocket", lambda socket: asked.append(socket.url))
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("console", lambda message: message.type == "error" and wrong.append(message.text))
        page.goto(url)
        return page

    yield open_page
    for context in contexts:
        context.close()
    strangers = [url for url in asked if not re.match(r"(http|ws)://127\.0\.0\.1:\d+/|data:", url)]
    assert asked and strangers == []
    # That nobody answers, or not as wanted, is Chromium's to tell, and what some of these tests are about.
    told = ("ERR_CONNECTION_REFUSED", "403 (Forbidden)", "Unexpected response code: 403", "503")
    assert [text for text in wrong if not any(words in text for words in told)] == []


@contextlib.contextmanager
def edge_sr(*arguments):
    """`edge-sr --view 0`, and the address that it tells."""
    process = subprocess.Popen(
        [sys.executable, "-m", "edge.cli.main", "--view", "0", *map(str, arguments)],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    lines: Queue[str] = Queue()
    reader = threading.Thread(target=lambda: [lines.put(line) for line in process.stderr])
    reader.start()
    try:
        said = []
        while True:
            try:
                said.append(lines.get(timeout=TIMEOUT_MS / 1000))
            except Empty:
                raise AssertionError(f"no address in {said}") from None
            if said[-1].startswith("live page: "):
                break
        process.url = said[-1].split(": ", 1)[1].strip()
        yield process
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        process.wait(timeout=TIMEOUT_MS / 1000)
        reader.join()
        process.stderr.close()


@pytest.fixture(scope="module")
def demo():
    with np.load(demo_recording()) as data:
        return dict(data)


@pytest.fixture(scope="module")
def folder(demo, tmp_path_factory):
    """With stored baselines of the demo's sensor under two names."""
    folder = tmp_path_factory.mktemp("view")
    save_baselines(folder / "zero.json", [zeroed(demo, sensor) for sensor in ("4", "6")])
    return folder


def zeroed(demo, sensor):
    scans, taken = ScanSeries(sensor, USPA44), BaselineEstimator()
    for number, counts in enumerate(demo["counts"]):
        baseline = taken.push(scans.close(counts.astype(np.int32), number * PERIOD_NS))
        if baseline is not None:
            return baseline
    raise AssertionError("the demo does not begin at rest")


@contextlib.contextmanager
def emulated(folder, *tracks, options=()):
    """A run on an emulated bus that plays counts (n, 3, 4, 4) of one or more sensors again and again."""
    recordings = []
    for counts in tracks:
        path = folder / f"{len(list(folder.glob('*.npz')))}.npz"
        facts = {"format": "tactile-recording", "version": 1, "sensor": ["4"] * len(counts)}
        times_ns = np.arange(len(counts)) * PERIOD_NS
        np.savez(path, **facts, scan=np.arange(len(counts)), time_ns=times_ns, counts=counts.astype(np.int32))
        recordings.append(load_recording(path))
    with Emulator(recordings, loop=True) as emulator:
        stored = ["--baseline", folder / "zero.json", "--model", "stsr-int8", "--every-scan"]
        with edge_sr("--source", f"slcan:{emulator.port}", *stored, *options) as run:
            run.emulator = emulator
            yield run


def noise(count, seed=1):
    return np.random.default_rng(seed).integers(-NOISE_COUNTS, NOISE_COUNTS + 1, (count, 3, 4, 4))


def pressed(demo):
    """Counts of the demo's first tap at its deepest, and the true pattern."""
    taps = np.flatnonzero(demo["tap"] == 0)
    peak = taps[np.argmax(demo["indentation_mm"][taps])]
    return demo["counts"][peak], demo["unit_patterns"][0].astype(float) * float(demo["indentation_mm"][peak])


@pytest.fixture(scope="module")
def held(demo, folder):
    """A run whose pad is pressed onto the demo's letter all the time, and the truth of it."""
    counts, truth = pressed(demo)
    with emulated(folder, counts + noise(200), options=["--view-record-dir", folder]) as run:
        run.truth, run.folder = truth, folder
        yield run


@pytest.fixture
def page(held, open_page):
    """A page that shows the run with the pad held."""
    page = open_page(held.url)
    live(page)
    return page


# What a person sees of a page.


def part(page, name, sensor="4"):
    return page.locator(f'[data-sensor="{sensor}"] [data-part="{name}"]')


def number(page, name, sensor="4"):
    return page.locator(f'[data-sensor="{sensor}"] [data-number="{name}"]')


def live(page, sensor="4"):
    page.wait_for_selector(f'[data-sensor="{sensor}"] [data-part="field"][data-live="yes"]')


def word(page, text, sensor="4"):
    playwright.expect(part(page, "word", sensor)).to_contain_text(text)


def logged(page, text):
    playwright.expect(page.locator("#log li").filter(has_text=text).first).to_be_visible()


PIXELS = """canvas => {
  const image = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  return [canvas.height, canvas.width, ...image.data];
}"""

SIDES = """all => all.map(one => one.getBoundingClientRect())
  .map(({left, top, right, bottom}) => [left, top, right, bottom])"""
PAINTED = """canvas => canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height)
  .data.filter((value, at) => at % 4 === 3 && value).length"""

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
    """Headers of what the page's next sockets hear, while they do."""
    heard = []
    page.on("websocket", lambda socket: socket.on("framereceived", lambda data: heard.append(unpack(data)[0])))
    return heard


def sent_by(page):
    """What the page's next sockets are sent."""
    sent = []
    page.on("websocket", lambda socket: socket.on("framesent", lambda text: sent.append(json.loads(text))))
    return sent


def shares(pixels):
    """Shares of the scale that colours on a canvas stand for, by the terminal's own table of the same colours."""
    height, width, *data = pixels
    rgba = np.array(data, dtype=float).reshape(height, width, 4)
    assert (rgba[..., 3] == 255).all()
    steps = np.linspace(0, 1, 256)
    return steps[np.abs(rgba[..., None, :3] - colours(steps)).sum(axis=-1).argmin(axis=-1)]


def likeness(shown, truth):
    return float(np.corrcoef(shown.ravel(), truth.ravel())[0, 1])


class TestDemo:
    # The deepest pattern of a tap, as it was painted, and all that the force read until the tap was over.
    FOLLOW = """() => {
      const seen = (window.seen ??= { forces: new Set(), deepest: 0, pixels: null });
      const card = document.querySelector(".sensor");
      if (card === null) return false;
      const text = (name) => card.querySelector(`[data-part="${name}"]`).textContent;
      seen.forces.add(text("force-now"));
      const most = parseFloat(text("pattern-most").replace("deepest ", ""));
      if (most > seen.deepest) {
        const canvas = card.querySelector('[data-part="pattern"]');
        const image = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
        [seen.deepest, seen.pixels] = [most, [canvas.height, canvas.width, ...image.data]];
      }
      return seen.forces.size > 20 && seen.deepest > 0.1 && text("word") === "idle";
    }"""

    def test_the_letter_is_seen_the_numbers_move_and_the_end_is_no_live_picture(self, open_page, demo):
        with edge_sr("--source", "demo:loop") as run:
            page = open_page(run.url)
            page.wait_for_function(self.FOLLOW)
            playwright.expect(page.locator("#origin").filter(has_text="EMULATED")).to_be_visible()
            assert page.title().startswith("EMULATED")
            shown = shares(page.evaluate("seen.pixels"))
            fits = [likeness(shown, truth.astype(float)) for truth in demo["unit_patterns"]]
            best = demo["unit_patterns"][int(np.argmax(fits))].astype(float)
            others = [best[::-1], best[:, ::-1], best.T, best[::-1].T]
            assert max(fits) > 0.95 and max(likeness(shown, turned) for turned in others) < 0.8, fits
            run.send_signal(signal.SIGINT)
            word(page, "run ended")
            playwright.expect(page.locator("#trouble")).to_contain_text(
                re.compile(r"^the run has ended \(.*\): what is shown is old; ")
            )
            assert part(page, "field").get_attribute("data-live") == "no"
            playwright.expect(part(page, "stamp")).to_contain_text("last contact")
            page.keyboard.press("r")
            logged(page, "not done: there is no connection")
            assert page.locator("#log").get_by_text("earlier taps forgotten").count() == 0

    def test_the_next_run_is_found_and_nothing_of_the_one_before_kept(self, open_page):
        with edge_sr("--source", "demo:loop", "--view-token", TOKEN) as run:
            page = open_page(run.url)
            page.wait_for_selector(".sensor")
            page.eval_on_selector(".sensor", "card => { card.id = 'first'; }")
            page.keyboard.press("Space")
        port = re.search(r":(\d+)/", run.url)[1]
        with edge_sr("--source", "demo:loop", "--view", port, "--view-token", TOKEN):
            logged(page, "another run has begun")
            page.wait_for_selector(".sensor:not(#first)")
            assert page.locator("#first").count() == 0
            playwright.expect(page.locator("#pause")).to_have_attribute("aria-pressed", "false")

    def test_why_nobody_is_let_in_is_told(self, open_page):
        with edge_sr("--source", "demo:loop", "--view-token", TOKEN) as run, contextlib.ExitStack() as full:
            page = open_page(run.url.replace(TOKEN, "another-one-of-it"))
            trouble = page.locator("#trouble")
            playwright.expect(trouble).to_contain_text("the token is missing or wrong: open the address that edge-sr")
            for _ in range(MOST_VIEWERS):
                socket = full.enter_context(connect(f"ws{run.url[4:].replace('?', 'ws?')}", max_queue=None))
                socket.send('{"cmd": "pause", "on": true}')
            page.goto(run.url)
            playwright.expect(trouble).to_contain_text(f"{MOST_VIEWERS} look already")
            socket.close()
            page.wait_for_selector(".sensor")
            playwright.expect(trouble).to_be_hidden()


class TestHeld:
    def test_the_canvas_shows_the_truth_on_the_models_scale_or_on_its_own(self, page, held):
        word(page, "contact")
        shown = shares(part(page, "pattern").evaluate(PIXELS))
        assert shown.shape == (40, 40) and likeness(shown, held.truth) > 0.95
        assert np.sqrt(np.mean((0.5 * shown - held.truth) ** 2)) < 0.03  # [mm], of .5 full scale
        playwright.expect(part(page, "pattern-high")).to_contain_text("0.50\u202fmm, full scale")
        page.keyboard.press("s")
        playwright.expect(part(page, "pattern-high")).to_contain_text("largest so far")
        wait_for(lambda: shares(part(page, "pattern").evaluate(PIXELS)).max() > 0.9)  # painted with the next frame
        stretched = shares(part(page, "pattern").evaluate(PIXELS))
        assert shown.max() < 0.7 and likeness(stretched, held.truth) > 0.95
        page.reload()
        live(page)
        playwright.expect(part(page, "pattern-high")).to_contain_text("largest so far")

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
            height, width, *data = part(page, name).evaluate(PIXELS)
            assert (height, width) == ((4, 4) if name == "taxels" else (40, 40))
            assert len({tuple(data[at : at + 3]) for at in range(0, len(data), 4)}) > 5

    def test_arrow_keys_read_a_pixel(self, page, held):
        part(page, "field").focus()
        page.keyboard.press("ArrowLeft")
        page.keyboard.press("Shift+ArrowDown")
        playwright.expect(part(page, "readout")).to_contain_text(", y 2.6")  # said with the next frame
        text = part(page, "readout").inner_text()
        x, y, value, doubt = re.fullmatch(
            r"x (\S+), y (\S+)\u202fmm: (\S+)\u202fmm \u00b1 (\S+)\u202fmm", text
        ).groups()
        assert (x.replace("\u2212", "-"), y) == ("-0.2", "2.6")  # pixel 19, 25 of 40, .47 mm wide
        assert abs(float(value) - held.truth[25, 19]) < 0.1 and float(doubt) > 0
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
        page.wait_for_timeout(1200)
        self.reconnect(page, 1)
        self.ask(page, "is it held?")  # answered behind the pause that the page asked for again
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
        # A pad that is held draws a line: what was missed meanwhile is no hole of .7 s in it, as none is for the other.
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
        logged(other, "earlier taps forgotten")  # behind all that is told to a newcomer
        assert other.evaluate(TOLD, ["zeroing refused", 2])
        assert other.evaluate("refusals") == 0

    def test_a_recording_is_made_and_told_to_all_who_look(self, page, held, open_page):
        other = open_page(held.url)
        playwright.expect(other.locator("#link")).to_have_text("connected, 2 viewers")
        page.keyboard.press("Shift+R")
        playwright.expect(other.locator("#record")).to_have_attribute("aria-pressed", "true")
        logged(other, "recording into")
        page.wait_for_timeout(1000)
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
        reached = []
        for _ in range(12):
            page.keyboard.press("Tab")
            reached.append(page.evaluate("document.activeElement.id || document.activeElement.dataset.part"))
        want = ["zero", "reset", "record", "pause", "scale", "help", "field", "span", "log"]
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
        assert page.evaluate("sockets.filter((one) => one.deref() !== undefined).length") <= 2
        assert after["JSEventListeners"] <= before["JSEventListeners"] + 5
        assert after["Nodes"] <= before["Nodes"] + 50
        assert after["JSHeapUsedSize"] < before["JSHeapUsedSize"] + 1_000_000
        assert open_files(held) <= files + 2
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
        return [part(page, name).evaluate(PIXELS) for name in ("pattern", "force-plot")] + [
            part(page, "force-now").inner_text()
        ]

    def ask(self, page, question):
        """Sends what is no command, and returns when the program has answered it."""
        page.evaluate("question => newest().send(question)", question)
        logged(page, question)

    def kept(self, devtools):
        """What Chromium counts, after collecting what nobody holds; frames come meanwhile, so the least of a few."""
        counted = []
        for _ in range(4):
            devtools.send("HeapProfiler.collectGarbage")
            metrics = devtools.send("Performance.getMetrics")["metrics"]
            counted.append({metric["name"]: metric["value"] for metric in metrics})
        return {name: min(once[name] for once in counted) for name in counted[0]}


def open_files(run):
    return len(os.listdir(f"/proc/{run.pid}/fd"))  # noqa: PTH208


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
    with emulated(folder, pressed(demo)[0] + noise(200)) as run:
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
    with emulated(folder, pressed(demo)[0] + noise(200), demo["counts"][:1] + noise(200, seed=2)) as run:
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
        assert sent == [
            {"cmd": "zero", "sensor": "6"},
            {"cmd": "zero"},
            {"cmd": "zero", "sensor": "4", "force": True},
            {"cmd": "reset"},
        ]


def test_two_sensors_a_dead_taxel_and_a_cable_that_is_out(demo, folder, open_page):
    counts = pressed(demo)[0]
    broken = counts + noise(200, seed=2)
    broken[:, :, 1, 2] = 65_535
    with emulated(folder, counts + noise(200), broken) as run:
        page = open_page(run.url)
        live(page)
        live(page, "6")
        playwright.expect(part(page, "dead", "6").filter(has_text="taxel 6 saturated")).to_be_visible()
        playwright.expect(part(page, "dead", "4")).to_be_hidden()
        (left, top, right, _), (other_left, other_top, *_) = page.eval_on_selector_all(".sensor", SIDES)
        assert top == other_top and right < other_left
        page.set_viewport_size({"width": 390, "height": 844})
        (left, _, _, bottom), (other_left, other_top, *_) = page.eval_on_selector_all(".sensor", SIDES)
        assert left == other_left and bottom < other_top
        run.emulator.hang_up()
        for sensor in "46":
            word(page, "no scan for", sensor)
            playwright.expect(part(page, "field", sensor)).to_have_attribute("data-live", "no")
        logged(page, "link lost")


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


def test_the_pictures_of_the_pages_can_still_be_taken(browser, tmp_path, monkeypatch, capsys):
    """One of those of docs/live_pictures.py, without its waiting for the last tap."""
    spec = importlib.util.spec_from_file_location("live_pictures", ROOT / "docs" / "live_pictures.py")
    pictures = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(pictures)
    monkeypatch.setattr(pictures, "PICTURES", tmp_path)
    counts = pictures.held_demo()
    with pictures.emulator(tmp_path, counts) as bus, pictures.live_page(bus.port) as (_, url):
        page = pictures.look(browser, url, pictures.PHONE, "dark")
        page.locator('[data-number="taps_used"]').first.wait_for()
        with Progress("pictures", 1, "picture") as bar:
            pictures.keep(page, "phone", bar)
        page.close()
    taken = (tmp_path / "live-phone.png").read_bytes()
    assert taken.startswith(b"\x89PNG") and struct.unpack(">II", taken[16:24]) == pictures.PHONE
    assert capsys.readouterr().out.startswith(f"{tmp_path}/live-phone.png: ")

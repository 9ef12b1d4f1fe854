"""Live page in headless Chromium: runs to look at, and what a person sees of them."""

import base64
import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from bridge_samples import write_npz
from edge_samples import PERIOD_NS, ROOT, wait_for
from matplotlib import colormaps

from edge.api import load_model
from edge.inference.bundled import demo_recording
from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.scans.scan import ScanSeries
from firmware_bridge.zeroing.baseline import BaselineEstimator, save_baselines

CHROMIUM = shutil.which("chromium")
if os.environ.get("EDGE_BROWSER") != "1":  # a machine with 1 must have both, so that a missing one fails
    if CHROMIUM is None:
        pytest.skip("no chromium here: apt-get install chromium", allow_module_level=True)
    pytest.importorskip("playwright.sync_api")
playwright = import_module("playwright.sync_api")
expect = playwright.expect

TIMEOUT_MS = 60_000
TOKEN = "of-twelve-letters"
PHONE = (390, 844)
SIZES = [(844, 390), (1024, 600), (1280, 800), (2560, 1300)]
FREE_SCANS, HELD_SCANS = 30, 30_000
NOISE_COUNTS = 3
"""Noise of a pad that is pressed and held, since a taxel that repeats itself is taken for a stuck one."""


@pytest.fixture(scope="module")
def browser():
    playwright.expect.set_options(timeout=TIMEOUT_MS)  # as all that is waited for: the machine may be busy
    with playwright.sync_playwright() as engine:
        chromium = engine.chromium.launch(executable_path=CHROMIUM)
        yield chromium
        chromium.close()


@pytest.fixture
def open_page(browser):
    """Function that opens pages; in none of them may a request leave the server, or an error come."""
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
    strangers = [url for url in asked if not re.match(r"(http|ws)://(127\.0\.0\.1|robot\.localhost):\d+/|data:", url)]
    assert asked and strangers == []
    # That nobody answers, or not as wanted, is Chromium's to tell, and what some of these tests are about.
    told = ("net::ERR_", "before the connection is established", "Unexpected response code: ")
    told += ("403 (Forbidden)", "404", "502", "503", "426")
    unexpected = [text for text in wrong if not any(words in text for words in told)]
    assert unexpected == []


class Run(subprocess.Popen[bytes]):
    """Run of `edge-sr` with the address of its page, and the bus that it reads where that is emulated."""

    url: str
    emulator: Emulator


@contextlib.contextmanager
def edge_sr(*arguments):
    """Run `edge-sr --view 0` and yield it with the address that it reports; a command comes first."""
    command = [one for one in arguments[:1] if not str(one).startswith("-")]
    with tempfile.NamedTemporaryFile("w") as said:
        process = Run(
            [sys.executable, "-m", "edge.cli.main", *command, "--view", "0", *map(str, arguments[len(command) :])],
            cwd=ROOT,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=said,
        )
        try:
            address = re.compile("^live page: (.*)$", re.MULTILINE)
            process.url = wait_for(lambda: address.search(Path(said.name).read_text()))[1]
            yield process
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
            process.wait(timeout=TIMEOUT_MS / 1000)


@pytest.fixture(scope="module")
def demo():
    with np.load(demo_recording()) as data:
        return dict(data)


@pytest.fixture(scope="module")
def folder(demo, tmp_path_factory):
    """Folder with stored baselines of the demo's sensor under two names."""
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
    """Yield a run on an emulated bus that plays counts (n, 3, 4, 4) of one or more sensors again and again."""
    recordings = []
    for counts in tracks:
        path = folder / f"{len(list(folder.glob('*.npz')))}.npz"
        write_npz(path, counts.astype(np.int32))
        recordings.append(load_recording(path))
    # A link of its own, for a pseudo-terminal that is gone may be given to another test, and the run tries it again.
    with Emulator(recordings, loop=True, link=folder / "port") as emulator:
        stored = ["--baseline", folder / "zero.json", "--model", "stsr-int8", "--every-scan"]
        with edge_sr("--source", f"slcan:{emulator.port}", *stored, *options) as run:
            run.emulator = emulator
            yield run


def noise(count, seed=1):
    return np.random.default_rng(seed).integers(-NOISE_COUNTS, NOISE_COUNTS + 1, (count, 3, 4, 4))


def pressed(demo):
    """Return counts of the demo's first tap at three fifths of its depth, and the pattern that they are shown as."""
    depth_mm = np.where(demo["tap"] == 0, demo["indentation_mm"], np.nan)
    counts = demo["counts"][np.nanargmin(abs(depth_mm - 0.6 * np.nanmax(depth_mm)))]
    model = load_model("stsr-int8")
    window = (counts - zeroed(demo, "4").counts)[None].astype(np.float32)
    return counts, model.run(model.contract.scale_window(window)).copy()


def then_held(demo, counts):
    """Return a free pad, since a contact from the first scan is in doubt, and then counts that are held for 300 s."""
    free = np.broadcast_to(zeroed(demo, "4").counts.round(), (FREE_SCANS, 3, 4, 4))
    return np.concatenate([free, counts + noise(HELD_SCANS)])


# What a person sees of a page.


def painted(page):
    """Return once all that the page was asked for so far is painted: it paints at its next animation frame."""
    page.evaluate("() => new Promise((go_on) => requestAnimationFrame(go_on))")


def resize(page, width, height):
    page.set_viewport_size({"width": width, "height": height})
    page.wait_for_function("([width, height]) => innerWidth === width && innerHeight === height", arg=[width, height])
    painted(page)


def fits(page, width, height):
    """Check that nothing is cut off, so that a page of this size scrolls one way at most."""
    resize(page, width, height)
    assert page.evaluate("document.documentElement.scrollWidth") <= width, width
    assert page.evaluate(RUNS_OVER) == 0, width


def part(page, name, sensor="4"):
    return page.locator(f'[data-sensor="{sensor}"] [data-part="{name}"]')


def number(page, name, sensor="4"):
    return page.locator(f'[data-sensor="{sensor}"] [data-number="{name}"]')


def live(page):
    page.wait_for_selector('[data-sensor="4"] [data-part="field"][data-live="yes"]')


def word(page, text, sensor="4"):
    expect(part(page, "word", sensor)).to_contain_text(text)


def logged(page, text):
    expect(page.locator("#log li").filter(has_text=text).first).to_be_visible()


PAINTED = """canvas => canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height)
  .data.filter((value, at) => at % 4 === 3 && value).length"""

RUNS_OVER = """() => [...document.querySelectorAll("body *:not(.unseen)")]
  .filter((one) => one.offsetParent && one.getBoundingClientRect().right > innerWidth + 0.5).length"""

RGBA = """canvas => {
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  return [canvas.height, canvas.width, btoa(Array.from(data, (one) => String.fromCharCode(one)).join(""))];
}"""


def colours_of(pixels):
    """Return the colours (rows, cols, 4) of a canvas read by RGBA."""
    height, width, data = pixels
    return np.frombuffer(base64.b64decode(data), np.uint8).reshape(height, width, 4).astype(float)


def shares(pixels):
    """Return the shares of the scale of a canvas's colours."""
    rgba = colours_of(pixels)
    assert (rgba[..., 3] == 255).all()
    steps = np.linspace(0, 1, 256)
    colours = 255 * colormaps["viridis"](steps)[:, :3]
    return steps[np.abs(rgba[..., None, :3] - colours).sum(axis=-1).argmin(axis=-1)]


def likeness(shown, truth):
    return float(np.corrcoef(shown.ravel(), truth.ravel())[0, 1])

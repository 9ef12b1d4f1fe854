"""Take the pictures of the live page: an emulated sensor taps the demo's figure four times, and stays on it.

python docs/live_pictures.py        # needs playwright, and chromium of the system
"""

import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from playwright.sync_api import Browser, Page, ViewportSize, sync_playwright

from edge.inference.bundled import demo_recording
from edge.terminal.progress_bar import progress
from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.recording.formats import load_recording
from train.demo import MAGNET_SCENE

PICTURES: Final = Path(__file__).with_name("pictures")
TAKEN: Final = 6
DESKTOP: Final = (1280, 800)
PHONE: Final = (390, 844)
HELD_SCANS: Final = 3000
NOISE_COUNTS: Final = 2
DEAD: Final = (1, 2)
HIGHEST_COUNT: Final = 65_535
LOOKS_S: Final = 1.0
"""Wait before a picture, so that its numbers are of the hold, not of its first scan, in [s]."""


def held_demo() -> NDArray[np.int32]:
    """Return counts (n, 3, 4, 4) of the demo up to the depth of its last tap, followed by a long hold at that depth."""
    with np.load(demo_recording()) as data:
        counts, tap, depth_mm = data["counts"].astype(np.int32), data["tap"], data["indentation_mm"]
    last = np.flatnonzero(tap == tap.max())
    peak = last[np.argmax(depth_mm[last])]
    return np.concatenate([counts[: peak + 1], counts[peak] + noise()])


def magnet_near() -> NDArray[np.int32]:
    """Return counts (n, 3, 4, 4) of the demo's pad at rest, followed by a long press with the magnet near it."""
    with np.load(demo_recording()) as data:
        counts, tap, scene = data["counts"].astype(np.int32), data["tap"], data["scene"]
    rest, scenes = counts[: np.argmax(tap >= 0)], counts[scene == MAGNET_SCENE]
    peak = scenes[scenes[:, 2].sum(axis=(1, 2)).argmax()]
    return np.concatenate([rest, np.broadcast_to(peak, (HELD_SCANS, *peak.shape)) + noise()])


def noise() -> NDArray[np.int32]:
    """Return noise (n, 3, 4, 4) in counts for a long hold, without which a taxel would repeat itself."""
    rng = np.random.default_rng(1)
    return rng.integers(-NOISE_COUNTS, NOISE_COUNTS + 1, (HELD_SCANS, 3, 4, 4)).astype(np.int32)


def emulator(folder: Path, *tracks: NDArray[np.int32]) -> Emulator:
    """Return a bus on which a sensor plays each of these counts."""
    recordings = []
    for number, counts in enumerate(tracks):
        path = folder / f"{number}.npz"
        scans = np.arange(len(counts))
        facts = {"format": "tactile-recording", "version": 1, "sensor": ["4"] * len(counts)}
        np.savez(path, **facts, scan=scans, time_ns=scans * 10_000_000, counts=counts)
        recordings.append(load_recording(path))
    return Emulator(recordings, loop=True)


@contextmanager
def live_page(port: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Run `edge-sr --view` on a bus, and yield its process and address."""
    arguments = ["--source", f"slcan:{port}", "--model", "mtsr4-int8", "--counts-per-newton", "1180"]
    command = [sys.executable, "-m", "edge.cli.main", "--view", "0", *arguments]
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as run:
        try:
            for line in run.stderr or []:
                if line.startswith("live page: "):
                    yield run, line.partition(": ")[2].strip()
                    break
        finally:
            run.send_signal(signal.SIGINT)


def look(browser: Browser, url: str, size: tuple[int, int], scheme: str) -> Page:
    """Open a page of this size in [px], in a "light" or a "dark" browser."""
    viewport = ViewportSize(width=size[0], height=size[1])
    page = browser.new_page(viewport=viewport, color_scheme="dark" if scheme == "dark" else "light")
    page.goto(url)
    return page


def keep(page: Page, name: str, bar: Any) -> None:
    """Save a screenshot of the page."""
    path = PICTURES / f"live-{name}.png"
    page.screenshot(path=path)
    bar.update()
    bar.clear()
    sys.stdout.write(f"{path}: {path.stat().st_size / 1024:.0f} KB\n")


def await_hold(page: Page) -> None:
    """Return once the last tap is held, whose pattern is of four taps."""
    page.locator('[data-number="taps_used"]', has_text=re.compile("^4 of 4$")).first.wait_for()
    page.wait_for_timeout(1000 * LOOKS_S)


def main() -> None:
    """Take all pictures."""
    PICTURES.mkdir(exist_ok=True)
    counts = held_demo()
    broken = counts.copy()
    broken[:, :, *DEAD] = HIGHEST_COUNT
    with (
        tempfile.TemporaryDirectory() as folder,
        sync_playwright() as engine,
        progress("pictures", TAKEN, "picture") as bar,
    ):
        browser = engine.chromium.launch(executable_path=shutil.which("chromium"))
        with emulator(Path(folder), counts) as bus, live_page(bus.port) as (run, url):
            for name, size, scheme in (("phone", PHONE, "light"), ("dark", DESKTOP, "dark")):
                page = look(browser, url, size, scheme)
                await_hold(page)
                keep(page, name, bar)
                page.close()
            page = look(browser, url, DESKTOP, "light")
            await_hold(page)
            keep(page, "desktop", bar)
            run.send_signal(signal.SIGINT)
            page.locator("#trouble").wait_for()
            page.wait_for_timeout(3000)
            keep(page, "lost", bar)
        with emulator(Path(folder), counts, broken) as bus, live_page(bus.port) as (_, url):
            page = look(browser, url, DESKTOP, "light")
            await_hold(page)
            keep(page, "two", bar)
        with emulator(Path(folder), magnet_near()) as bus, live_page(bus.port) as (_, url):
            page = look(browser, url, DESKTOP, "light")
            page.locator(".doubted").wait_for()
            page.wait_for_timeout(1000 * LOOKS_S)
            keep(page, "untrusted", bar)
        browser.close()


if __name__ == "__main__":
    main()

"""Live page of the demo, and the pictures that are taken of it."""

import contextlib
import importlib.util
import re
import signal
import struct

import numpy as np
from browser_samples import (
    RGBA,
    TOKEN,
    browser,
    demo,
    edge_sr,
    likeness,
    logged,
    open_page,
    part,
    playwright,
    shares,
    word,
)
from edge_samples import ROOT
from view_samples import wait_for
from websockets.sync.client import connect

from edge.terminal.progress_bar import Progress
from edge.view.server import MOST_VIEWERS

__all__ = ["browser", "demo", "open_page"]


class TestDemo:
    # The force, and the pattern where it is deep, as they are painted at one time.
    LOOK = f"""() => {{
      const card = document.querySelector(".sensor");
      if (card === null) return [null, null];
      const text = (name) => card.querySelector(`[data-part="${{name}}"]`).textContent;
      const deep = parseFloat(text("pattern-most").replace("deepest ", "")) > 0.1;
      return [text("force-now"), deep ? ({RGBA})(card.querySelector('[data-part="pattern"]')) : null];
    }}"""

    def test_the_letter_is_seen_the_numbers_move_and_the_end_is_no_live_picture(self, open_page, demo):
        with edge_sr("--source", "demo:loop") as run:
            page = open_page(run.url)
            forces, shown, fits = set(), None, [0.0]

            def seen():
                """Look at the page; it may come late, and see scenes without the letter first."""
                nonlocal shown, fits
                force, pixels = page.evaluate(self.LOOK)
                forces.add(force)
                if pixels is not None and max(fits) < 0.95:
                    shown = shares(pixels)
                    fits = [likeness(shown, truth.astype(float)) for truth in demo["unit_patterns"]]
                return len(forces) > 20 and max(fits) > 0.95

            wait_for(seen)
            playwright.expect(page.locator("#origin").filter(has_text="EMULATED")).to_be_visible()
            assert page.title().startswith("EMULATED")
            best = demo["unit_patterns"][int(np.argmax(fits))].astype(float)
            others = [best[::-1], best[:, ::-1], best.T, best[::-1].T]
            assert max(likeness(shown, turned) for turned in others) < 0.8, fits
            run.send_signal(signal.SIGINT)
            word(page, "run ended")
            playwright.expect(page.locator("#trouble")).to_contain_text(
                re.compile(r"^the run has ended \(.*\): the values shown are old; ")
            )
            assert part(page, "field").get_attribute("data-live") == "no"
            playwright.expect(part(page, "link")).to_have_text("no connection")
            assert part(page, "zero").is_disabled()
            playwright.expect(part(page, "stamp")).to_contain_text("last contact")
            forgotten = page.locator("#log").get_by_text("earlier taps forgotten")
            before = forgotten.count()  # each round of the demo forgets them
            page.keyboard.press("r")
            logged(page, "command not sent: no connection")
            assert forgotten.count() == before

    def test_the_next_run_is_found_and_nothing_of_the_one_before_kept(self, open_page):
        with edge_sr("--source", "demo:loop", "--view-token", TOKEN) as run:
            page = open_page(run.url)
            page.wait_for_selector(".sensor")
            page.eval_on_selector(".sensor", "card => { card.id = 'first'; }")
            page.keyboard.press("Space")
        port = re.search(r":(\d+)/", run.url)[1]
        with edge_sr("--source", "demo:loop", "--view", port, "--view-token", TOKEN):
            logged(page, "a new run has begun")
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
            playwright.expect(trouble).to_contain_text(f"too many viewers ({MOST_VIEWERS})")
            socket.close()
            page.wait_for_selector(".sensor")
            playwright.expect(trouble).to_be_hidden()


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

"""The live page of the demo, of a recording and of a hand."""

import contextlib
import re
import signal
import time

import browser_samples as web
import numpy as np
from bridge_samples import write_recording
from browser_samples import browser, demo, open_page
from edge_samples import wait_for
from websockets.sync.client import connect

from edge.view.frames import MOST_VIEWERS

__all__ = ["browser", "demo", "open_page"]

# The force, and the pattern where it is deep, as they are painted at one time.
LOOK = f"""() => {{
  const card = document.querySelector(".sensor");
  if (card === null) return [null, null];
  const text = (name) => card.querySelector(`[data-part="${{name}}"]`).textContent;
  const deep = parseFloat(text("pattern-most").replace("deepest ", "")) > 0.1;
  return [text("force-now"), deep ? ({web.RGBA})(card.querySelector('[data-part="pattern"]')) : null];
}}"""


def test_the_demo_shows_its_letter_ends_and_is_followed(open_page, demo):
    with web.edge_sr("--source", "demo:loop", "--view-token", web.TOKEN) as run:
        page = open_page(run.url)
        forces, shown, likenesses = set(), None, [0.0]

        def seen():
            """Look at the page; it may come late, and see scenes without the letter first."""
            nonlocal shown, likenesses
            force, pixels = page.evaluate(LOOK)
            forces.add(force)
            if pixels is not None and max(likenesses) < 0.95:
                shown = web.shares(pixels)
                likenesses = [web.likeness(shown, truth.astype(float)) for truth in demo["unit_patterns"]]
            return len(forces) > 20 and max(likenesses) > 0.95

        wait_for(seen)
        web.expect(web.part(page, "truth-error")).to_have_text(re.compile(r"^\d\d?\.\d\s%$"))
        web.expect(web.part(page, "truth-shown")).to_be_visible()
        best = demo["unit_patterns"][int(np.argmax(likenesses))].astype(float)
        others = [best[::-1], best[:, ::-1], best.T, best[::-1].T]
        assert max(web.likeness(shown, turned) for turned in others) < 0.8, likenesses
        web.expect(page.locator("#origin").filter(has_text="EMULATED")).to_be_visible()
        assert page.title().startswith("EMULATED")

        # Its end is no live picture.
        run.send_signal(signal.SIGINT)
        web.word(page, "run ended")
        trouble = web.expect(page.locator("#trouble"))
        trouble.to_contain_text(re.compile(r"^the run has ended \(.*\): the values shown are old; "))
        assert web.part(page, "field").get_attribute("data-live") == "no"
        web.expect(web.part(page, "link")).to_have_text("no connection")
        assert web.part(page, "zero").is_disabled()
        web.expect(web.part(page, "stamp")).to_contain_text("last contact")
        forgotten = page.locator("#log").get_by_text("earlier taps forgotten")
        before = forgotten.count()  # each round of the demo forgets them
        page.keyboard.press("r")
        web.logged(page, "command not sent: no connection")
        assert forgotten.count() == before
        page.eval_on_selector(".sensor", "card => { card.id = 'first'; }")

    # The next run is found, and nothing of the one before is kept.
    port = re.search(r":(\d+)/", run.url)[1]
    with (
        web.edge_sr("--source", "demo:loop", "--view", port, "--view-token", web.TOKEN),
        contextlib.ExitStack() as full,
    ):
        web.logged(page, "a new run has begun")
        page.wait_for_selector(".sensor:not(#first)")
        assert page.locator("#first").count() == 0

        # Who is not let in is told why.
        page.goto(run.url.replace(web.TOKEN, "another-one-of-it"))
        trouble.to_contain_text("the token is missing or wrong: open the address that edge-sr")
        for _ in range(MOST_VIEWERS):
            socket = full.enter_context(connect(f"ws{run.url[4:].replace('?', 'ws?')}", max_queue=None))
        page.goto(run.url)
        trouble.to_contain_text(f"too many viewers ({MOST_VIEWERS})")
        socket.close()
        page.wait_for_selector(".sensor")
        trouble.to_be_hidden()


def write_fingers(demo, folder):
    """Write two fingers that begin in contact, `4` by less than `6`, and are free then."""
    held, free, (counts, _) = 200, 100, web.pressed(demo)
    rest = np.median(demo["counts"][:100], axis=0).astype(int)
    paths = []
    for name, share in (("4", 0.9), ("6", 1.0)):
        sway = share * (0.8 + 0.2 * np.cos(np.arange(held))).reshape(-1, 1, 1, 1)  # no pattern repeats itself
        press = np.rint(rest + sway * (counts.astype(int) - rest)).astype(int)
        scans = np.concatenate([press + web.noise(held, 1) * 3, rest + web.noise(free, 2)])
        paths.append(write_recording(folder / f"{name}.csv", scans, rate_hz=50))
    return paths


def test_a_recording_begins_when_its_page_is_opened_and_ends(demo, tmp_path, open_page):
    with web.edge_sr("replay", *write_fingers(demo, tmp_path)) as played:
        time.sleep(1.0)  # nothing of it is missed
        page = open_page(played.url)
        web.expect(page.locator("#origin")).to_have_text(
            re.compile(r"^REPLAY: a recording, not live data, [0-2]\.\d of 6\.0\ss$")
        )
        for sensor in "46":  # found free, though it begins in contact
            web.logged(page, f"sensor {sensor}: zeroed from its scans 2")
            web.word(page, "contact", sensor)
        web.expect(page.locator("#about")).to_contain_text("replay:4.csv,6.csv")
        web.expect(web.number(page, "missed")).to_have_text("0")
        web.expect(web.part(page, "link")).to_contain_text("scans/s")
        web.word(page, "idle")
        web.word(page, "run ended")
        web.expect(page.locator("#origin")).to_contain_text("6.0 of 6.0")
        assert played.wait(60) == 0
    with web.edge_sr("replay", "--example") as unseen:
        time.sleep(1.0)
        unseen.send_signal(signal.SIGINT)  # before anybody looks: no fault of the recording
        assert unseen.wait(60) == 0
    with web.edge_sr("replay", "--example", "--duration-s", "0.5") as unseen:
        assert unseen.wait(60) == 0

"""The live page of the demo, of a recording and of a hand."""

import contextlib
import csv
import json
import re
import signal

import numpy as np
from bridge_samples import write_recording
from browser_samples import (
    PAINTED,
    PHONE,
    RGBA,
    RUNS_OVER,
    SIZES,
    TOKEN,
    browser,
    colours_of,
    demo,
    edge_sr,
    emulated,
    fits,
    folder,
    likeness,
    live,
    logged,
    moves,
    noise,
    number,
    open_page,
    painted,
    part,
    playwright,
    pressed,
    resize,
    shares,
    then_held,
    word,
)
from edge_samples import wait_for
from websockets.sync.client import connect

from edge.view.server import MOST_VIEWERS

__all__ = ["browser", "demo", "folder", "open_page"]

# The force, and the pattern where it is deep, as they are painted at one time.
LOOK = f"""() => {{
  const card = document.querySelector(".sensor");
  if (card === null) return [null, null];
  const text = (name) => card.querySelector(`[data-part="${{name}}"]`).textContent;
  const deep = parseFloat(text("pattern-most").replace("deepest ", "")) > 0.1;
  return [text("force-now"), deep ? ({RGBA})(card.querySelector('[data-part="pattern"]')) : null];
}}"""
STEP_AND_SAVE_TWICE = """async () => {
  const pictures = [];
  const usual = HTMLCanvasElement.prototype.toBlob;
  HTMLCanvasElement.prototype.toBlob = function () {
    pictures.push(this.getContext("2d").getImageData(0, 0, this.width, 690).data.join());
  };
  document.dispatchEvent(new KeyboardEvent("keydown", { key: "," }));
  document.querySelector("#save-png").click();
  await new Promise((go_on) => requestAnimationFrame(go_on));
  document.querySelector("#save-png").click();
  HTMLCanvasElement.prototype.toBlob = usual;
  return pictures.length === 4 && pictures[0] === pictures[2] && pictures[1] === pictures[3];
}"""
BROKEN = "all => all.filter((one) => one.scrollHeight > 36 || one.scrollWidth > one.clientWidth + 1).length"
SMALL = "all => all.filter((one) => one.offsetParent && one.getBoundingClientRect().height < 40).length"


def test_the_demo_shows_its_letter_ends_and_is_followed(open_page, demo):
    with edge_sr("--source", "demo:loop", "--view-token", TOKEN) as run:
        page = open_page(run.url)
        forces, shown, likenesses = set(), None, [0.0]

        def seen():
            """Look at the page; it may come late, and see scenes without the letter first."""
            nonlocal shown, likenesses
            force, pixels = page.evaluate(LOOK)
            forces.add(force)
            if pixels is not None and max(likenesses) < 0.95:
                shown = shares(pixels)
                likenesses = [likeness(shown, truth.astype(float)) for truth in demo["unit_patterns"]]
            return len(forces) > 20 and max(likenesses) > 0.95

        wait_for(seen)
        best = demo["unit_patterns"][int(np.argmax(likenesses))].astype(float)
        others = [best[::-1], best[:, ::-1], best.T, best[::-1].T]
        assert max(likeness(shown, turned) for turned in others) < 0.8, likenesses
        playwright.expect(page.locator("#origin").filter(has_text="EMULATED")).to_be_visible()
        assert page.title().startswith("EMULATED")

        # Its end is no live picture.
        run.send_signal(signal.SIGINT)
        word(page, "run ended")
        trouble = playwright.expect(page.locator("#trouble"))
        trouble.to_contain_text(re.compile(r"^the run has ended \(.*\): the values shown are old; "))
        assert part(page, "field").get_attribute("data-live") == "no"
        playwright.expect(part(page, "link")).to_have_text("no connection")
        assert part(page, "zero").is_disabled()
        playwright.expect(part(page, "stamp")).to_contain_text("last contact")
        forgotten = page.locator("#log").get_by_text("earlier taps forgotten")
        before = forgotten.count()  # each round of the demo forgets them
        page.keyboard.press("r")
        logged(page, "command not sent: no connection")
        assert forgotten.count() == before
        page.keyboard.press("Space")
        playwright.expect(page.locator("#pause")).to_have_attribute("aria-pressed", "true")
        page.eval_on_selector(".sensor", "card => { card.id = 'first'; }")

    # The next run is found, and nothing of the one before is kept.
    port = re.search(r":(\d+)/", run.url)[1]
    with edge_sr("--source", "demo:loop", "--view", port, "--view-token", TOKEN), contextlib.ExitStack() as full:
        logged(page, "a new run has begun")
        page.wait_for_selector(".sensor:not(#first)")
        assert page.locator("#first").count() == 0
        playwright.expect(page.locator("#pause")).to_have_attribute("aria-pressed", "false")

        # Who is not let in is told why.
        page.goto(run.url.replace(TOKEN, "another-one-of-it"))
        trouble.to_contain_text("the token is missing or wrong: open the address that edge-sr")
        for _ in range(MOST_VIEWERS):
            socket = full.enter_context(connect(f"ws{run.url[4:].replace('?', 'ws?')}", max_queue=None))
            socket.send('{"cmd": "pause", "on": true}')
        page.goto(run.url)
        trouble.to_contain_text(f"too many viewers ({MOST_VIEWERS})")
        socket.close()
        page.wait_for_selector(".sensor")
        trouble.to_be_hidden()


def write_fingers(demo, folder):
    """Write two fingers that begin in contact, `4` by less than `6`, and are free then."""
    held, free, (counts, _) = 60, 70, pressed(demo)
    rest = np.median(demo["counts"][:100], axis=0).astype(int)
    paths = []
    for name, share in (("4", 0.9), ("6", 1.0)):
        sway = share * (0.8 + 0.2 * np.cos(np.arange(held))).reshape(-1, 1, 1, 1)  # no pattern repeats itself
        press = np.rint(rest + sway * (counts.astype(int) - rest)).astype(int)
        scans = np.concatenate([press + noise(held, 1) * 3, rest + noise(free, 2)])
        paths.append(write_recording(folder / f"{name}.csv", scans, rate_hz=50))
    return paths


def slide(page, name, value):
    page.locator(f"#{name}").evaluate(
        """(slider, value) => {
          slider.value = value;
          slider.dispatchEvent(new Event("input"));
          slider.dispatchEvent(new Event("change"));
        }""",
        str(value),
    )


def hold(page):
    page.keyboard.press("Space")
    playwright.expect(page.locator("#play")).to_have_text("Play")


def test_a_recording_is_steered_looked_back_at_and_saved(demo, tmp_path, open_page):
    with edge_sr("replay", *write_fingers(demo, tmp_path)) as played:
        page = open_page(played.url, accept_downloads=True)
        at = "place => Math.abs(Number(document.querySelector('#place').value) - place) < 0.05"
        for sensor in "46":  # found free, though it begins in contact
            logged(page, f"sensor {sensor}: zeroed from its scans 6")
        playwright.expect(page.locator("#about")).to_contain_text("replay:4.csv,6.csv")
        page.wait_for_function("() => /round [2-9]/.test(document.querySelector('#place-text').textContent)")
        playwright.expect(number(page, "missed")).to_have_text("0")

        hold(page)
        playwright.expect(part(page, "link")).to_have_text("recording held")
        for place, state in ((2.2, "idle"), (0.6, "contact")):
            slide(page, "place", place)
            for sensor in "46":
                word(page, f"{state}, held", sensor)
            page.wait_for_function(at, arg=place)
        playwright.expect(number(page, "ellipse")).to_have_text(re.compile("^\\d+\\.\\d \u00d7 \\d+\\.\\d\\smm$"))
        page.keyboard.press("<")
        page.keyboard.press("<")
        playwright.expect(page.locator("#speed")).to_have_text("0.25\u00d7")
        page.keyboard.press("Space")
        playwright.expect(part(page, "link")).to_contain_text("scans/s")

        # Back in time: the page shows the contact of before, while live goes on; both fingers of one moment.
        kept = float(page.locator("#back").get_attribute("min"))
        slide(page, "back", kept / 2)
        playwright.expect(page.locator("#to-live")).to_be_enabled()
        for _ in range(40):  # a picture of a contact is among those of any two seconds
            painted(page)
            if part(page, "word").inner_text().startswith("contact, "):
                break
            page.keyboard.press(",")
        word(page, "contact, ")
        then = float(page.locator("#place").input_value())
        page.wait_for_timeout(1100)  # after a second without a scan a sensor is silent
        playwright.expect(part(page, "link")).to_contain_text("scans/s")
        page.wait_for_function("place => Number(document.querySelector('#place').value) !== place", arg=then)
        moves(page, "word")  # it is ever longer ago
        word(page, "contact, ")
        assert part(page, "field").get_attribute("data-live") == "no"
        page.keyboard.press("v")
        painted(page)
        assert part(page, "relief").evaluate(PAINTED)
        page.keyboard.press("v")
        check_saved(page)
        page.keyboard.press("l")
        word(page, "")
        playwright.expect(page.locator("#to-live")).to_be_disabled()

        # Numbers are explained, and nothing runs over on any screen.
        hold(page)
        slide(page, "place", 0.4)
        word(page, "contact, held")
        term, tip = page.locator('[data-sensor="4"]').get_by_text("late", exact=True), page.locator("#tip")
        term.hover()
        playwright.expect(tip).to_contain_text("later than one scan period")
        page.mouse.move(5, 5)
        playwright.expect(tip).to_be_hidden()
        page.locator('[data-sensor="4"] dt').first.focus()
        page.keyboard.press("ArrowDown")
        playwright.expect(tip).to_contain_text("Area of the touched pixels")
        for width, height in SIZES:
            fits(page, width, height)
            assert page.locator("dd.big").evaluate_all(BROKEN) == 0, width

        # A phone reads by touch.
        phone = dict(zip(("width", "height"), PHONE, strict=True))
        page = open_page(played.url, viewport=phone, has_touch=True, is_mobile=True)
        part(page, "readout").filter(has_text="tap the pattern").wait_for()
        box = part(page, "field").bounding_box()
        page.touchscreen.tap(box["x"] + box["width"] / 4, box["y"] + box["height"] / 4)
        playwright.expect(part(page, "readout")).to_have_text(re.compile("^x \u22124\\.\\d, y \u22124\\.\\d\\smm"))
        page.locator('[data-sensor="4"] dt').filter(has_text="missed").tap()
        playwright.expect(page.locator("#tip")).to_contain_text("never came")
        assert page.locator("#keys button, .time button").evaluate_all(SMALL) == 0
        assert page.evaluate(RUNS_OVER) == 0


def check_saved(page):
    """Save what is shown in all three forms, and check that they agree."""
    assert page.evaluate(STEP_AND_SAVE_TWICE), "a picture is of the scan in its title, also before that is painted"
    saved = []
    page.on("download", lambda one: saved.append(one))
    for ending in ("png", "csv", "npz"):
        page.keyboard.press("e")
        page.locator(f"#save-{ending}").click()
    wait_for(lambda: page.wait_for_timeout(50) or len(saved) == 6)
    files = {one.suggested_filename: one.path() for one in saved}
    name = next(name for name in files if name.startswith("replay-4-") and name.endswith(".npz"))
    assert files[name.replace(".npz", ".png")].read_bytes().startswith(b"\x89PNG")
    with np.load(files[name]) as arrays:
        record, pattern = json.loads(str(arrays["record"])), arrays["pattern"]
        assert pattern.shape == (40, 40) and arrays["zeroed"].shape == (3, 4, 4) and pattern.max() > 0.05
    assert (record["source"], record["state"], record["sensor"]) == ("replay", "contact", "4")
    assert f"scan{record['scan']}.npz" in name
    rows = list(csv.DictReader(files[name.replace(".npz", ".csv")].read_text().splitlines()[1:]))
    table = [float(row["value"]) for row in rows if row["map"] == "pattern"]
    np.testing.assert_allclose(np.reshape(table, (40, 40)), pattern, rtol=1e-5)


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

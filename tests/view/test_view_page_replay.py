"""Live page of a recording that begins in contact: found free, played, held, scrubbed, looked back at, and saved."""

import csv
import json
import re

import numpy as np
import pytest
from bridge_samples import write_recording
from browser_samples import (
    browser,
    demo,
    edge_sr,
    logged,
    noise,
    number,
    open_page,
    painted,
    part,
    playwright,
    pressed,
    resize,
    word,
)
from view_samples import wait_for

__all__ = ["browser", "demo", "open_page"]

HELD, FREE = 60, 70
SIZES = [(844, 390), (1024, 600), (1280, 800), (2560, 1300)]
AT = "place => Math.abs(Number(document.querySelector('#place').value) - place) < 0.05"
ELSEWHERE = "place => Number(document.querySelector('#place').value) !== place"
RUNS_OVER = """() => [...document.querySelectorAll('body *:not(.unseen)')]
  .filter((one) => one.offsetParent && one.getBoundingClientRect().right > innerWidth + 0.5).length"""
BROKEN = "all => all.filter((one) => one.scrollHeight > 36 || one.scrollWidth > one.clientWidth + 1).length"
SMALL = "all => all.filter((one) => one.offsetParent && one.getBoundingClientRect().height < 40).length"
PAINTED = (
    "canvas => canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data.some((one) => one > 0)"
)
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


@pytest.fixture(scope="module")
def played(demo, tmp_path_factory):
    """A run that plays two fingers: both pressed at first, then free; `4` by less than `6`."""
    folder = tmp_path_factory.mktemp("replay")
    counts, _ = pressed(demo)
    rest = np.median(demo["counts"][:100], axis=0).astype(int)
    paths = []
    for name, share in (("4", 0.9), ("6", 1.0)):
        sway = share * (0.8 + 0.2 * np.cos(np.arange(HELD))).reshape(
            -1, 1, 1, 1
        )  # no pattern is that of the scan before
        held = np.rint(rest + sway * (counts.astype(int) - rest)).astype(int)
        scans = np.concatenate([held + noise(HELD, 1) * 3, rest + noise(FREE, 2)])
        paths.append(write_recording(folder / f"{name}.csv", scans, rate_hz=50))
    with edge_sr("replay", *paths) as run:
        yield run


def hold(page):
    page.keyboard.press("Space")
    playwright.expect(page.locator("#play")).to_have_text("Play")


def scrub(page, name, value):
    page.locator(f"#{name}").evaluate(
        """(slider, value) => {
          slider.value = value;
          slider.dispatchEvent(new Event("input"));
          slider.dispatchEvent(new Event("change"));
        }""",
        str(value),
    )


def test_a_recording_is_seen_steered_looked_back_at_and_saved(played, open_page):
    page = open_page(played.url, accept_downloads=True)
    for sensor in "46":
        logged(page, f"sensor {sensor}: zeroed from its scans 6")
    playwright.expect(page.locator("#about")).to_contain_text("replay:4.csv,6.csv")
    page.wait_for_function("() => document.querySelector('#place-text').textContent.includes('round 3')")
    playwright.expect(number(page, "missed")).to_have_text("0")

    hold(page)
    playwright.expect(part(page, "link")).to_have_text("recording held")
    for place, state in ((2.2, "idle"), (0.6, "contact")):
        scrub(page, "place", place)
        for sensor in "46":
            word(page, f"{state}, held", sensor)
        page.wait_for_function(AT, arg=place)
    playwright.expect(number(page, "ellipse")).to_have_text(re.compile("^\\d+\\.\\d \u00d7 \\d+\\.\\d\\smm$"))
    page.keyboard.press("<")
    page.keyboard.press("<")
    playwright.expect(page.locator("#speed")).to_have_text("0.25\u00d7")
    page.keyboard.press("Space")
    playwright.expect(part(page, "link")).to_contain_text("scans/s")

    # Back in time: the page shows the contact of before, while live goes on; both fingers of one moment.
    kept = float(page.locator("#back").get_attribute("min"))
    scrub(page, "back", kept / 2)
    playwright.expect(page.locator("#to-live")).to_be_enabled()
    for _ in range(40):  # a picture of a contact is among those of any two seconds
        painted(page)
        if part(page, "word").inner_text().startswith("contact, "):
            break
        page.keyboard.press(",")
    word(page, "contact, ")
    before, then = part(page, "word").inner_text(), float(page.locator("#place").input_value())
    page.wait_for_timeout(1100)  # after a second without a scan a sensor is silent
    playwright.expect(part(page, "link")).to_contain_text("scans/s")
    page.wait_for_function(ELSEWHERE, arg=then)
    page.wait_for_function(
        "before => document.querySelector('[data-part=word]').textContent !== before", arg=before
    )  # it is ever longer ago
    word(page, "contact, ")
    assert part(page, "field").get_attribute("data-live") == "no"
    page.keyboard.press("v")
    painted(page)
    assert part(page, "relief").evaluate(PAINTED)
    page.keyboard.press("v")

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
    page.keyboard.press("l")
    word(page, "")
    playwright.expect(page.locator("#to-live")).to_be_disabled()

    hold(page)
    scrub(page, "place", 0.4)
    word(page, "contact, held")
    term = page.locator('[data-sensor="4"]').get_by_text("late", exact=True)
    term.hover()
    playwright.expect(page.locator("#tip")).to_contain_text("later than one scan period")
    page.mouse.move(5, 5)
    playwright.expect(page.locator("#tip")).to_be_hidden()
    page.locator('[data-sensor="4"] dt').first.focus()
    page.keyboard.press("ArrowDown")
    playwright.expect(page.locator("#tip")).to_contain_text("Area of the touched pixels")
    for width, height in SIZES:
        resize(page, width, height)
        assert page.evaluate("document.documentElement.scrollWidth") <= width, width
        assert page.evaluate(RUNS_OVER) == 0, width
        assert page.locator("dd.big").evaluate_all(BROKEN) == 0, width


def test_a_phone_reads_by_touch(played, open_page):
    page = open_page(played.url, viewport={"width": 390, "height": 844}, has_touch=True, is_mobile=True)
    part(page, "readout").filter(has_text="tap the pattern").wait_for()
    box = part(page, "field").bounding_box()
    page.touchscreen.tap(box["x"] + box["width"] / 4, box["y"] + box["height"] / 4)
    playwright.expect(part(page, "readout")).to_have_text(re.compile("^x \u22124\\.\\d, y \u22124\\.\\d\\smm"))
    page.locator('[data-sensor="4"] dt').filter(has_text="missed").tap()
    playwright.expect(page.locator("#tip")).to_contain_text("never came")
    assert page.locator("#keys button, .time button").evaluate_all(SMALL) == 0
    assert page.evaluate(RUNS_OVER) == 0

"""Live page of a map: what is drawn, where, and what comes with each change."""

import re

import numpy as np
import pytest
from browser_samples import browser, open_page, playwright
from map_samples import letter, pixels_mm, result_of
from view_samples import frame, live_page

from edge.mapping.object_map import ObjectMap
from edge.mapping.sink import MapSink
from firmware_bridge.poses.pad_pose import PadPose
from firmware_bridge.poses.timed_pose import TimedPose

__all__ = ["browser", "open_page"]
PIXELS = """() => {
  const canvas = document.getElementById("map-contact");
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  return [canvas.height, canvas.width, ...data];
}"""
LIT = """() => {
  const canvas = document.getElementById("map-over");
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  const lit = [];
  for (let at = 0; at < canvas.width * canvas.height; at++)
    if (data[4 * at] > 200 && data[4 * at + 3] > 200) lit.push(at);
  return [canvas.width, canvas.height, ...lit];
}"""


class Mapped:
    """Map of a letter, on a page; each touch is one scan later and is shown at once."""

    def __init__(self, shown):
        self.sink = MapSink(ObjectMap(), show=shown.view.show_map)
        self.number = 0

    def touch(self, x_mm, y_mm, turn_deg=0.0, *, posed=True, **changes):
        pose = PadPose(x_mm, y_mm, turn_deg)
        self.number += 0 if posed else 50  # long after the last pose
        result = result_of(letter, pose, number=self.number, **changes)
        self.number += 1
        if posed:
            self.sink.pose([TimedPose(pose, result.scan.time_ns)])
        self.sink._due_ns = 0
        self.sink.write(result, {})


def colours_of(page):
    height, width, *data = page.evaluate(PIXELS)
    return np.array(data, dtype=float).reshape(height, width, 4)


def test_a_map_grows_on_the_page_with_the_pads_outline_on_it(open_page, tmp_path):
    with live_page(tmp_path) as shown:
        mapped = Mapped(shown)
        page = open_page(shown.view.url)
        playwright.expect(page.locator("#map")).to_be_hidden()
        shown.play()
        mapped.touch(-12.0, -8.0)
        playwright.expect(page.locator("#map")).to_be_visible()
        mapped.touch(-12.0, 8.0)
        mapped.touch(2.0, 16.0, trusted=True)
        mapped.touch(20.0, -20.0, 30.0, trusted=False)
        playwright.expect(page.locator("#map-counts")).to_have_text("3 patterns")
        mapped.touch(0.0, 0.0, posed=False)
        playwright.expect(page.locator("#map-counts")).to_have_text("3 patterns, 1 not believed, 1 without a pose")
        rgba, layers = colours_of(page), mapped.sink.whole.layers()
        known = np.isfinite(layers.contact)
        assert (rgba[..., 3] == 255).sum() == (known | (layers.doubted > 0)).sum()
        assert (rgba[known & (layers.contact > 0.9)][:, 0] > 200).all(), "touched is the light end of the scale"
        assert (rgba[known & (layers.contact < 0.1)][:, 0] < 80).all()
        red = ~known & (layers.doubted > 0)
        assert red.sum() > 1000 and (rgba[red][:, :3] == (200, 40, 30)).all()
        mapped.touch(10.0, -5.0, 45.0)
        playwright.expect(page.locator("#map-counts")).to_have_text(re.compile("^4 |^3 "))
        page.wait_for_function(f"() => ({LIT})().length > 200")
        width, height, *lit = page.evaluate(LIT)
        x_mm = (np.array(lit) % width + 0.5) / width * 60 - 30
        y_mm = (np.array(lit) // width + 0.5) / height * 60 - 30
        pad = y_mm < 23  # the bar of the scale lies below
        reach = 9.4 * 2**0.5
        assert x_mm[pad].max() == pytest.approx(10 + reach, abs=0.5) and x_mm[pad].min() == pytest.approx(
            10 - reach, abs=0.5
        )
        assert y_mm[pad].min() == pytest.approx(-5 - reach, abs=0.5)


def test_a_page_that_comes_late_or_was_paused_shows_the_same_map(open_page, tmp_path):
    with live_page(tmp_path) as shown:
        mapped = Mapped(shown)
        shown.play()
        for x_mm in (-12.0, -6.0, 0.0):
            mapped.touch(x_mm, 16.0)
        page = open_page(shown.view.url)
        playwright.expect(page.locator("#map-counts")).to_have_text("2 patterns")
        page.keyboard.press("Space")
        playwright.expect(page.locator("#pause")).to_have_attribute("aria-pressed", "true")
        before = colours_of(page)
        for y_mm in (8.0, 0.0, -8.0):
            mapped.touch(-12.0, y_mm)
        page.wait_for_timeout(300)
        assert np.array_equal(colours_of(page), before), "what is looked at stays"
        page.keyboard.press("Space")
        playwright.expect(page.locator("#map-counts")).to_have_text("5 patterns")
        known = np.isfinite(mapped.sink.whole.layers().contact)
        assert np.array_equal(colours_of(page)[..., 3] == 255, known)


def test_only_what_has_changed_is_sent(tmp_path):
    with live_page(tmp_path) as shown:
        mapped = Mapped(shown)
        shown.play()
        with shown.viewer() as viewer:
            mapped.touch(-12.0, 0.0)
            header, maps = frame(viewer, "map")
            whole = np.full((240, 240), np.nan, dtype=np.float32)
            for x_mm in (-12.0, -11.0, 0.0):
                (top, left), part = header["from"], maps["contact"]
                whole[top : top + part.shape[0], left : left + part.shape[1]] = part
                assert np.array_equal(whole, mapped.sink.whole.layers().contact, equal_nan=True)
                assert part.size < 0.4 * 240**2 and header["pads"] == {
                    "4": [x_mm if header["number"] > 1 else -12.0, 0.0, 0.0]
                }
                if x_mm < 0:
                    mapped.touch(x_mm + 1 if x_mm < -11 else 0.0, 0.0)
                    header, maps = frame(viewer, "map")
            mapped.sink._unseen, mapped.sink._due_ns = True, 0
            mapped.sink.wait()
            header, maps = frame(viewer, "map")
            assert maps == {} and header["counts"]["fused"] == 2
    x_mm, y_mm = pixels_mm(mapped.sink.whole.grid)
    assert (whole[(letter(x_mm, y_mm) == 0) & (np.abs(y_mm) < 8) & (np.abs(x_mm + 12) < 3)] > 0.9).all()

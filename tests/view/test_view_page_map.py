"""Live page of a map: what is drawn, where, and what comes with each change."""

import numpy as np
import pytest
from browser_samples import RGBA, browser, colours_of, logged, open_page, painted, playwright, resize
from map_samples import letter, pixels_mm, result_of
from view_samples import frame, live_page, wait_for

from edge.mapping.object_map import ObjectMap
from edge.mapping.sink import MapSink
from edge.perception.event import Event
from firmware_bridge.poses.pad_pose import PadPose

__all__ = ["browser", "open_page"]
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
        result = result_of(letter, pose, number=self.number, posed=posed, **changes)
        self.number += 1
        self.sink._due_ns = 0
        self.sink.write(result, {})


def shown_on(page):
    return colours_of(page.locator("#map-contact").evaluate(RGBA))


def outline(page):
    """Return the least and the largest x and the least y of what is drawn above the bar of the scale, in [mm]."""
    width, height, *lit = page.evaluate(LIT)
    at = np.array(lit, dtype=int)
    x_mm, y_mm = (at % width + 0.5) / width * 60 - 30, (at // width + 0.5) / height * 60 - 30
    pad = y_mm < 23
    return (x_mm[pad].min(), x_mm[pad].max(), y_mm[pad].min()) if pad.any() else (np.nan,) * 3


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
        playwright.expect(page.locator("#map-counts")).to_have_text("EMULATED: 3 patterns")
        mapped.touch(0.0, 0.0, posed=False)
        playwright.expect(page.locator("#map-counts")).to_have_text(
            "EMULATED: 3 patterns, 1 not believed, 1 without a pose"
        )
        rgba, layers = shown_on(page), mapped.sink.whole.layers()
        known = np.isfinite(layers.contact)
        assert (rgba[..., 3] == 255).sum() == (known | (layers.doubted > 0)).sum()
        assert (rgba[known & (layers.contact > 0.9)][:, 0] > 200).all(), "touched is the light end of the scale"
        assert (rgba[known & (layers.contact < 0.1)][:, 0] < 80).all()
        red = ~known & (layers.doubted > 0)
        assert red.sum() > 1000 and (rgba[red][:, :3] == (200, 40, 30)).all()
        mapped.touch(10.0, -5.0, 45.0)
        reach = 9.4 * 2**0.5
        wait_for(lambda: outline(page) == pytest.approx((10 - reach, 10 + reach, -5 - reach), abs=0.5))


def test_a_page_that_comes_late_or_was_paused_shows_the_same_map(open_page, tmp_path):
    with live_page(tmp_path) as shown:
        mapped = Mapped(shown)
        shown.play()
        for x_mm in (-12.0, -6.0, 0.0):
            mapped.touch(x_mm, 16.0)
        page = open_page(shown.view.url)
        playwright.expect(page.locator("#map-counts")).to_have_text("EMULATED: 2 patterns")
        page.keyboard.press("Space")
        playwright.expect(page.locator("#pause")).to_have_attribute("aria-pressed", "true")
        before = shown_on(page)
        for y_mm in (8.0, 0.0, -8.0):
            mapped.touch(-12.0, y_mm)
        for detail in ("first", "second"):  # what is sent with the first comes before the second
            for sink in shown.view.sinks:
                sink.tell(Event(0, "tap_dropped", "4", detail), {})
            logged(page, detail)
        painted(page)
        resize(page, 844, 800)
        assert outline(page)[1] == pytest.approx(9.4, abs=0.5), "a canvas of another size is painted, though paused"
        assert np.array_equal(shown_on(page), before), "what is looked at stays"
        page.keyboard.press("Space")
        playwright.expect(page.locator("#map-counts")).to_have_text("EMULATED: 5 patterns")
        known = np.isfinite(mapped.sink.whole.layers().contact)
        assert np.array_equal(shown_on(page)[..., 3] == 255, known)


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

"""The live page of results that no recording holds: forces, places, doubts and maps; and the page through a proxy."""

import contextlib
import re
import socket
import threading
from dataclasses import replace
from email.policy import HTTP
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import BytesIO

import browser_samples as web
import numpy as np
import pytest
from browser_samples import browser, open_page
from edge_samples import make_pad_contract, wait_for
from map_samples import letter
from matplotlib.image import imread
from view_samples import CONTRACT, Mapped, Press, live_page, tell

from edge.api import NextTap, Note, Wrench

__all__ = ["browser", "open_page"]

# Whether anything is drawn over a pattern around a share of its width and height.
DRAWN = """([x, y]) => {
  const canvas = document.querySelector('[data-part="over"]');
  const [left, top] = [Math.round(x * canvas.width) - 1, Math.round(y * canvas.height) - 1];
  return canvas.getContext("2d").getImageData(left, top, 3, 3).data.some((one, at) => at % 4 === 3 && one > 0);
}"""
CENTRE, PITCH = 0.5, 2.35 / 18.8
"""Middle of a pad and half a taxel's pitch, as shares of its width."""
LIT = """() => {
  const canvas = document.getElementById("map-over");
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  const lit = [];
  for (let at = 0; at < canvas.width * canvas.height; at++)
    if (data[4 * at] > 200 && data[4 * at + 3] > 200) lit.push(at);
  return [canvas.width, canvas.height, ...lit];
}"""


def drawn(page, x, y):
    return page.evaluate(DRAWN, [x, y])


def picture_of(page):
    return imread(BytesIO(web.part(page, "field").screenshot()))[..., :3]


def red_share(page):
    picture = picture_of(page)
    return float(np.mean((picture[..., 0] > 0.55) & (picture[..., 0] > 2 * picture[..., 1])))


def test_force_and_torque_are_told_and_drawn(open_page):
    contract = make_pad_contract(interval_factor=1.6)
    wrench = Wrench((0.3, 0.0, 0.4), (-0.94, 0.94, -1.25), (-2.35, -2.35), 0.75)
    made = replace(Press(contract=contract).next(), wrench=wrench)
    shows = [made]
    with live_page(contract=contract) as shown, shown.playing(lambda: shows[0]):
        page = open_page(shown.view.url)
        web.live(page)
        newtons = made.force_counts / contract.nominal_counts_per_newton
        web.expect(web.part(page, "force-now")).to_have_text(f"{newtons:.2f}\u202fN nominal")
        shows[0] = replace(made, force_n=3.0)
        web.expect(web.part(page, "force-now")).to_have_text("3.00\u202fN")
        for name, text in {
            "wrench_force": r"0\.30, 0\.00, 0\.40\sN",
            "wrench_torque": r"\u22120\.9, 0\.9\sN\smm",
            "wrench_twist": r"\u22121\.[23]\sN\smm",
            "centre_of_pressure_mm": r"\u22122\.[34], \u22122\.[34]\smm",
            "wrench_origin": r"nominal \u00b1 45\s%",
        }.items():
            web.expect(web.number(page, name)).to_have_text(re.compile(f"^{text}$"))
        centre = CENTRE - PITCH
        assert drawn(page, centre + 0.1, centre), "the arrow of the shear, 0.24 of the width to the right"
        assert not drawn(page, centre - 0.1, centre) and not drawn(page, centre + 0.3, centre)


def test_the_pad_is_outlined_where_to_touch_next(open_page):
    press = Press()
    idle, contact = press.next(0), press.next(3000)
    shows = [idle]
    with live_page() as shown, shown.playing(lambda: shows[0]):
        page = open_page(shown.view.url)
        next_tap, state = web.expect(web.number(page, "next_tap")), web.expect(web.part(page, "word"))
        for result, text in ((idle, "idle"), (contact, "contact")):
            shows[0] = result
            state.to_have_text(text)
        assert web.number(page, "wrench_force").count() == 0
        web.expect(web.part(page, "verdict")).to_have_text("not checked: the model has no checks")
        web.expect(web.number(page, "trusted")).to_have_text(re.compile("not checked|\u2013"))
        shows[0] = idle
        state.to_have_text("idle")
        next_tap.to_have_text("\u2013")
        arrows = {side: [CENTRE + side * PITCH / 2] * 2 for side in (1, -1)}  # the arrow begins at the centre
        assert not drawn(page, *arrows[1])
        for side, x, y in ((1, "right", "down"), (-1, "left", "up")):
            shows[0] = replace(idle, next_tap=NextTap(2.35 * side, 2.35 * side, 0.0))
            next_tap.to_have_text(f"2.4\u202fmm {x}, 2.4\u202fmm {y}")
            page.wait_for_function(DRAWN, arg=arrows[side])
            assert not drawn(page, *arrows[-side])
        shows[0] = contact
        state.to_have_text("contact")
        next_tap.to_have_text("\u2013")
        assert not drawn(page, *arrows[-1])


def test_a_doubted_pattern_cannot_be_taken_for_a_believed_one(open_page):
    contact = Press().next()
    believed = replace(contact, trusted=True, mismatch=0.021)
    unbelieved = replace(contact, trusted=False, mismatch=0.4, untrusted_reason="unfamiliar")
    text = "baseline in doubt: most taxels are off it; free the pad and zero again"
    doubt = {"state": "baseline_in_doubt", "contact": None, "trusted": False, "untrusted_reason": "baseline"}
    in_doubt = replace(contact, notes=(Note("baseline_in_doubt", text),), area_mm2=None, **doubt)
    shows = [believed]
    contract = replace(CONTRACT, trust={"made": "of something"})
    with live_page(contract=contract) as shown, shown.playing(lambda: shows[0]):
        page = open_page(shown.view.url)
        verdict, trusted = web.expect(web.part(page, "verdict")), web.expect(web.number(page, "trusted"))
        web.live(page)
        trusted.to_have_text("yes")
        web.expect(web.number(page, "mismatch")).to_have_text("2.1\u202f%")
        verdict.to_be_hidden()
        assert red_share(page) < 0.01

        shows[0] = unbelieved
        web.word(page, "contact, not believed")
        verdict.to_contain_text("not to be believed: readings like no contact (a magnet or steel near? the id map?")
        web.expect(page.locator("#live")).to_have_text("sensor 4: contact, not believed")
        trusted.to_have_text("no: unfamiliar")
        web.resize(page, 844, 390)
        verdict.to_be_in_viewport()
        wait_for(lambda: red_share(page) > 0.25)

        shows[0] = replace(contact, trusted=None)
        verdict.to_have_text("too light to check whether the pattern is to be believed")
        trusted.to_have_text("too light to check")
        web.word(page, "contact")
        assert red_share(page) < 0.01

        shows[0] = in_doubt
        web.word(page, "baseline in doubt")
        web.expect(web.part(page, "stamp")).to_have_text(f"{text} (key z)")
        web.expect(web.part(page, "stamp")).to_be_visible()
        verdict.to_be_hidden()
        trusted.to_have_text("no: baseline")
        assert np.ptp(picture_of(page), axis=2).max() < 0.1, "a colour"

        forgotten = "the tap before does not belong to this contact, and is forgotten"
        tell(shown, "tap_dropped", "4", forgotten)
        tell(shown, "suspected", "4", "several contacts in a row read like none")
        web.logged(page, f"sensor 4: {forgotten}")
        suspected = re.compile("several contacts in a row read like none")
        web.expect(page.locator("#log .bad")).to_have_text(suspected)


def shown_on(page):
    return web.colours_of(page.locator("#map-contact").evaluate(web.RGBA))


def outline(page):
    """Return the least and the largest x and the least y of what is drawn above the bar of the scale, in [mm]."""
    width, height, *lit = page.evaluate(LIT)
    at = np.array(lit, dtype=int)
    x_mm, y_mm = (at % width + 0.5) / width * 60 - 30, (at // width + 0.5) / height * 60 - 30
    pad = y_mm < 23
    return (x_mm[pad].min(), x_mm[pad].max(), y_mm[pad].min()) if pad.any() else (np.nan,) * 3


def test_a_map_grows_and_who_comes_late_misses_nothing(open_page):
    with live_page() as shown:
        mapped = Mapped(shown, letter)
        page = open_page(shown.view.url)
        counts = web.expect(page.locator("#map-counts"))
        web.expect(page.locator("#map")).to_be_hidden()
        shown.play()
        mapped.touch(-12.0, -8.0)
        web.expect(page.locator("#map")).to_be_visible()
        mapped.touch(-12.0, 8.0)
        mapped.touch(2.0, 16.0)
        mapped.touch(20.0, -20.0, 30.0, trusted=False)
        counts.to_have_text("EMULATED: 3 patterns")
        mapped.touch(0.0, 0.0, posed=False)
        counts.to_have_text("EMULATED: 3 patterns, 1 not believed, 1 without a pose")
        rgba, layers = shown_on(page), mapped.sink.whole.layers()
        known = np.isfinite(layers.contact)
        assert (rgba[..., 3] == 255).sum() == (known | (layers.doubted > 0)).sum()
        assert (rgba[known & (layers.contact > 0.9)][:, 0] > 200).all(), "touched is the light end of the scale"
        assert (rgba[known & (layers.contact < 0.1)][:, 0] < 80).all()
        red = ~known & (layers.doubted > 0)
        assert red.sum() > 1000 and (rgba[red][:, :3] == (200, 40, 30)).all()
        mapped.touch(10.0, -5.0, 45.0)
        reach = 9.4 * 2**0.5
        around = pytest.approx((10 - reach, 10 + reach, -5 - reach), abs=0.5)
        wait_for(lambda: outline(page) == around)

        for y_mm in (16.0, 0.0, -16.0):
            mapped.touch(-20.0, y_mm)
        late = open_page(shown.view.url)
        layers = mapped.sink.whole.layers()
        for one in (page, late):
            web.expect(one.locator("#map-counts")).to_contain_text("EMULATED: 6 patterns")
            there = shown_on(one)[..., 3] == 255
            assert np.array_equal(there, np.isfinite(layers.contact) | (layers.doubted > 0))


def pump(source, sink):
    with contextlib.suppress(OSError):
        while data := source.recv(65536):
            sink.sendall(data)
    with contextlib.suppress(OSError):
        sink.shutdown(socket.SHUT_WR)


@contextlib.contextmanager
def proxy(port, *, host=None, sockets=True):
    """Serve the page at `port` below a path, with another Host as nginx sends it; yield the address."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            if not self.path.startswith("/edge/") or (sockets is None and "/ws" in self.path):
                self.send_error(502)
                return
            if host is not None:
                self.headers.replace_header("Host", host.format(port=port))
            for name in () if sockets else ("Upgrade", "Connection"):
                del self.headers[name]
            upstream = socket.create_connection(("127.0.0.1", port))
            upstream.sendall(f"GET {self.path.removeprefix('/edge')} HTTP/1.1\r\n".encode())
            upstream.sendall(self.headers.as_bytes(policy=HTTP))
            threading.Thread(target=pump, args=(upstream, self.connection), daemon=True).start()
            pump(self.connection, upstream)

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/edge/"
        server.shutdown()


@pytest.mark.parametrize(
    ("settings", "token", "query", "words"),
    [
        ({}, None, "", None),
        ({"host": "edge_up"}, web.TOKEN, f"?token={web.TOKEN}", None),
        ({"host": "127.0.0.1:{port}"}, None, "", "may not send requests to this server"),
        ({}, web.TOKEN, "", "the token is missing or wrong"),
        ({"sockets": False}, None, "", "a proxy must send HTTP/1.1 with the headers Upgrade and Connection"),
        ({"sockets": None}, None, "", "answers 502 for /edge/ws, and not edge-sr"),
    ],
)
def test_behind_a_proxy_a_page_finds_its_socket_or_says_why_not(open_page, settings, token, query, words):
    with live_page(token=token) as view, proxy(view.port, **settings) as url:
        page = open_page(url + query)
        if words is not None:
            web.expect(page.locator("#trouble")).to_contain_text(words)
            return
        web.expect(page.locator("#link")).to_have_attribute("data-up", "yes")
        page.reload()
        web.expect(page.locator("#link")).to_have_attribute("data-up", "yes")
        page.close()  # before what it is connected to

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from edge.terminal.heatmap import HALF_BLOCK, SHADES, STOPS, Panel, choose_palette, draw, resample

ESCAPE = re.compile(r"\x1b\[[0-9;]*m")
PALETTES = ["truecolor", "256", "plain"]


def visible(text):
    return [ESCAPE.sub("", line) for line in text.splitlines()]


def panel(values=None, title="title", low=0.0, high=1.0):
    return Panel(title, np.eye(4) if values is None else values, low, high, "mm")


sizes = st.integers(1, 9)
digits = st.integers(-9, 9).map(float)
images = st.tuples(sizes, sizes).flatmap(lambda shape: arrays(np.float64, shape, elements=digits))


@settings(deadline=None)
@given(images, sizes, sizes)
def test_resampling_is_the_mean_over_each_new_cell(image, height, width):
    fine = np.kron(image, np.ones((height, width)))
    exact = fine.reshape(height, image.shape[0], width, image.shape[1]).mean(axis=(1, 3))
    np.testing.assert_allclose(resample(image, height, width), exact, atol=1e-12)


def test_finer_cells_repeat_values():
    np.testing.assert_allclose(resample(np.arange(4.0).reshape(2, 2), 4, 6), np.kron([[0, 1], [2, 3]], np.ones((2, 3))))


@pytest.mark.parametrize("palette", PALETTES)
@pytest.mark.parametrize("columns", [1, 5, 6, 7, 8, 19, 20, 39, 40, 63, 64, 79, 80, 123, 124, 300])
def test_no_line_is_wider_than_the_terminal(palette, columns):
    panels = [panel(title="a title longer than some of these terminals"), panel(np.eye(40)), panel(high=1e-7)]
    lines = visible(draw(panels, columns, palette))
    assert max(map(len, lines)) <= min(columns, 124)


def test_side_by_side_where_there_is_room_else_below_each_other():
    panels = [panel(title=name) for name in ("one", "two", "three")]
    wide, narrow = visible(draw(panels, 76, "plain")), visible(draw(panels, 75, "plain"))
    assert [line.split() for line in (wide[0],)] == [["one", "two", "three"]]
    assert len(wide) == 1 + 12 + 1
    assert [line.strip() for line in narrow if line.strip() in ("one", "two", "three")] == ["one", "two", "three"]
    assert len(narrow) == 3 * (1 + 20 + 1) + 2


@pytest.mark.parametrize("columns", range(76, 130))
def test_taxels_side_by_side_have_sharp_borders(columns):
    lines = draw([panel(np.eye(4)), panel(), panel()], columns, "plain").splitlines()[1:-1]
    assert set("".join(lines)) == {SHADES[0], SHADES[-1]}


def test_plain_is_ascii_denser_where_larger():
    values = np.array([[0.0, 0.25], [0.5, 1.0]])
    lines = draw([panel(values)], 40, "plain").splitlines()
    assert "".join(lines).isascii() and "\x1b" not in "".join(lines)
    body = [line.ljust(40) for line in lines[1:-1]]
    assert len(body) == 20
    corners = [body[0][0], body[0][-1], body[-1][0], body[-1][-1]]
    assert corners == [SHADES[0], SHADES[2], SHADES[5], SHADES[-1]]


@pytest.mark.parametrize("palette", ["truecolor", "256"])
def test_a_cell_shows_the_upper_pixel_over_the_lower(palette):
    values = np.zeros((40, 40))
    values[0] = 1.0
    line = draw([panel(values)], 40, palette).splitlines()[1]
    low, high = ("2;68;1;84", "2;253;231;37") if palette == "truecolor" else ("5;53", "5;220")
    assert line == f"\x1b[38;{high};48;{low}m{HALF_BLOCK * 40}\x1b[0m"


def test_colours_end_with_their_line_so_that_nothing_runs_over():
    for line in draw([panel(np.eye(40)), panel()], 90, "truecolor").splitlines():
        assert "\x1b[" not in line or line.endswith("\x1b[0m") or not line.rpartition("\x1b[0m")[2].count("\x1b")


def test_values_beyond_the_scale_are_clipped_and_a_flat_scale_is_dark():
    line = draw([panel(np.array([[-5.0, 5.0]]))], 40, "plain").splitlines()[1]
    assert line == " " * 20 + "@" * 20
    assert set(draw([panel(np.zeros((2, 2)), high=0.0)], 40, "plain").splitlines()[1]) <= {" "}


def test_the_scale_names_both_ends_and_the_unit():
    last = draw([panel(high=1.234)], 40, "plain").splitlines()[-1]
    assert last.startswith("0 ") and last.endswith(f"{SHADES[-1]} 1.23 mm") and len(last) == 40


@pytest.mark.parametrize(("high", "text"), [(0.0123, "0.0123"), (99.96, "100"), (1613.4, "1613"), (12345.6, "12346")])
def test_the_scales_numbers_are_short(high, text):
    assert draw([panel(high=high)], 40, "plain").endswith(f" {text} mm")


def test_the_map_of_colours_grows_steadily_lighter():
    lightness = STOPS @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(lightness) > 5).all()


@pytest.mark.parametrize(
    ("environment", "terminal", "encoding", "palette"),
    [
        ({"TERM": "xterm", "COLORTERM": "truecolor"}, True, "utf-8", "truecolor"),
        ({"TERM": "xterm", "COLORTERM": "24bit"}, True, "utf-8", "truecolor"),
        ({"TERM": "xterm"}, True, "utf-8", "256"),
        ({"TERM": "xterm", "COLORTERM": "yes"}, True, "utf-8", "256"),
        ({"TERM": "xterm", "NO_COLOR": "1"}, True, "utf-8", "plain"),
        ({"TERM": "xterm", "NO_COLOR": ""}, True, "utf-8", "256"),
        ({"TERM": "dumb", "COLORTERM": "truecolor"}, True, "utf-8", "plain"),
        ({"COLORTERM": "truecolor"}, True, "utf-8", "plain"),
        ({"TERM": "xterm"}, False, "utf-8", "plain"),
        ({"TERM": "xterm"}, True, "ascii", "plain"),
        ({"TERM": "xterm"}, True, "latin-1", "plain"),
        ({"TERM": "xterm"}, True, None, "plain"),
        ({"TERM": "xterm"}, True, "no such encoding", "plain"),
    ],
)
def test_the_palette_is_what_the_output_can_show(environment, terminal, encoding, palette):
    assert choose_palette(environment, terminal=terminal, encoding=encoding) == palette

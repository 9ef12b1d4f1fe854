"""Maps as text for a terminal: arrays in, lines out.

With colour, one character cell shows two pixels, an upper half block in one of 256 colours on a ground of another.
Without colour, a cell is one character, denser for larger values.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

# A few stops of viridis, which reads the same to the colour-blind and grows steadily lighter.
STOPS: Final = np.array(
    [
        *((68, 1, 84), (72, 40, 120), (62, 74, 137), (49, 104, 142), (38, 130, 142)),
        *((31, 158, 137), (53, 183, 121), (109, 205, 89), (180, 222, 44), (253, 231, 37)),
    ],
    dtype=np.float64,
)
SHADES: Final = " .:-=+*#%@"
HALF_BLOCK: Final = "\N{UPPER HALF BLOCK}"
GAP: Final = 2


@dataclass(frozen=True, slots=True)
class Panel:
    """Map to draw: (H, W) values, shown from `low` to `high` [unit]."""

    title: str
    values: NDArray[np.floating]
    low: float
    high: float
    unit: str


def shows_colours(environment: Mapping[str, str], *, terminal: bool, encoding: str | None) -> bool:
    """Return whether the output can show colours, by its encoding and the variables NO_COLOR and TERM."""
    try:
        HALF_BLOCK.encode(encoding or "ascii")
    except (UnicodeEncodeError, LookupError):
        return False
    return terminal and not environment.get("NO_COLOR") and environment.get("TERM", "dumb") != "dumb"


def draw(panels: Sequence[Panel], columns: int, coloured: bool, widest: int = 40) -> str:
    """Draw panels side by side, or below each other if the terminal of so many columns is too narrow.

    No panel is wider than `widest` columns.
    """
    width = min(widest, (columns - GAP * (len(panels) - 1)) // len(panels))
    width -= width % 8  # with half as many lines, a map of 4 x 4 then has sharp borders
    if width < 20:
        width = max(1, min(widest, columns))
        return "\n\n".join("\n".join(_lines(panel, width, coloured)) for panel in panels)
    rows = zip(*(_lines(panel, width, coloured) for panel in panels), strict=True)
    return "\n".join((" " * GAP).join(row).rstrip() for row in rows)


def resample(values: NDArray[np.floating], height: int, width: int) -> NDArray[np.float64]:
    """Return means of (H, W) values over the cells of a height x width grid; finer cells repeat values."""
    return _overlaps(values.shape[0], height) @ values.astype(np.float64) @ _overlaps(values.shape[1], width).T


def _overlaps(old: int, new: int) -> NDArray[np.float64]:
    """Return the share (new, old) of each old cell in each new one, on one unit length."""
    old_edges, new_edges = np.arange(old + 1) / old, np.arange(new + 1) / new
    upper = np.minimum(new_edges[1:, None], old_edges[None, 1:])
    lower = np.maximum(new_edges[:-1, None], old_edges[None, :-1])
    return np.maximum(upper - lower, 0) * new


def _lines(panel: Panel, width: int, coloured: bool) -> list[str]:
    """Return title, map and scale, each `width` cells wide."""
    span = panel.high - panel.low
    height = max(1, width * panel.values.shape[0] // (2 * panel.values.shape[1]))
    pixel_rows = 2 * height if coloured else height
    shares = (resample(panel.values, pixel_rows, width) - panel.low) / (span if span > 0 else 1)
    shares = np.clip(shares, 0, 1)
    if coloured:
        body = [_blocks(upper, lower) for upper, lower in zip(shares[::2], shares[1::2], strict=True)]
    else:
        body = ["".join(row) for row in _shades(shares)]
    return [panel.title[:width].ljust(width), *body, _scale(panel, width, coloured)]


def _scale(panel: Panel, width: int, coloured: bool) -> str:
    low, high = f"{_short(panel.low)} ", f" {_short(panel.high)} {panel.unit}"
    room = width - len(low) - len(high)
    if room < 0:
        return f"{low}..{high}"[:width].ljust(width)
    steps = np.linspace(0, 1, room)
    return low + (_blocks(steps, steps) if coloured else "".join(_shades(steps))) + high


def _short(value: float) -> str:
    return f"{value:.3g}" if abs(value) < 100 else f"{value:.0f}"


def _shades(shares: NDArray[np.float64]) -> NDArray[np.str_]:
    levels = np.array(list(SHADES))
    return levels[np.minimum((shares * len(SHADES)).astype(int), len(SHADES) - 1)]


def _blocks(upper: NDArray[np.float64], lower: NDArray[np.float64]) -> str:
    """Return one line of half blocks; a colour is set only where it changes."""
    text, last = [], ""
    for top, bottom in zip(_colour_codes(upper), _colour_codes(lower), strict=True):
        colour = f"\x1b[38;{top};48;{bottom}m"
        text.append(HALF_BLOCK if colour == last else colour + HALF_BLOCK)
        last = colour
    return "".join(text) + "\x1b[0m"


def colours(shares: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return colours (..., 3), red, green and blue in 0..255, of shares (...) in 0..1."""
    positions = np.linspace(0, 1, len(STOPS))
    channels = [np.interp(shares, positions, STOPS[:, channel]) for channel in range(3)]
    return np.stack(channels, axis=-1).astype(np.float64)


def _colour_codes(shares: NDArray[np.float64]) -> list[str]:
    cube = np.abs(colours(shares)[..., None] - np.array([0, 95, 135, 175, 215, 255])).argmin(axis=-1)
    return [f"5;{16 + 36 * red + 6 * green + blue}" for red, green, blue in cube.tolist()]

"""Files of a map: its layers as npz, and a picture as PNG."""

import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from edge.mapping.object_map import MapLayers, ObjectMap

FORMAT: Final = "tactile-object-map"
_GAP_PX: Final = 8
_EMULATED: Final = (
    "### #   # #  # #    ##  ### ### ## ",
    "#   ## ## #  # #   #  #  #  #   # #",
    "##  # # # #  # #   ####  #  ##  # #",
    "#   #   # #  # #   #  #  #  #   # #",
    "### #   #  ##  ### #  #  #  ### ## ",
)
"""Rows of a word that a picture of emulated data bears, since it may be shown without its name."""


def save_npz(path: Path, whole: ObjectMap, **facts: str) -> None:
    """Write the layers of a map, its place and its counts; facts are added as texts."""
    layers = whole.layers()
    arrays: dict[str, Any] = {name: getattr(layers, name) for name in MapLayers.__dataclass_fields__}
    arrays |= {f"{name}_patterns": np.array(count) for name, count in whole.counts.items()}
    arrays |= {name: np.array(text) for name, text in facts.items()}
    arrays |= {"px_per_mm": np.array(whole.grid.px_per_mm), "centre_mm": np.array(whole.grid.centre_mm)}
    np.savez_compressed(path, format=np.array(FORMAT), version=np.array(1), **arrays)


def check_npz(path: Path) -> None:
    """Read a file back, as its readers will; raises ValueError or KeyError if it is not a map."""
    with np.load(path, allow_pickle=False) as data:
        shapes = {data[name].shape for name in MapLayers.__dataclass_fields__}
        if str(data["format"]) != FORMAT or len(shapes) != 1:
            raise ValueError(f"{path} is not a map")


def save_png(path: Path, whole: ObjectMap, **facts: str) -> None:
    """Write the contact layer as a picture, and beside it the height from its lowest part to the map's top.

    White is not covered, or in the height not touched; red was covered by patterns alone that were not believed. Facts
    are added as texts; where one is that the map is of an emulated sensor, a line above the picture states that.
    """
    layers = whole.layers()
    heights_mm = layers.height_mm
    lowest_mm = min(float(np.nanmin(heights_mm)), -1e-6) if np.isfinite(heights_mm).any() else -1.0
    doubted = (layers.doubted > 0) & ~(layers.coverage > 0)
    times = -(-480 // whole.grid.pixels)  # so that a layer's picture is at least 480 pixels wide
    panels = [_coloured(layers.contact, doubted), _coloured(1 - heights_mm / lowest_mm, doubted)]
    large = [np.repeat(np.repeat(panel, times, axis=0), times, axis=1) for panel in panels]
    gap = np.full((len(large[0]), _GAP_PX, 3), 255, dtype=np.uint8)
    picture = np.concatenate([large[0], gap, large[1]], axis=1)
    if facts.get("origin") == "emulated":
        picture = np.concatenate([_emulated_line(picture.shape[1]), picture])
    path.write_bytes(png(picture, facts))


def _emulated_line(width: int) -> NDArray[np.uint8]:
    """Return a line (height, width, 3) with the word EMULATED, white on black."""
    word = np.array([[mark == "#" for mark in row] for row in _EMULATED]).repeat(6, 0).repeat(6, 1)
    line = np.zeros((len(word) + 2 * _GAP_PX, width, 3), dtype=np.uint8)
    line[_GAP_PX:-_GAP_PX, _GAP_PX : _GAP_PX + word.shape[1]][word] = 255
    return line


def _coloured(shares: NDArray[np.floating], doubted: NDArray[np.bool_]) -> NDArray[np.uint8]:
    from edge.terminal.heatmap import colours  # not loaded by a run without a picture

    known = np.isfinite(shares)
    pixels = colours(np.where(known, shares, 0)).astype(np.uint8)
    pixels[~known] = 255
    pixels[doubted] = (200, 40, 30)
    return pixels


def png(pixels: NDArray[np.uint8], facts: Mapping[str, str] = MappingProxyType({})) -> bytes:
    """Return a PNG of pixels (H, W, 3), red, green and blue, with texts: so few chunks that no library is needed."""
    height, width = pixels.shape[:2]
    # Every line begins with its filter, 0 for none.
    lines = np.concatenate([np.zeros((height, 1), np.uint8), pixels.reshape(height, -1)], axis=1)
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)  # 8 bits a channel, true colour
    texts = [(b"iTXt", f"{name}\0\0\0\0\0{text}".encode()) for name, text in facts.items()]
    chunks = ((b"IHDR", header), *texts, (b"IDAT", zlib.compress(lines.tobytes(), 6)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(kind, data) for kind, data in chunks)


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

"""Samples for the map's tests: perfect patterns of a figure under a pad at any pose."""

import numpy as np
from edge_samples import make_scan

from edge.perception.result import Result
from firmware_bridge.links.base import SourceKind
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.poses import PadPose

PIXEL_MM = USPA44.pixel_pitch_mm(10)
SAMPLES = 4
DEVIATION_MM = 0.01


def letter(x_mm, y_mm):
    """Return the height of an L, 40 mm tall with strokes of 8 mm: 0 on it, -1 mm beside it."""
    upright = (np.abs(x_mm + 12) <= 4) & (np.abs(y_mm) <= 20)
    foot = (np.abs(y_mm - 16) <= 4) & (x_mm >= -16) & (x_mm <= 14)
    return np.where(upright | foot, 0.0, -1.0)


def dome(x_mm, y_mm):
    return -(x_mm**2 + y_mm**2) / (2 * 200.0)


def pattern_of(height, pose, indentation_mm):
    """Return what a perfect sensor would see: how deep each part is pressed in, the mean over each pixel."""
    side = 40 * SAMPLES
    along = (np.arange(side) - (side - 1) / 2) * PIXEL_MM / SAMPLES
    x_mm, y_mm = np.meshgrid(along, along)
    turn = np.radians(pose.turn_deg)
    right = pose.x_mm + np.cos(turn) * x_mm - np.sin(turn) * y_mm
    down = pose.y_mm + np.sin(turn) * x_mm + np.cos(turn) * y_mm
    under = height(right, down)
    pressed = np.maximum(under - under.max() + indentation_mm, 0)
    return pressed.reshape(40, SAMPLES, 40, SAMPLES).mean(axis=(1, 3)).astype(np.float32)


def result_of(
    height, pose, indentation_mm=0.3, *, number=0, posed=True, sensor="4", source: SourceKind = "replay", **changes
):
    """Return the result of a press, with its pose unless it is not `posed`; changes are of its fields."""
    pattern = pattern_of(height, pose, indentation_mm)
    known = {
        "contact": True,
        "pattern": pattern,
        "pattern_unit": "mm",
        "deviation": np.full_like(pattern, DEVIATION_MM),
        "trusted": True,
        "force_counts": 10_000 * indentation_mm,
        "pose": pose if posed else None,
    }
    return Result(make_scan(number, sensor=sensor), source, "perfect", "contact", **known | changes)


def raster(turns=(0.0,), step_mm=4.0):
    """Return poses of taps all over a figure, with no error, at turns one after the other."""
    places = np.arange(-24.0, 24.1, step_mm)
    both = [(x, y) for y in places for x in places]
    return [PadPose(float(x), float(y), turns[number % len(turns)], 0.0, 0.0) for number, (x, y) in enumerate(both)]


def pixels_mm(grid):
    """Return x and y of a map's pixels."""
    along = (np.arange(grid.pixels) - (grid.pixels - 1) / 2) / grid.px_per_mm
    return np.meshgrid(along + grid.centre_mm[0], along + grid.centre_mm[1])

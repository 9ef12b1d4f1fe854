"""Recordings as a controller would send them: of the demo, and of two fingers that grip things."""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import affinity
from shapely.geometry.base import BaseGeometry

from edge.cli.demo import Scene
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.poses import PLACE_ERROR_MM, TURN_ERROR_DEG
from firmware_bridge.recording.npz_recording import NPZ_FORMAT, NPZ_VERSION
from firmware_bridge.schedule import RATE_HZ
from train.data.presses import SEED
from train.families.catalogue import tap
from train.physics.contact import BARE
from train.physics.gripped import FINE_SCALE, SCALE, GrippedPad, Taps, between_frames
from train.physics.magnets import Magnet, dipole_mt
from train.physics.pad_draws import NOMINAL, draw_pad
from train.physics.sensor_noise import Nuisances, apply_nuisances
from train.physics.tpsf import resample
from train.surfaces.depth_image import Pose
from train.surfaces.named_surfaces import FIGURE_HEIGHT_MM, figure
from train.surfaces.poses import ANGLE_STEP_DEG, PLACES_MM

SURFACE: Final = "glyph:1"  # a figure that no network was trained on: of those of the paper one tap shows nearly all
FOREIGN: Final = "small circle"
_PLACE_MM: Final = PLACES_MM["test"]
ANGLE_DEG: Final = 30.0  # angle of the last scored tap; each tap before is a step back, each later one a step on
TAPS: Final = 4
FORCE_N: Final = 5.0
REST_FRAMES, PRESS_FRAMES, HOLD_FRAMES, LIFT_FRAMES, GAP_FRAMES, STILL_FRAMES = 150, 20, 24, 12, 24, 30
TAP_FRAMES: Final = PRESS_FRAMES + HOLD_FRAMES + LIFT_FRAMES + GAP_FRAMES
MAGNET_FRAMES, MAGNET_ALONE_FRAMES = 80, 30  # in which it comes, and leaves; for which it stays before a tap
_TOWARDS: Final = (0.5, -0.3, 0.8)
_MOMENT: Final = (-0.3, -0.8, 0.5)
# Width of the long letter, which one lane of the pad covers, and its place in the object's plane, beside the taps.
LETTER_WIDTH_MM, LETTER_Y_MM, LETTER_PX_PER_MM = 14.0, 60.0, 4.0
FIGURE_MM: Final = 50.0  # longest side of the long letter
HALF_LENGTH_MM: Final = 30.0
_RASTER_MM: Final = 0.05
_INDENTATION_MM: Final = (0.15, 0.4)
_HEAD: Final = {"format": np.array(NPZ_FORMAT), "version": np.array(NPZ_VERSION), "rate_hz": np.array(RATE_HZ)}
# The zero is a second old: no drift yet, and the pad has not moved in the earth's field.
_SENSOR: Final = Nuisances().without("thermal_drift_counts", "earth_field_counts")


def demo_recording() -> dict[str, NDArray]:
    """Return the demo as a controller would send it, with the truth of every scored frame, and the robot's poses.

    The pad rests, then presses, holds and lifts four times, turned a step each time, at the held-out position. In the
    scenes another surface is tapped before the next tap of the first one; then a magnet comes near the free pad, which
    is tapped meanwhile, and leaves; then the pad slides over a long letter.
    """
    pad = GrippedPad(NOMINAL)
    angles_deg = [ANGLE_DEG + step * ANGLE_STEP_DEG for step in range(1 - TAPS, 1)]
    taps = tap(pad, [SURFACE] * TAPS, [Pose(*_PLACE_MM, angle) for angle in angles_deg], FORCE_N)
    pressed = _read(taps, angles_deg)
    later_deg = [ANGLE_DEG + step * ANGLE_STEP_DEG for step in range(1, TAPS + 1)]
    surfaces, poses = [FOREIGN, SURFACE, SURFACE, SURFACE], [Pose(*_PLACE_MM, angle) for angle in later_deg]
    later = _read(tap(pad, surfaces, poses, FORCE_N), later_deg)
    magnet = _magnet()
    magnet[MAGNET_FRAMES + MAGNET_ALONE_FRAMES :][:TAP_FRAMES] += later[2]
    rng = np.random.default_rng([SEED, 2])
    still = _noise(rng, REST_FRAMES).round()
    level = np.array([32700.0, 32800.0, 37400.0])[:, None, None]
    rest = (level + rng.standard_normal(USPA44.scan_shape) * 300.0).astype(np.float32).round()
    magnet += _noise(rng, len(magnet))
    slid, way, letter = _slide(pad)
    after = _noise(rng, STILL_FRAMES).round()
    parts = [still, *pressed, later[0], later[1], magnet.round(), slid, after]
    counts = rest + np.concatenate(parts)
    scenes = [Scene.FREE] * (1 + TAPS) + [Scene.FOREIGN] * 2 + [Scene.MAGNET, Scene.SLIDE, Scene.FREE]
    lengths = [len(part) for part in parts]
    scene = np.repeat(scenes, lengths)
    begins = np.cumsum([0, *lengths])
    scene[begins[-3] - GAP_FRAMES : begins[-3]] = Scene.FREE
    end_mm = taps.indentation_mm[:, -1]
    share, number = np.zeros(len(counts)), np.zeros(len(counts), dtype=int)
    scored = slice(REST_FRAMES, REST_FRAMES + TAPS * TAP_FRAMES)
    share[scored], number[scored] = np.tile(_course(), TAPS), np.repeat(np.arange(TAPS), TAP_FRAMES)
    tapped = [_stated(0, 0, angles_deg[0] - angle) for angle in (*angles_deg, *later_deg[:3])]
    return {
        **_HEAD,
        "sensor": np.full(len(share), "4"),
        "scan": np.arange(len(share)),
        "time_ns": (np.arange(len(share)) * 1e9 / RATE_HZ).astype(np.int64),
        "counts": counts.astype(np.int32),
        "tap": np.where(share > 0, number, -1),
        "indentation_mm": (share * end_mm[number]).astype(np.float32),
        "unit_patterns": resample(taps.unit_patterns, FINE_SCALE, SCALE).astype(np.float16),  # per mm
        "surface": np.array(SURFACE),
        "angles_deg": np.array(angles_deg),
        "tap_pose": np.array(tapped[:TAPS]),
        "scene": scene,
        **_poses(tapped, way, begins),
        "letter": letter,
        "letter_px_per_mm": np.array(LETTER_PX_PER_MM),
        "letter_centre_mm": np.array((0.0, LETTER_Y_MM)),
    }


def _noise(rng: np.random.Generator, frames: int) -> NDArray[np.float64]:
    return rng.normal(0, Nuisances().noise_counts, (frames, *USPA44.scan_shape))


def _stated(x_mm: float, y_mm: float, turn_deg: float) -> tuple[float, ...]:
    """Return the numbers of a pose as the robot states it."""
    return x_mm, y_mm, turn_deg, PLACE_ERROR_MM, TURN_ERROR_DEG


def _poses(
    tapped: Sequence[tuple[float, ...]], slid: NDArray[np.float64], begins: NDArray[np.int64]
) -> dict[str, NDArray]:
    """Return the arrays of a recording that hold its poses: one before each tap, and one in each frame of the slide."""
    before = begins[1 : 1 + len(tapped)] - GAP_FRAMES // 2
    way = [_stated(x_mm, y_mm + LETTER_Y_MM, turn_deg) for x_mm, y_mm, turn_deg in slid.tolist()]
    start, end = begins[-3], begins[-2]
    frame = np.concatenate([before, np.arange(start, end), [end]])
    holds = np.concatenate([np.ones(len(before), bool), np.zeros(len(way), bool), [True]])
    return {
        "pose_time_ns": (frame * 1e9 / RATE_HZ).astype(np.int64),
        "pose": np.array([*tapped, *way, way[-1]]),
        "pose_holds": holds,
    }


def _slide(pad: GrippedPad) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_]]:
    """Slide along a long letter that lies on its side: counts, stated poses, and the letter's pixels in its plane.

    The robot's error of pose is drawn once: that of a mounting by hand does not average out.
    """
    lying = affinity.rotate(figure("S"), 90, origin=(0, 0))
    left, low, right, high = lying.bounds
    flat = LETTER_WIDTH_MM / FIGURE_MM * (right - left) / (high - low)
    outline = affinity.scale(lying, 1, -flat, origin=(0, 0))
    left, low, right, high = outline.bounds
    x_mm, y_mm, factor = (left + right) / 2, (low + high) / 2, FIGURE_MM / max(right - left, high - low)
    outline = affinity.translate(affinity.scale(outline, factor, factor, origin=(x_mm, y_mm)), -x_mm, -y_mm)

    rng = np.random.default_rng([500, 18])
    length = round(2 * HALF_LENGTH_MM / 20.0 * RATE_HZ)  # 20 mm/s
    friction, turn_deg = rng.uniform(0.2, 0.8), float(rng.uniform(-10, 10))
    along_mm = np.linspace(-HALF_LENGTH_MM, HALF_LENGTH_MM, length)
    wave = np.sin(2 * np.pi * (np.arange(length) / length * rng.uniform(1, 3) + rng.random()))
    deep_mm = np.mean(_INDENTATION_MM) + wave * np.ptp(_INDENTATION_MM) / 2
    heights_mm = _heights_under(pad, outline, along_mm, turn_deg)
    meets = np.flatnonzero((heights_mm > -FIGURE_HEIGHT_MM / 2).any(axis=(1, 2)))
    none, turn = np.zeros(len(meets)), np.radians(turn_deg)
    # Movement in [mm] against the pad's face that friction carries, in the pad's axes: to the left.
    drag = -0.3 * np.stack([none + np.cos(turn), none - np.sin(turn)], axis=1)
    clean = np.zeros((length, *USPA44.scan_shape), dtype=np.float32)
    bare = [BARE] * len(meets)
    clean[meets] = pad.press(heights_mm[meets], deep_mm[meets], drag, none, none + friction, bare).counts
    off_mm, off_deg = rng.normal(0, PLACE_ERROR_MM, 2), rng.normal(0, TURN_ERROR_DEG)
    stated = np.stack([along_mm + off_mm[0], np.full(length, off_mm[1]), np.full(length, turn_deg + off_deg)], axis=1)
    read = apply_nuisances(clean[None, None], _SENSOR, SEED, tap_s=length / RATE_HZ, angle_deg=-turn_deg)[0, 0]

    count = round((FIGURE_MM + USPA44.width_mm) * LETTER_PX_PER_MM)
    middle = (np.arange(count) - (count - 1) / 2) / LETTER_PX_PER_MM
    return read, stated, shapely.contains_xy(outline, *np.meshgrid(middle, middle))


def _heights_under(
    pad: GrippedPad, outline: BaseGeometry, along_mm: NDArray[np.float64], turn_deg: float
) -> NDArray[np.float32]:
    """Return the heights (n, m, m) in [mm] of a raised figure under a turned pad at each place along it."""
    half = HALF_LENGTH_MM + USPA44.width_mm
    centres = np.arange(-half, half, _RASTER_MM) + _RASTER_MM / 2
    shapely.prepare(outline)
    inside = shapely.contains_xy(outline, *np.meshgrid(centres, centres))
    x_mm, y_mm = np.broadcast_arrays(*pad.places_mm)
    cosine, sine = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    right, down = along_mm[:, None, None] + cosine * x_mm - sine * y_mm, sine * x_mm + cosine * y_mm
    col, row = (np.clip(((at + half) / _RASTER_MM).astype(int), 0, len(centres) - 1) for at in (right, down))
    return np.where(inside[row, col], 0, -FIGURE_HEIGHT_MM).astype(np.float32)


def _course() -> NDArray[np.float64]:
    """Return the share of the press in each frame of a tap."""
    down, hold = np.linspace(0, 1, PRESS_FRAMES + 1)[1:], np.ones(HOLD_FRAMES)
    course = np.concatenate([down, hold, np.linspace(1, 0, LIFT_FRAMES + GAP_FRAMES)])
    course[-GAP_FRAMES:] = 0
    return course


def _read(taps: Taps, angles_deg: Sequence[float]) -> NDArray[np.float32]:
    """Return the readings (taps, frames, 3, rows, cols) of four taps, always by the same sensor."""
    counts = between_frames(taps.counts, np.tile(_course(), (TAPS, 1)))
    tap_s = TAP_FRAMES / RATE_HZ
    return apply_nuisances(counts[None, ::-1], _SENSOR, SEED, tap_s=tap_s, angle_deg=angles_deg[::-1])[0, ::-1]


def _magnet() -> NDArray[np.float32]:
    """Return the counts (n, 3, rows, cols) that a magnet adds that comes near, stays for a tap, and leaves."""
    far, near = 150.0, 45.0  # distance at which it begins and ends, and at which it stays, in [mm]
    coming = np.linspace(0, 1, MAGNET_FRAMES)
    course = np.concatenate([coming, np.ones(MAGNET_ALONE_FRAMES + TAP_FRAMES), coming[::-1], np.zeros(GAP_FRAMES)])
    distance_mm = (far + (near - far) * course)[:, None, None]
    x_mm, y_mm, z_mm = (distance_mm * part / math.hypot(*_TOWARDS) for part in _TOWARDS)
    east, south, up = (np.array(part / math.hypot(*_MOMENT)) for part in _MOMENT)
    chip_x_mm, chip_y_mm = USPA44.taxel_centres_mm().T.reshape(2, USPA44.rows, USPA44.cols)
    field_mt = dipole_mt(Magnet(), (chip_x_mm - x_mm, chip_y_mm - y_mm, -z_mm), (east, south, up))
    field = np.stack(np.broadcast_arrays(*field_mt), axis=1)
    field -= field[-1]
    # The largest count of any taxel and axis is half of that of the tap.
    return (field * (900.0 / np.abs(field).max())).astype(np.float32)


FINGERS: Final = ("4", "6")
_FREE, _CLOSE, _HOLD, _OPEN = 130, 25, 150, 25  # scans before and after each grip, and of its parts
_STEP: Final = 5  # scans from one solved press to the next; those between are interpolated
_FORCE_N: Final = 8.0
_DRIFT_COUNTS_PER_S: Final = 2.0  # of z, as a pad warms in a grip


def grip_recording() -> dict[str, NDArray]:
    """Return the arrays of a recording in which a pen and then a nut are gripped, lifted and let go."""
    fingers = [_finger(number) for number in range(len(FINGERS))]
    scans = len(fingers[0])
    time_ns = np.arange(scans) * 1e9 / RATE_HZ
    return {
        **_HEAD,
        "origin": np.full(scans * len(FINGERS), "emulated"),
        "sensor": np.tile(FINGERS, scans),
        "scan": np.repeat(np.arange(scans), len(FINGERS)),
        "time_ns": np.repeat(time_ns.astype(np.int64), len(FINGERS)),
        "counts": np.stack(fingers, axis=1).reshape(-1, *USPA44.scan_shape).astype(np.int32),
    }


def _finger(number: int) -> NDArray[np.float64]:
    """Return the raw counts (n, 3, rows, cols) of one finger; the second sees everything mirrored."""
    rng = np.random.default_rng([SEED, 4, number])
    pad = GrippedPad(draw_pad(rng))
    x_mm, y_mm = np.broadcast_arrays(*pad.places_mm)
    x_mm = -x_mm if number == 1 else x_mm
    away_mm = np.hypot(x_mm - 1.0, y_mm)
    pen = -((x_mm * np.cos(0.4) + y_mm * np.sin(0.4)) ** 2) / (2 * 6.0)
    nut = np.where((away_mm > 3.0) & (away_mm < 7.0), 0.0, -2.0)
    free = np.zeros((_FREE, *USPA44.scan_shape))
    clean = np.concatenate([free, _grip(pad, pen), free, _grip(pad, nut), free])
    duration_s = len(clean) / RATE_HZ
    read = apply_nuisances(clean[None, None].astype(np.float32), _SENSOR, int(rng.integers(2**31)), tap_s=duration_s)
    warming = np.array([0.0, 0.0, 1.0])[:, None, None] * _DRIFT_COUNTS_PER_S * rng.uniform(0.5, 1)
    drift = np.linspace(0, duration_s, len(clean))[:, None, None, None] * warming
    rest = np.array([32700.0, 32800.0, 37400.0])[:, None, None] + 300.0 * rng.standard_normal(USPA44.scan_shape)
    return np.rint(rest + read[0, 0] + drift)


def _grip(pad: GrippedPad, heights_mm: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return clean counts of one grip: it closes to its force, is lifted, which drags the pad down, and opens."""
    heights_mm = heights_mm.astype(np.float32)
    share = np.concatenate([np.linspace(0, 1, _CLOSE), np.ones(_HOLD), np.linspace(1, 0, _OPEN)])
    drag_mm = 0.15 * np.clip((np.arange(len(share)) - _CLOSE - _HOLD / 4) / (_HOLD / 4), 0, 1)
    solved = np.unique(np.append(np.arange(1, len(share) - 1, _STEP), len(share) - 2))
    depth_mm = 0.3
    for _ in range(3):  # both fingers carry the same force, to a few percent
        force_n = _loaded(pad, heights_mm, np.array([depth_mm]), np.zeros(1)).force_n[0, 2]
        depth_mm = float(np.clip(depth_mm * (_FORCE_N / force_n) ** 0.7, 0.05, 0.5))
    counts = _loaded(pad, heights_mm, np.maximum(depth_mm * share[solved], 1e-3), drag_mm[solved]).counts
    at = np.arange(len(share))
    flat = [np.interp(at, [0, *solved, at[-1]], [0, *column, 0]) for column in counts.reshape(len(solved), -1).T]
    return np.stack(flat, axis=1).reshape(-1, *USPA44.scan_shape).astype(np.float32)


def _loaded(pad: GrippedPad, heights_mm: NDArray[np.float32], depth_mm: NDArray, drag_mm: NDArray):
    count = len(depth_mm)
    slide = np.stack([np.zeros(count), drag_mm], axis=1)
    heights = np.broadcast_to(heights_mm, (count, *heights_mm.shape))
    return pad.press(heights, depth_mm, slide, np.zeros(count), np.full(count, 0.8), [BARE] * count)

"""Emulated robot that taps printed plates with a pad unlike all others, and states its poses with an error."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np
import shapely
import trimesh
from numpy.typing import NDArray

from firmware_bridge.pad_geometry import CHANNELS
from firmware_bridge.recording.csv_reader import CSV_POSES, csv_header
from firmware_bridge.scans.pad_constants import GAIN_SPREAD, LEVEL_90, Pad
from firmware_bridge.sensor_file.model import SensorEntry, SensorFile
from firmware_bridge.sensor_file.toml_writer import save_sensor_file
from train.data.presses import one_thread
from train.physics.gripped import SAMPLES, GrippedPad, between_frames
from train.physics.pad_draws import INPUTS, RANGES, draw_pad
from train.surfaces.depth_image import Pose, Relief, depth_image
from train.surfaces.named_surfaces import FIGURE_HEIGHT_MM, figure

PLACES_MM = (-2.5, 0.0, 2.5)
TURN_DEG = 30.0
FREE, RISE, HOLD, FALL = 20, 24, 4, 8  # scans of each tap
FORCE_N = 8.0  # of a tap, or as deep as the layer is linear
MISPLACED = np.array([0.3, -0.2, 0.3])  # of the plate in the frame of the poses: x, y in [mm], turn in [deg]
JITTER = np.array([0.05, 0.05, 0.2])  # of each pose
SIGNATURE = (0.04, 0.04, 0.085)  # of each channel over the mean z, as on two real sensors
KNOWN_TO = 0.02  # share of its range within which each constant of the pad is known
GRID_MM = 30.0  # distance of a printed plate's figures: a turned pad on one of them does not reach the next
PRINTED_MM = 4.0  # thickness of a printed plate, which must not bend


def grid_places_mm() -> list[tuple[float, float]]:
    """Return the middles of a plate's nine figures in [mm], row by row from the top left; y goes up."""
    return [(column * GRID_MM, -row * GRID_MM) for row in (-1, 0, 1) for column in (-1, 0, 1)]


def plate_mesh(names: Sequence[str]) -> trimesh.Trimesh:
    """Return a plate to print with nine figures; those of the paper lie in examples/plates."""
    plate = trimesh.creation.box([3 * GRID_MM, 3 * GRID_MM, PRINTED_MM])
    plate.apply_translation([0, 0, -FIGURE_HEIGHT_MM - PRINTED_MM / 2])
    bodies, height_mm = [plate], FIGURE_HEIGHT_MM + PRINTED_MM / 2
    for name, place_mm in zip(names, grid_places_mm(), strict=False):
        # Sunk into the plate, so that a slicer makes one body of all.
        down = trimesh.transformations.translation_matrix([*place_mm, -height_mm])
        islands = shapely.get_parts(figure(name))
        bodies += [trimesh.creation.extrude_polygon(island, height_mm, transform=down) for island in islands]
    return cast(trimesh.Trimesh, trimesh.util.concatenate(bodies))


class Tapped(NamedTuple):
    """Truth of the taps of a recording, in their order, which only an emulation has."""

    indentation_mm: NDArray[np.float32]  # (n,) at full force
    unit_patterns: NDArray[np.float32]  # (n, H, W) at FINE_SCALE, deformation per indentation


class Robot:
    """One sensor on one robot; everything follows from the seed."""

    def __init__(self, seed: int = 7) -> None:
        self.rng = np.random.default_rng([seed, 70])
        self.pad = GrippedPad(draw_pad(self.rng))
        shape = (3, 4, 4)
        self.gains = 1 + GAIN_SPREAD * self.rng.standard_normal(shape).clip(-2, 2)
        self.signature = np.array(SIGNATURE)[:, None, None] * self.rng.standard_normal(shape).clip(-2, 2)
        self.rest = 33_000 + 300.0 * self.rng.standard_normal(shape)

    def read(self, clean: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the zeroed counts (n, 3, 4, 4) of one sensor, with its gains, its signature and noise."""
        own = clean * self.gains + self.signature * clean[:, 2].mean(axis=(1, 2))[:, None, None, None]
        return np.rint(own + 2.0 * self.rng.standard_normal(own.shape))

    @one_thread()
    def record_plate(self, path: Path, names: Sequence[str]) -> Tapped:
        """Tap every figure of a plate at the paper's 9 places and one of its turns.

        A CSV has the scans, and the poses that the robot states.
        """
        poses = [
            Pose(middle[0] + x_mm, middle[1] + y_mm, TURN_DEG)
            for _, middle in zip(names, grid_places_mm(), strict=False)
            for y_mm in PLACES_MM
            for x_mm in PLACES_MM
        ]
        plate, size, cell_mm = Relief("plate", plate_mesh(names)), self.pad.size * SAMPLES, self.pad.cell_mm / SAMPLES
        rows, stated, depths, units = [np.zeros((100, 3, 4, 4))], [np.tile((0.0, 0.0, 0.0), (100, 1))], [], []
        rise, fall = np.linspace(0, 1, RISE + 1)[1:], np.linspace(1, 0, FALL + 1)[1:]
        share = np.concatenate([np.zeros(FREE), rise, np.ones(HOLD), fall])
        for pose in poses:
            true = Pose(*(np.array(pose) + MISPLACED + JITTER * self.rng.standard_normal(3).clip(-2, 2)).tolist())
            heights_mm = -depth_image(plate, true, size, cell_mm)
            one = self.pad.tap(heights_mm[None], FORCE_N * self.rng.uniform(0.9, 1.1))
            rows.append(between_frames(one.counts, share[None])[0])
            stated.append(np.tile((pose.x_mm, -pose.y_mm, -pose.angle_deg), (len(share), 1)))
            depths.append(one.indentation_mm[0, -1])
            units.append(one.unit_patterns[0])
        clean = np.concatenate(rows)
        drift = np.linspace(0, 1, len(clean))[:, None, None, None] * np.array([5.0, 5.0, 60.0])[:, None, None]
        counts = np.rint(self.rest + self.read(clean) + drift).reshape(len(clean), 3, 16).transpose(0, 2, 1)
        table = np.concatenate([counts.reshape(len(clean), 48), np.concatenate(stated)], axis=1)
        time_s = np.arange(len(clean))[:, None] / 100
        form = ["%.2f"] + ["%d"] * 48 + ["%.3f"] * 3
        header = ",".join(("time_s", *csv_header(), *CSV_POSES))
        np.savetxt(path, np.concatenate([time_s, table], axis=1), form, ",", header=header, comments="")
        return Tapped(np.array(depths), np.array(units))

    def save_sensor_file(self, path: Path) -> None:
        """Write what a user knows of the sensor: constants within a share of their range, gains to 2 %."""
        values, ends = {}, {}
        for name in INPUTS:
            half = KNOWN_TO * (RANGES[name][1] - RANGES[name][0]) / 2
            values[name] = float(np.clip(getattr(self.pad.pad, name) + self.rng.uniform(-half, half), 0, None))
            ends[name] = (values[name] - half, values[name] + half)
        gains = tuple((self.gains * (1 + 0.02 * self.rng.standard_normal((3, 4, 4)).clip(-2, 2))).ravel().tolist())
        pad = Pad(**values, intervals=ends, gains=gains, gain_half_widths=(LEVEL_90 * 0.02,) * CHANNELS)
        save_sensor_file(path, SensorFile(sensors={"4": SensorEntry(pad=pad)}))

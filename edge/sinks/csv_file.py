"""Recording of one sensor as CSV: counts, times and poses, as the reader of `replay` takes them."""

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.pad_geometry import AXES
from firmware_bridge.poses import PoseTrack, TimedPose
from firmware_bridge.recording.csv_reader import CSV_POSES, EMULATED, csv_header
from firmware_bridge.recording.tracks import Track
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.scan import ABSENT


def write_csv(
    path: Path,
    track: Track,
    times_ns: NDArray[np.int64],
    mounting: Mounting,
    poses: Sequence[TimedPose],
    *,
    emulated: bool,
) -> None:
    """Write the scans of a sensor that have all readings, since a CSV has no cell for an absent one.

    Args:
        path: of the file.
        track: scans of the sensor, each taxel in its place; written in the order of the id map, by the mounting.
        times_ns: (n,) times of the scans since the first one, in [ns].
        mounting: of the sensor.
        poses: of the pad, on the same clock, in the order of the scans that they served first.
        emulated: the sensor is emulated.
    """
    taxels = track.geometry.taxel_count
    counts = track.counts.reshape(len(times_ns), len(AXES), taxels)[:, :, np.argsort(mounting.order)]
    whole = (counts != ABSENT).all(axis=(1, 2))
    course, taken = PoseTrack(), 0
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        mark = (EMULATED,) if emulated else ()
        writer.writerow(("time_s", *csv_header(taxels), *(CSV_POSES if poses else ()), *mark))
        for row in np.flatnonzero(whole):
            time_ns = int(times_ns[row])
            while taken < len(poses) and (poses[taken].used_from_ns or poses[taken].time_ns) <= time_ns:
                course.add(poses[taken].time_ns, poses[taken].pose, holds=poses[taken].holds)
                taken += 1
            pose = course.at(time_ns)
            place = ("", "", "") if pose is None else (pose.x_mm, pose.y_mm, pose.turn_deg)
            readings = counts[row].T.ravel().tolist()
            writer.writerow((f"{time_ns / 1e9:.6f}", *readings, *(place if poses else ()), *("1" for _ in mark)))

"""Recordings of edge-sr as a dataset of LeRobot: an episode for each file, at the dataset's own rate.

tactile-sr-to-lerobot press.mcap grip.mcap --repo-id me/presses --task "press the pad" --fps 30
"""

import argparse
import sys
from collections import deque
from collections.abc import Iterator, Sequence
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np

from edge.api import (
    DEFAULT_MODEL,
    BridgeError,
    Contract,
    EdgeError,
    Result,
    Stream,
    load_model,
    open_recording,
    open_runtime,
)
from lerobot_camera_tactile_sr.observation import AXES, RENDERS, Rendering, state_names, state_of, taxels_of, window_of

WINDOW = "observation.tactile_window"


def key_of(kind: str, sensor: str) -> str:
    """Return the feature of a sensor's "images", or of its numbers, "tactile"; LeRobot refuses a slash in names."""
    return f"observation.{kind}.{sensor.replace('/', '_')}"


def features_of(sensors: Sequence[str], contract: Contract, dtype: str, scans: int) -> dict[str, dict[str, Any]]:
    """Return the features of a dataset, as `LeRobotDataset.create` takes them, with so many scans in a frame."""
    image = {"dtype": dtype, "shape": (*contract.pattern_shape, 3), "names": ["height", "width", "channels"]}
    names = state_names(contract)
    numbers = {"dtype": "float32", "shape": (len(names),), "names": names}
    channels = len(AXES) * contract.rows * contract.cols * len(sensors)
    window = {"dtype": "float32", "shape": (scans, channels), "names": ["scan", "channel"]}
    kinds = {"tactile": numbers, "images": image}
    return {WINDOW: window} | {key_of(kind, sensor): one for kind, one in kinds.items() for sensor in sensors}


def results_of(path: Path, model: Any) -> list[Result]:
    """Return the results of a recording in the order of their times; BridgeError if it cannot be used."""
    with open_recording(path) as source:
        return sorted(Stream(source, open_runtime(model, source)), key=lambda one: one.scan.time_ns)


def scans_in_frame(results: Sequence[Result], fps: int) -> int:
    """Return how many scans of the fastest sensor come within a frame."""
    times_ns: dict[str, list[int]] = {}
    for result in results:
        times_ns.setdefault(result.scan.sensor, []).append(result.scan.time_ns)
    periods_ns = [float(np.median(np.diff(times))) for times in times_ns.values() if len(times) > 1]
    return max((ceil(1e9 / fps / period) for period in periods_ns if period > 0), default=1)


def frames_of(
    results: Sequence[Result], fps: int, contract: Contract, rendering: Rendering, scans: int
) -> Iterator[tuple[list[str], dict[str, Any]]]:
    """Yield the sensors and the frame of each instant, from when every sensor is zeroed.

    A frame holds the newest result of each sensor at that instant, never a later one, and its newest `scans` readings.
    """
    sensors = sorted({result.scan.sensor for result in results})
    newest: dict[str, Result] = {}
    readings = {sensor: deque[Any](maxlen=scans) for sensor in sensors}
    due_ns: int | None = None
    for result in results:
        while due_ns is not None and result.scan.time_ns > due_ns:
            yield sensors, _frame([newest[sensor] for sensor in sensors], readings, contract, rendering)
            due_ns += round(1e9 / fps)
        if result.zeroed is not None:
            newest[result.scan.sensor] = result
            readings[result.scan.sensor].append(taxels_of(result))
        if due_ns is None and newest.keys() == set(sensors):
            due_ns = result.scan.time_ns


def _frame(
    results: Sequence[Result], readings: dict[str, deque[Any]], contract: Contract, rendering: Rendering
) -> dict[str, Any]:
    frame: dict[str, Any] = {WINDOW: np.concatenate([window_of(kept) for kept in readings.values()], axis=1)}
    for result in results:
        numbers = list(state_of(result, contract).values())
        frame[key_of("tactile", result.scan.sensor)] = np.array(numbers, dtype=np.float32)
        frame[key_of("images", result.scan.sensor)] = rendering.image_of(result, contract)
    return frame


def convert(
    recordings: Sequence[Path],
    repo_id: str,
    *,
    task: str,
    fps: int,
    root: Path | None = None,
    model: str = DEFAULT_MODEL,
    video: bool = False,
    **rendering: Any,
) -> int:
    """Write a dataset, with images by the arguments of `Rendering`, and return the number of its frames.

    Raises:
        BridgeError: a recording cannot be used.
        ValueError: a recording has other sensors than the first, or no sensor in it was zeroed.
    """
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    drawn, loaded, dataset, known, count, scans = Rendering(**rendering), load_model(model), None, None, 0, 0
    for path in recordings:
        before, results = count, results_of(path, loaded)
        scans = scans or scans_in_frame(results, fps)
        for sensors, frame in frames_of(results, fps, loaded.contract, drawn, scans):
            if dataset is None:
                features = features_of(sensors, loaded.contract, "video" if video else "image", scans)
                dataset = LeRobotDataset.create(
                    repo_id, fps, features, root=root, robot_type="tactile_sr", use_videos=video
                )
                known = sensors
            if sensors != known:
                raise ValueError(f"{path} has sensors {', '.join(sensors)}, expected {', '.join(known or ())}")
            dataset.add_frame({**frame, "task": task})
            count += 1
        if count == before:
            raise ValueError(f"{path}: no sensor in it could be zeroed: see docs/recordings.md")
        if dataset is not None:
            dataset.save_episode()
    if dataset is not None and hasattr(dataset, "finalize"):
        dataset.finalize()
    return count


def main(words: Sequence[str] | None = None) -> int:
    """Convert the recordings of a command line."""
    parser = argparse.ArgumentParser(prog="tactile-sr-to-lerobot", description=__doc__.partition("\n")[0])
    parser.add_argument("recordings", nargs="+", type=Path, metavar="FILE", help=".mcap, .npz or .csv")
    parser.add_argument("--repo-id", required=True, metavar="ME/NAME", help="name of the dataset")
    parser.add_argument("--task", required=True, metavar="TEXT", help="what is done, in a sentence")
    parser.add_argument("--fps", type=int, default=30, metavar="N", help="frames a second (%(default)s)")
    parser.add_argument("--root", type=Path, metavar="FOLDER", help="new folder of the dataset; by default LeRobot's")
    parser.add_argument("--model", default=DEFAULT_MODEL, metavar="M", help="model that makes the patterns")
    parser.add_argument("--render", choices=RENDERS, default=RENDERS[0], help="what images show (%(default)s)")
    parser.add_argument("--force-max-n", type=float, default=5.0, metavar="N", help="force at full scale of vector_rgb")
    parser.add_argument("--full-scale-mm", type=float, default=0.3, metavar="MM", help="deformation that is 255")
    parser.add_argument("--video", action="store_true", help="images as video, which is smaller and not exact")
    options = parser.parse_args(words)
    try:
        count = convert(**vars(options))
    except (BridgeError, EdgeError, ValueError, OSError) as error:
        print(f"tactile-sr-to-lerobot: {error}", file=sys.stderr)
        return 1
    print(f"{options.repo_id}: {count} frames in {len(options.recordings)} episodes")
    return 0

"""Recordings of edge-sr as a dataset of LeRobot: an episode for each file, at the dataset's own rate.

tactile-sr-to-lerobot press.mcap grip.mcap --repo-id me/presses --task "press the pad" --fps 30
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
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
from lerobot_camera_tactile_sr.observation import image_of, state_names, state_of

STATE = "observation.state"


def image_key(sensor: str) -> str:
    """Return the feature of a sensor's images; LeRobot refuses a slash in names."""
    return f"observation.images.{sensor.replace('/', '_')}"


def features_of(sensors: Sequence[str], contract: Contract, dtype: str) -> dict[str, dict[str, Any]]:
    """Return the features of a dataset, as `LeRobotDataset.create` takes them."""
    image = {"dtype": dtype, "shape": (*contract.pattern_shape, 3), "names": ["height", "width", "channels"]}
    names = [f"{sensor}.{name}" for sensor in sensors for name in state_names(contract)]
    state = {"dtype": "float32", "shape": (len(names),), "names": names}
    return {STATE: state} | {image_key(sensor): image for sensor in sensors}


def frames_of(path: Path, fps: int, model: Any, full_scale_mm: float) -> Iterator[tuple[list[str], dict[str, Any]]]:
    """Yield the sensors and the frame of each instant, from when every sensor is zeroed.

    A frame holds the newest result of each sensor at that instant, never a later one.

    Raises:
        BridgeError: the recording cannot be used.
    """
    with open_recording(path) as source:
        results = list(Stream(source, open_runtime(model, source)))
    sensors = sorted({result.scan.sensor for result in results})
    newest: dict[str, Result] = {}
    due_ns: int | None = None
    for result in sorted(results, key=lambda one: one.scan.time_ns):
        while due_ns is not None and result.scan.time_ns > due_ns:
            yield sensors, _frame([newest[sensor] for sensor in sensors], model.contract, full_scale_mm)
            due_ns += round(1e9 / fps)
        if result.zeroed is not None:
            newest[result.scan.sensor] = result
        if due_ns is None and newest.keys() == set(sensors):
            due_ns = result.scan.time_ns


def _frame(results: Sequence[Result], contract: Contract, full_scale_mm: float) -> dict[str, Any]:
    state = [number for result in results for number in state_of(result, contract).values()]
    images = {image_key(one.scan.sensor): image_of(one, contract, full_scale_mm) for one in results}
    return {STATE: np.array(state, dtype=np.float32), **images}


def convert(
    recordings: Sequence[Path],
    repo_id: str,
    *,
    task: str,
    fps: int,
    root: Path | None = None,
    model: str = DEFAULT_MODEL,
    full_scale_mm: float = 0.3,
    video: bool = False,
) -> int:
    """Write a dataset, and return the number of its frames.

    Raises:
        BridgeError: a recording cannot be used.
        ValueError: a recording has other sensors than the first, or no sensor in it was zeroed.
    """
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    loaded, dataset, known, count = load_model(model), None, None, 0
    for path in recordings:
        before = count
        for sensors, frame in frames_of(path, fps, loaded, full_scale_mm):
            if dataset is None:
                features = features_of(sensors, loaded.contract, "video" if video else "image")
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

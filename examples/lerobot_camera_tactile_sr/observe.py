"""Print an observation of the camera `tactile_sr`, as a robot of LeRobot takes one: an image and a state.

python observe.py                                # the adapter that is plugged in
python observe.py --source demo:loop --pretend   # an emulated sensor
"""

import argparse

from lerobot.cameras.utils import make_cameras_from_configs
from lerobot_camera_tactile_sr import TactileSrCameraConfig

PATIENCE_MS = 5000
"""Time that a busy machine is given here; a robot needs a newer observation, as by default."""


def main() -> None:
    """Connect, which zeroes the free pad, and print one observation."""
    parser = argparse.ArgumentParser(description="Print an observation of a tactile sensor.")
    parser.add_argument("--source", help="source, as for edge-sr (default: the adapter plugged in)")
    parser.add_argument("--sensor-file", help="sensor file of edge-sr doctor")
    parser.add_argument("--pretend", action="store_true", help="accept an emulated sensor or a recording")
    config = TactileSrCameraConfig(**vars(parser.parse_args()))
    camera = make_cameras_from_configs({"tactile": config})["tactile"]
    camera.connect()
    try:
        image = camera.async_read(timeout_ms=PATIENCE_MS)
        state = camera.read_state(max_age_ms=PATIENCE_MS)
    finally:
        camera.disconnect()
    print(f"observation.images.tactile: {image.shape} {image.dtype}, 0 to {image.max()}")
    last = ", ".join(f"{name} {state[name]:.1f}" for name in list(state)[-3:])
    print(f"observation.state: {len(state)} numbers, the last of them {last}")


if __name__ == "__main__":
    main()

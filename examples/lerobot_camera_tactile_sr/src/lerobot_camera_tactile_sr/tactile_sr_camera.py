"""Camera of LeRobot that reads a tactile sensor."""

import threading
import time
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from lerobot.cameras.camera import Camera
from lerobot.cameras.configs import CameraConfig
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError
from numpy.typing import NDArray

from edge.api import (
    DEFAULT_MODEL,
    BridgeError,
    EdgeError,
    Result,
    Stream,
    devices,
    load_model,
    open_runtime,
    open_source,
)
from lerobot_camera_tactile_sr.observation import Rendering, state_names, state_of, taxels_of, window_of


@CameraConfig.register_subclass("tactile_sr")
@dataclass(kw_only=True)
class TactileSrCameraConfig(CameraConfig):
    """Settings of one sensor, as `--robot.cameras` of LeRobot takes them; `fps` is not used: the sensor has its pace.

    Width and height of an image are multiples of the pattern's, by default the same.
    """

    source: str | None = None  # as edge-sr --source; None for the adapter of the sensor file, or the one plugged in
    sensor_file: str | None = None  # file of edge-sr doctor
    name: str | None = None  # of the sensor where the source has several
    model: str = DEFAULT_MODEL  # name of a bundled model, or a file
    window_scans: int = 4  # scans of read_window: at 100 a second, all that come within a frame of 1/30 s
    render: str = "pattern"  # or vector_rgb; see `observation.Rendering`
    full_scale_mm: float = 0.3
    force_max_n: float = 5.0
    pretend: bool = False  # accept emulated sensors and recordings, on which no robot may act

    def __post_init__(self) -> None:
        self.rendering = Rendering(self.render, self.full_scale_mm, self.force_max_n)
        if self.window_scans < 1:
            raise ValueError(f"window_scans is {self.window_scans}, expected 1 or more")


class TactileSrCamera(Camera):
    """Tactile sensor as a camera; a thread reads it, so that no call but the first waits for more than one scan."""

    def __init__(self, config: TactileSrCameraConfig) -> None:
        """Load the model; nothing is opened.

        Raises:
            ModelError: the model does not exist or cannot be used.
            ValueError: width and height are no multiple of the pattern's.
        """
        super().__init__(config)
        self.config = config
        self._contract = load_model(config.model).contract
        rows, cols = self._contract.pattern_shape
        self.height, self.width = config.height or rows, config.width or cols
        self._zoom = self.height // rows
        if (self._zoom * rows, self._zoom * cols) != (self.height, self.width) or not self._zoom:
            raise ValueError(f"image of {self.width}x{self.height}, expected a multiple of the pattern's {cols}x{rows}")
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()
        self._changed = threading.Condition()
        self._newest: Result | None = None
        self._readings = deque[NDArray[np.float32]](maxlen=config.window_scans)
        self._newest_s = 0.0
        self._fresh = False
        self._failure: Exception | None = None

    def __str__(self) -> str:
        return f"TactileSrCamera({self.config.source or 'adapter'}, {self.config.name or 'the only sensor'})"

    @property
    def is_connected(self) -> bool:
        """True between connect and disconnect, also while the sensor is away."""
        return self._thread is not None

    @property
    def state_features(self) -> dict[str, type]:
        """Names and type of the numbers of `read_state`, for a robot's `observation_features`."""
        return dict.fromkeys(state_names(self._contract), float)

    @staticmethod
    def find_cameras() -> list[dict[str, Any]]:
        """Return the adapters that are plugged in, each with the source to use; nothing is opened."""
        found, _ = devices()
        return [{"name": one.looks_like, "type": "tactile_sr", "id": one.source} for one in found if one.adapter]

    def connect(self, warmup: bool = True) -> None:
        """Open the sensor, and with `warmup` wait until it is zeroed; the pad must be still and free.

        Raises:
            DeviceAlreadyConnectedError: it is connected.
            ConnectionError: the sensor cannot be read, or gives nothing that may be acted on.
        """
        if self.is_connected:
            raise DeviceAlreadyConnectedError(f"{self} is connected already")
        self._stop.clear()
        self._newest, self._failure, self._fresh = None, None, False
        self._readings.clear()
        self._thread = threading.Thread(target=self._follow, name="tactile-sr", daemon=True)
        self._thread.start()
        if not warmup:
            return
        try:
            # A loading model, a sensor that starts, and 100 scans to zero from.
            self._wait(lambda: self._newest is not None and self._newest.state not in ("zeroing", "incomplete"), 30.0)
        except (TimeoutError, ConnectionError):
            self.disconnect()
            raise

    def read(self) -> NDArray[np.uint8]:
        """Return the image of the next scan; see `observation.Rendering`. Raises as `async_read` does."""
        with self._changed:
            self._fresh = False
        return self.async_read(1000.0)

    def async_read(self, timeout_ms: float = 200.0) -> NDArray[np.uint8]:
        """Return the image of the newest scan that was not returned before, and wait for it if need be.

        Raises:
            DeviceNotConnectedError: it is not connected.
            ConnectionError: the sensor is lost for good.
            TimeoutError: no scan came in time.
        """
        self._wait(lambda: self._fresh, timeout_ms / 1e3)
        return self._image(self._latest())

    def read_latest(self, max_age_ms: int = 500) -> NDArray[np.uint8]:
        """Return the image of the newest scan at once.

        Raises as `async_read` does, with TimeoutError if that scan is older; RuntimeError if there is none yet.
        """
        return self._image(self._check_age(max_age_ms))

    def read_state(self, max_age_ms: int = 500) -> dict[str, float]:
        """Return the numbers of the newest scan at once; raises as `read_latest` does.

        Together with an image, read the state first: the image is then of the same scan or of a newer one.
        """
        return state_of(self._check_age(max_age_ms), self._contract)

    def read_window(self, max_age_ms: int = 500) -> NDArray[np.float32]:
        """Return the taxels of the newest scans, (window_scans, channels), the newest last; raises as `read_latest`.

        In counts over the baseline, in the order of `state_features`; also of scans whose pattern a busy machine left
        out. Until so many scans were read the first one stands for those before it.
        """
        self._check_age(max_age_ms)
        with self._changed:
            return window_of(self._readings)

    def disconnect(self) -> None:
        """Close the sensor; raises DeviceNotConnectedError where it is not connected."""
        if self._thread is None:
            raise DeviceNotConnectedError(f"{self} is not connected")
        self._stop.set()
        self._thread.join()
        self._thread = None

    def _check_age(self, max_age_ms: float) -> Result:
        self._wait(lambda: True, 0.0)
        result = self._latest()
        age_ms = (time.monotonic() - self._newest_s) * 1e3
        if age_ms > max_age_ms:
            raise TimeoutError(f"{self}: the newest scan is {age_ms:.0f} ms old, expected at most {max_age_ms} ms")
        return result

    def _latest(self) -> Result:
        with self._changed:
            if self._newest is None:
                raise RuntimeError(f"{self} has read no scan yet: connect() with warmup waits for one")
            self._fresh = False
            return self._newest

    def _image(self, result: Result) -> NDArray[np.uint8]:
        return self.config.rendering.image_of(result, self._contract, self._zoom)

    def _wait(self, satisfied: Any, timeout_s: float) -> None:
        if not self.is_connected:
            raise DeviceNotConnectedError(f"{self} is not connected: call connect() first")
        with self._changed:
            in_time = self._changed.wait_for(lambda: self._failure is not None or satisfied(), timeout_s)
            if self._failure is not None:
                raise ConnectionError(f"{self}: {self._failure}") from self._failure
        if not in_time:
            raise TimeoutError(f"{self}: no scan for {timeout_s * 1e3:.0f} ms: check its plugs and edge-sr doctor")

    def _follow(self) -> None:
        """Read the sensor until the camera is disconnected."""
        config = self.config
        texts = () if config.source is None else (config.source,)
        try:
            # The model is loaded again, in the thread that runs it.
            with open_source(*texts, sensor=config.sensor_file) as source:
                if source.kind != "device" and not config.pretend:
                    raise ValueError(f"{source.name} is {source.kind}, not a sensor: set pretend for a trial")
                for result in Stream(source, open_runtime(config.model, source), stop=self._stop):
                    self._take(result)
            raise ValueError("the source has ended")
        except (BridgeError, EdgeError, ValueError) as error:
            with self._changed:
                self._failure = error
                self._changed.notify_all()

    def _take(self, result: Result) -> None:
        name = self.config.name
        if name is None and self._newest is not None and self._newest.scan.sensor != result.scan.sensor:
            both = f"{self._newest.scan.sensor} and {result.scan.sensor}"
            raise ValueError(f"sensors {both} send: set name to one of them")
        if name is not None and result.scan.sensor != name:
            return
        with self._changed:
            self._readings.append(taxels_of(result))
            if result.state == "dropped":
                return
            # As old as its readings: what waited on the way is not of now. A recording has times of its own.
            self._newest_s = time.monotonic() if result.source == "replay" else result.scan.on_bus_ns / 1e9
            self._newest, self._fresh = result, True
            self._changed.notify_all()

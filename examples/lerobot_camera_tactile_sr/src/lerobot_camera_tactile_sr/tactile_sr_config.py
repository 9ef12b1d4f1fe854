"""Settings of the camera, as `--robot.cameras` of LeRobot takes them."""

from dataclasses import dataclass

from lerobot.cameras.configs import CameraConfig

from edge.api import DEFAULT_MODEL


@CameraConfig.register_subclass("tactile_sr")
@dataclass(kw_only=True)
class TactileSrCameraConfig(CameraConfig):
    """Settings of one sensor.

    Attributes:
        source: as `edge-sr --source`; None for the adapter of the sensor file, or the one that is plugged in.
        sensor_file: file of `edge-sr doctor`; None without.
        name: name of the sensor where the source has several; None for the only one.
        model: name of a bundled model, or a file.
        full_scale_mm: deformation and deviation at 255; the range is fixed, so that images can be compared.
        pretend: accept emulated sensors and recordings, on which no robot may act.
        width: of the image, a multiple of the pattern's; None for the pattern's.
        height: as the width.
        fps: not used: the sensor has its own pace.
    """

    source: str | None = None
    sensor_file: str | None = None
    name: str | None = None
    model: str = DEFAULT_MODEL
    full_scale_mm: float = 0.3
    pretend: bool = False

    def __post_init__(self) -> None:
        if not self.full_scale_mm > 0:
            raise ValueError(f"full_scale_mm is {self.full_scale_mm}, expected a number above 0")

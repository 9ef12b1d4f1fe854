"""Images and state of LeRobot, made of a result. No I/O."""

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge.api import Contract, Result

AXES = ("x", "y", "z")
WRENCH = ("force_x_n", "force_y_n", "force_z_n", "torque_x_n_mm", "torque_y_n_mm", "torque_z_n_mm")
BELIEVED = "believed"
RENDERS = ("pattern", "vector_rgb")


def believed(result: Result) -> bool:
    """Return whether the image of a result shows what touches the pad, or that nothing does."""
    return result.state == "idle" or (result.state == "contact" and result.trusted is True)


@dataclass(frozen=True)
class Rendering:
    """Settings of an image, which has the same range whatever the result, so that images can be compared.

    Attributes:
        render: "pattern", or "vector_rgb" for the forces on the pad, as the plugin of Paxini sensors draws them.
        full_scale_mm: deformation and deviation at 255 of a pattern.
        force_max_n: force on a taxel's area at 1 or 255; none is 128.
    """

    render: str = "pattern"
    full_scale_mm: float = 0.3
    force_max_n: float = 5.0

    def __post_init__(self) -> None:
        if self.render not in RENDERS:
            raise ValueError(f"render is '{self.render}', expected one of {', '.join(RENDERS)}")
        for name in ("full_scale_mm", "force_max_n"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}, expected a number above 0")

    def image_of(self, result: Result, contract: Contract, zoom: int = 1) -> NDArray[np.uint8]:
        """Return an image (H, W, 3) with `zoom` as the side of a pixel of the pattern.

        A pattern has its deformation, deviation, and 255 where it is to be believed; without one it is 0. Forces have
        x, y and z; those that are not to be believed are left out.
        """
        if self.render == "pattern":
            image = np.zeros((*contract.pattern_shape, 3), dtype=np.uint8)
            for channel, values in enumerate((result.pattern, result.deviation)):
                if values is not None:
                    image[..., channel] = np.clip(np.rint(values * (255 / self.full_scale_mm)), 0, 255)
            image[..., 2] = 255 if believed(result) else 0
        else:
            image = np.full((*contract.pattern_shape, 3), 128, dtype=np.uint8)
            if result.traction is not None and believed(result):
                newtons = result.traction.transpose(1, 2, 0) * (contract.pitch_mm**2 / 1000)  # kPa times mm2 is mN
                levels = np.rint(128 + 127 * np.clip(newtons / self.force_max_n, -1, 1)).astype(np.uint8)
                side = contract.pattern_shape[0] // levels.shape[0]
                image[:] = levels.repeat(side, axis=0).repeat(side, axis=1)
        return image.repeat(zoom, axis=0).repeat(zoom, axis=1)


def state_names(contract: Contract) -> list[str]:
    """Return the names of the numbers that `state_of` gives for a model."""
    taxels = [f"taxel_{axis}_{taxel}" for axis in AXES for taxel in range(contract.rows * contract.cols)]
    return [*taxels, *(WRENCH if contract.traction_shape is not None else ()), BELIEVED]


def taxels_of(result: Result) -> NDArray[np.float32]:
    """Return the taxels of a scan in counts over the baseline, in the order of `state_names`; 0 where not available."""
    if result.zeroed is None:
        return np.zeros(result.scan.counts.size, dtype=np.float32)
    return np.nan_to_num(result.zeroed.ravel(), nan=0.0).astype(np.float32)


def window_of(readings: deque[NDArray[np.float32]]) -> NDArray[np.float32]:
    """Return readings as (maxlen, channels), the newest last; until there are so many the first stands for the rest."""
    return np.stack([readings[0]] * ((readings.maxlen or 0) - len(readings)) + list(readings))


def state_of(result: Result, contract: Contract) -> dict[str, float]:
    """Return taxels in counts over the baseline, the wrench in N and N mm, and whether all of it is to be believed.

    A number that is not available is 0, since datasets cannot hold NaN, and then `believed` is 0: before zeroing, and
    of a taxel that is dead. Without contact the wrench is 0.
    """
    shape = (3, contract.rows, contract.cols)
    taxels = np.full(shape, np.nan) if result.zeroed is None else result.zeroed.astype(np.float64)
    numbers = taxels.ravel().tolist()
    if contract.traction_shape is not None:
        wrench = result.wrench
        numbers += [0.0] * 6 if wrench is None else [*wrench.force_n, *wrench.torque_n_mm]
    known = believed(result) and bool(np.isfinite(numbers).all())
    finite = np.nan_to_num(numbers, nan=0.0).tolist()
    return dict(zip(state_names(contract), [*finite, float(known)], strict=True))

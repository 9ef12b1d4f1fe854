"""What is known of one sensor, and how surely: the pads that a model for it is trained on, and what it is told."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from edge.inference.bundled import DEFAULT_MODEL, find_model
from edge.inference.contract import GAINS_CERTAINTY
from edge.inference.onnx_session import ModelSession
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.scans.pad_constants import GAIN_SPREAD, Pad
from firmware_bridge.sensor_file.model import SensorFile, with_scale
from train.data.press_batches import OneSensor
from train.errors import DatasetError
from train.physics.pad_draws import RANGES, SIMULATED
from train.physics.pad_draws import Pad as SimulatedPad

FIFTH: Final = 0.2  # share of a range that a constant without an interval is known to, and by which pads are unlike it


@dataclass(frozen=True, slots=True)
class Knowledge:
    """Facts of one sensor, and how surely they are known."""

    name: str
    pad: Pad  # as its sensor file has it, with what was learned and identified
    ranges: Mapping[str, tuple[float, float]]  # of constants of pads like it

    def sensor(self) -> OneSensor:
        """Return what a network is told of it."""
        certainty = self.pad.gains_certainty
        made_for = {name: self.ranges[name] for name in self.pad.constants}
        made_for[GAINS_CERTAINTY] = (max(certainty - FIFTH, 0.0), min(certainty + FIFTH, 1.0))
        row = ModelSession(find_model(DEFAULT_MODEL)).contract.pad_row(self.pad)
        return OneSensor(tuple(row.tolist()), 1 - certainty, made_for)

    def middle(self) -> SimulatedPad:
        """Return a pad in the middle of the ranges."""
        return SimulatedPad(**dict[str, Any]({name: sum(ends) / 2 for name, ends in self.ranges.items()}))

    def widened(self) -> Mapping[str, tuple[float, float]]:
        """Return ranges of pads that lie up to a fifth of a constant's range outside of what is known."""
        more = {name: FIFTH * (high - low) for name, (low, high) in RANGES.items()}
        return {name: _within(name, low - more[name], high + more[name]) for name, (low, high) in self.ranges.items()}

    def told(self) -> str:
        """Return it in a sentence."""
        shares = {
            name: (self.ranges[name][1] - self.ranges[name][0]) / (RANGES[name][1] - RANGES[name][0]) for name in RANGES
        }
        known = ", ".join(f"{name} to {share:.0%}" for name, share in shares.items() if share < 1)
        spread = 100 * GAIN_SPREAD * (1 - self.pad.gains_certainty)
        gains = f"gains to {spread:.1f} %" if self.pad.gains else "its gains are not known"
        unknown = [name for name, share in shares.items() if share >= 1]
        more = f"; not known: {', '.join(unknown)}" if unknown else ""
        return f"sensor {self.name}: known of the range of its constants: {known or 'nothing'}; {gains}{more}"


def _within(name: str, low: float, high: float) -> tuple[float, float]:
    """Return bounds of a constant that a simulated pad may have."""
    least, most = SIMULATED[name]
    return max(low, least), min(high, most)


def knowledge_of(file: SensorFile, name: str | None) -> Knowledge:
    """Return what a sensor file tells of a sensor, whose name may be left out of a file of one.

    DatasetError if there is no such sensor, or it is emulated (nothing of it holds for a device) or beyond simulation.
    """
    if file.geometry != USPA44:
        raise DatasetError(f"the sensor file is of a {file.geometry.name}, expected a {USPA44.name}")
    name = next(iter(file.sensors)) if name is None and len(file.sensors) == 1 else name
    if name is None or name not in file.sensors:
        raise DatasetError(f"the sensor file has the sensors {', '.join(file.sensors)}: name one of them with --sensor")
    entry = file.sensors[name]
    if entry.emulated:
        raise DatasetError(
            f"the sensor file has {', '.join(sorted(entry.emulated))} of an emulated sensor {name}, and no device is "
            "like it: write one of your sensor with edge-sr doctor --out"
        )
    pad = with_scale(entry.used_pad, entry.counts_per_newton, entry.counts_per_newton_interval) or Pad()
    ranges = dict(RANGES)
    for constant, value in pad.constants.items():
        least, most = SIMULATED[constant]
        if not least <= value <= most:
            raise DatasetError(
                f"{constant} of sensor {name} is {value:g}, expected {least:g} to {most:g} of a pad that can be "
                "simulated: measure it again, or take it out of the sensor file"
            )
        apart = FIFTH * (RANGES[constant][1] - RANGES[constant][0]) / 2
        ranges[constant] = _within(constant, *pad.intervals.get(constant, (value - apart, value + apart)))
    return Knowledge(name, pad, ranges)

"""Checks of the arguments that a caller of the library passes; each raises a UsageError of one line."""

from collections.abc import Iterable, Mapping
from numbers import Integral, Real
from typing import Any

from edge.errors import UsageError
from firmware_bridge.pad_geometry import AXES, SensorGeometry
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.pad_constants import PAD_RANGES, Pad
from firmware_bridge.schedule import POSITIVE
from firmware_bridge.zeroing.baseline import Baseline


def as_float(value: Any) -> float | None:
    """Return a number as a float; None for anything else, and for a whole number that no float can hold."""
    if not isinstance(value, Real) or isinstance(value, bool):
        return None
    try:
        return float(value)
    except OverflowError:
        return None


def check_kind(name: str, value: Any, attribute: str, expected: str) -> None:
    """Check that an argument called `name` is of its kind, by an attribute that all of the kind have."""
    if not hasattr(value, attribute):
        raise UsageError(f"{name} is {value!r:.60}, expected {expected}")


def check_positive(name: str, number: Any, low: float = POSITIVE[0], high: float = POSITIVE[1]) -> None:
    """Check that the value called `name` is a positive number in a range."""
    value = as_float(number)
    if value is None or not low <= value <= high:
        raise UsageError(f"{name} is {number!r}, expected a positive number, {low:g} to {high:g}")


def check_whole(name: str, number: Any, least: int) -> None:
    """Check that the value called `name` is a whole number from `least`, and one that fits into an int32."""
    if not isinstance(number, Integral) or not least <= int(number) < 2**31:
        raise UsageError(f"{name} is {number!r}, expected a whole number from {least}")


def check_baselines(baselines: Any, geometry: SensorGeometry) -> None:
    """Check that baselines are given by sensor name and are of one grid."""
    if not isinstance(baselines, Mapping):
        raise UsageError(
            f"baselines are a {type(baselines).__name__}, expected their file, or each by its sensor's name"
        )
    for name, baseline in _named("baseline", baselines):
        if not isinstance(baseline, Baseline):
            raise UsageError(f"{name} is a {type(baseline).__name__}, expected a Baseline")
        if baseline.counts.shape != geometry.scan_shape:
            got = f"{name} has shape {baseline.counts.shape}"
            raise UsageError(f"{got}, expected {geometry.scan_shape}: zero again")


def check_pads(pads: Any, geometry: SensorGeometry) -> None:
    """Check that pads are one for all sensors, one by each sensor name, or None, with gains of one grid."""
    gains = len(AXES) * geometry.taxel_count
    for name, pad in _named("pad", pads):
        if not isinstance(pad, Pad):
            raise UsageError(f"{name} is a {type(pad).__name__}, expected a Pad, or each by its sensor's name")
        if pad.gains is not None and len(pad.gains) != gains:
            raise UsageError(
                f"{name} has {len(pad.gains)} gains, expected {gains}, three for each taxel of a {geometry.name}"
            )


def check_mountings(mountings: Mapping[str, Mounting], geometry: SensorGeometry) -> None:
    """Check that mountings, by sensor name, are of one grid."""
    for name, mounting in mountings.items():
        if mounting.taxel_count != geometry.taxel_count:
            got = f"mounting of sensor {name} is of {mounting.taxel_count} taxels"
            raise UsageError(f"{got}, expected {geometry.taxel_count}: run edge-sr doctor with the sensor's --id-map")


def check_counts_per_newton(counts: float | Mapping[str, float] | None) -> None:
    """Check that counts per newton, of all sensors or by name, are such as a pad may have."""
    for name, value in _named("counts_per_newton", counts):
        check_positive(name, value, *PAD_RANGES["counts_per_newton"])


def _named(what: str, setting: Any) -> Iterable[tuple[str, Any]]:
    """Return the values of a setting with their names in a message: one for all sensors, one by each name, or none."""
    if isinstance(setting, Mapping):
        for sensor in setting:
            if not isinstance(sensor, str):
                raise UsageError(f"{what} of sensor {sensor!r}: expected its name as text, such as '4'")
        return [(f"{what} of sensor {sensor}", value) for sensor, value in setting.items()]
    return [] if setting is None else [(what, setting)]

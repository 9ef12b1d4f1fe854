"""Columns of a CSV by their names: taxels, the vendor's newtons, times, poses and others, in any order."""

import re
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from firmware_bridge.pad_geometry import AXES, PADS, USPA44, SensorGeometry

CSV_POSES: Final = ("pose_x_mm", "pose_y_mm", "pose_turn_deg")
EMULATED: Final = "emulated"
"""Column of a recording of an emulated sensor, whatever its cells are."""
_TAXEL: Final = re.compile(r"(?P<force>force[ _])?(?:txl|taxel)?[ _]?0*(?P<taxel>[1-9][0-9]?)[ _]?(?P<axis>[xyz])")
_TIMES: Final = {"t", "time", "times", "timestamp", "timestamps", "stamp", "datetime", "clock", "epoch", "elapsed"}
_UNITS: Final = {
    word: per_second
    for words, per_second in (
        ("s sec secs second seconds", 1.0),
        ("ms msec msecs millis milliseconds", 1e3),
        ("us usec usecs micros microseconds", 1e6),
        ("ns nsec nsecs nanos nanoseconds", 1e9),
    )
    for word in words.split()
}
_USUAL_PERIODS_S: Final = (0.0005, 0.25)
"""Periods between scans that tell the unit of times without one: none of them is usual in two units."""
_GAP: Final = 10.0
"""Usual steps between times from which on a step is a gap, which says nothing about the rate."""


class CsvColumns:
    """Places of the columns that are read; counts and newtons taxel by taxel, x, y and z each."""

    def __init__(self, names: Sequence[str]) -> None:
        """Sort the columns by their names.

        Raises:
            ValueError: they are not those of one pad; the text is what was got, and what was expected.
        """
        counts: dict[tuple[int, str], int] = {}
        newtons: dict[tuple[int, str], int] = {}
        self.times: dict[int, str] = {}
        others: dict[str, int] = {}
        posed: list[str] = []
        names = ["".join(char if char.isprintable() else "?" for char in name.strip()) for name in names]
        if not any(names):
            raise ValueError("an empty file, expected a header and rows of counts")
        for column, name in enumerate(names):
            matched = _TAXEL.fullmatch(name.lower())
            if matched is not None:
                found, key = newtons if matched["force"] else counts, (int(matched["taxel"]), matched["axis"])
                if key in found:
                    raise ValueError(f"two columns {name[:20]!r}, expected each of them once")
                found[key] = column
            elif _TIMES & set(_words(name)):
                self.times[column] = name
            elif name:
                others[name] = column
                posed += [name] * name.lower().startswith("pose")
        self.pad = next((pad for pad in PADS if counts.keys() == _taxels(pad)), USPA44)
        wanted = _taxels(self.pad)
        if counts.keys() != wanted:
            shown = ", ".join(names)
            raise ValueError(
                f"{len(names)} columns: {shown[:60]}{'...' if len(shown) > 60 else ''}, expected a first line with "
                f"{len(wanted)}: txl1_x, txl1_y, txl1_z, txl2_x, ..., txl{self.pad.taxel_count}_z, of one sensor"
            )
        self.counts = [counts[key] for key in sorted(wanted)]
        self.newtons = [newtons[key] for key in sorted(wanted)] if newtons.keys() == wanted else []
        self.poses = [others[name] for name in CSV_POSES if name in others]
        self.emulated = EMULATED in others
        self.left_out = [name for name in others if name not in (*CSV_POSES, EMULATED)]
        if sorted(posed) not in ([], list(CSV_POSES[:2]), sorted(CSV_POSES)):
            raise ValueError(f"columns {', '.join(posed)[:60]}, expected {', '.join(CSV_POSES)}, or no poses")


def rate_of(name: str, times: ArrayLike) -> float | None:
    """Return the rate of scans in [Hz] by their times (n,) in a column of this name; None where it cannot be told.

    The unit is that in the name, else the one in which the times are those of a sensor's usual rates.
    """
    values = np.asarray(times, dtype=np.float64)
    steps = np.diff(values)
    if not steps.size or not np.isfinite(values).all() or steps.min() < 0:
        return None
    usual = float(np.percentile(steps, 90))
    step = float(steps[steps <= _GAP * usual].mean() if usual else steps.mean())
    units = [_UNITS[word] for word in _words(name) if word in _UNITS]
    if not units and not (steps == 1).all():  # such a column may as well number the rows
        low, high = _USUAL_PERIODS_S
        units = [unit for unit in sorted(set(_UNITS.values())) if low <= step / unit < high]
    return units[-1] / step if units and step else None


def _taxels(pad: SensorGeometry) -> set[tuple[int, str]]:
    return {(taxel, axis) for taxel in range(1, pad.taxel_count + 1) for axis in AXES}


def _words(name: str) -> list[str]:
    return re.findall(r"[a-z]+", name.lower().replace("\u00b5", "u").replace("\u03bc", "u"))

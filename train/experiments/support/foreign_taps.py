"""Tables of earlier taps that do not belong: what the guard drops, and what it saves."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.inference.onnx_session import ModelSession
from edge.terminal.progress_bar import tracked
from train.data.frozen_presses import FrozenPresses
from train.experiments.support.contact_verdicts import share
from train.experiments.support.wrong_taps import Guarded, Windows, cases, firm, guarded, twice_the_angle
from train.report import Row, bootstrap_interval

MOST_LOSS_DB: Final = 0.3
"""Largest loss against a model of one tap that is accepted, in [dB]."""
_DROPPED: Final = (
    "Earlier taps of windows of four: share that the runtime finds not to belong, by tap, newest first, and windows of "
    "which it drops some, and all. In the rows `right`, these are false alarms, wanted at most 1 %; in the others "
    "at least 95 % are wanted. The order reversed leaves the middle tap right, twice the angle is turned by 10, 20 and "
    "30 degrees."
)
_PSNR: Final = (
    "PSNR in dB of the same windows, by the model of one tap, and by that of four without and with the guard. "
    f"Wanted: with the guard, never more than {MOST_LOSS_DB:g} dB below one tap. Intervals are by sensor; guard and "
    "options are as shipped, and every tap is used."
)

Table = tuple[Sequence[Row], str, str]
"""Rows, caption and name of a table."""


def tap_tables(single: ModelSession, several: Path, sensors: FrozenPresses, turned: FrozenPresses) -> Iterator[Table]:
    """Yield the tables of dropped taps and of PSNR.

    Args:
        single: model of one tap.
        several: file of a model of more.
        sensors: presses read by one sensor for each pad.
        turned: longer sequences of presses, read alike.
    """
    guarding, unguarded = ModelSession(several), ModelSession(several)
    unguarded.contract = replace(unguarded.contract, trust={})
    taps, name_of = guarding.contract.taps, guarding.name
    sensors, turned = firm(sensors), firm(turned)
    windows: dict[str, tuple[Windows, NDArray[np.int64]]] = {
        **{name: (one, sensors.presses.pad) for name, one in cases(sensors).items()},
        **{name: (one, turned.presses.pad) for name, one in twice_the_angle(turned, taps).items()},
    }
    dropped: list[Row] = []
    losses: list[Row] = []
    for name, (one, pads) in tracked(windows.items(), "tapping", "case"):
        alone, off, on = guarded(single, one, 1), guarded(unguarded, one, taps), guarded(guarding, one, taps)
        row: Row = {"earlier taps": name, "windows": len(one)}
        dropped.append(row | _dropped_cells(on, pads, taps))
        losses.append(
            row
            | {single.name: round(float(alone.psnr_db.mean()), 2)}
            | {
                f"{name_of}, no guard": round(float(off.psnr_db.mean()), 2),
                "no guard, over one tap": _over(off, alone, pads),
            }
            | {f"{name_of}, guard": round(float(on.psnr_db.mean()), 2), "guard, over one tap": _over(on, alone, pads)}
        )
    yield dropped, _DROPPED, "taps"
    yield losses, _PSNR, "psnr"


def _dropped_cells(one: Guarded, pads: NDArray[np.integer], taps: int) -> Row:
    row: Row = {f"tap {number} %": share(one.foreign[:, number - 1], pads) for number in range(1, taps)}
    return row | {
        "some dropped %": share(np.logical_or.reduce(one.foreign, axis=1), pads),
        "all dropped %": share(one.taps_used == 1, pads),
    }


def _over(one: Guarded, other: Guarded, pads: NDArray[np.integer]) -> str:
    gained = one.psnr_db - other.psnr_db
    low, high = bootstrap_interval(gained, pads)
    return f"{gained.mean():+.2f} ({low:+.2f}..{high:+.2f})"

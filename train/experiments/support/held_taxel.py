"""Taxel that holds its reading during a contact: number of scans until the runtime detects it."""

from typing import Final

import numpy as np

from edge.perception.contact_options import RuntimeOptions
from edge.perception.runtime import Model
from train.data.frozen_presses import FrozenPresses
from train.experiments.support.contact_verdicts import share
from train.experiments.support.pushed import SHIPPED, PushedSensor
from train.report import Row

_BEFORE: Final = 10
_AFTER: Final = 30
_WITHIN: Final = (4, 5, 10, 20)
_GROWTH: Final = 0.01
_EVERY_SCAN: Final = RuntimeOptions(follow_drift=False, every_scan=True)
_RUNS: Final = (("held still", SHIPPED, 0.0), ("moved", SHIPPED, _GROWTH), ("held still, every scan", _EVERY_SCAN, 0.0))
_SEED: Final = 23


def held_rows(model: Model, presses: FrozenPresses) -> list[Row]:
    """Return shares of contacts flagged as stuck so many scans after a taxel first repeats itself."""
    rows: list[Row] = []
    for name, options, growth in _RUNS:
        scans = np.array([_scans_until_stuck(model, presses, at, options, growth) for at in range(len(presses))])
        row: Row = {"contact": name, "contacts": len(presses), "flagged before %": share(scans < 1)}
        rows.append(row | {f"within {within} scans %": share((scans >= 1) & (scans <= within)) for within in _WITHIN})
    return rows


def _scans_until_stuck(model: Model, presses: FrozenPresses, at: int, options: RuntimeOptions, growth: float) -> int:
    """Return the number of the first repeat whose pattern is flagged: 0 if before any, and beyond all if never.

    A taxel that is dead gives an estimate; that counts as detected, too.
    """
    counts = presses.presses.counts[at, 0]
    taxel = np.random.default_rng([_SEED, at]).integers(counts[0].size)
    sensor = PushedSensor(model, seed=at, options=options)
    sensor.free()
    held = None
    for number in range(-_BEFORE, _AFTER):
        reading = counts * (1 + growth * (number + _BEFORE)) + sensor.noise()
        if number >= 0 and held is not None:
            reading.reshape(3, -1)[:, taxel] = held
        held = reading.reshape(3, -1)[:, taxel].copy()
        result = sensor.push(reading)
        if result.untrusted_reason == "stuck" or result.dead:
            return max(number + 1, 0)
    return _AFTER + 1

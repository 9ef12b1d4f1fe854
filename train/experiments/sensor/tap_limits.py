"""Limits of what several taps tell the shipped model: what is known, what disturbs the readings, and its own variance.

Four and seven taps half a pitch apart, of the figures of `posed-taps`; no choice depended on them. An oracle that knows
the figure shows what the readings hold.
"""

from pathlib import Path
from typing import Final

import numpy as np

from edge.evaluation.metrics import psnr_db
from edge.inference.onnx_session import ModelSession
from edge.terminal.progress_bar import tracked
from firmware_bridge.scans.pad_constants import Pad
from train.data.frozen_presses import FrozenPresses, freeze_presses
from train.data.generation_config import SEED
from train.data.posed_batches import stated_poses
from train.experiments.sensor.posed_taps import MODEL, USUAL, presses_of
from train.experiments.support.shipped import ALL, NOTHING, PAD, infer, known_pads
from train.experiments.support.tap_oracle import SCHEDULE, tap_oracle_rows
from train.experiments.support.workbench import Workbench
from train.physics.sensor_noise import Nuisances
from train.physics.simulated_sensor import MAX_INDENTATION_MM
from train.report import Report, Row, with_interval

_GAINS: Final = "gains"
_KNOWN: Final = (NOTHING, PAD, _GAINS, ALL)
_EVERYTHING: Final = "all of them"
_WITHOUT: Final = {
    "nothing": (),
    "gains": ("gain_spread",),
    "drift and earth's field": ("thermal_drift_counts", "earth_field_counts"),
    "hysteresis and cross-talk": ("hysteresis", "cross_talk"),
    "noise": ("noise_counts",),
    _EVERYTHING: (
        "gain_spread",
        "thermal_drift_counts",
        "earth_field_counts",
        "hysteresis",
        "cross_talk",
        "noise_counts",
    ),
}
_TAPS: Final = (1, 4, 7)
_MIRRORED_AXES: Final = np.array([-1, 1, 1], dtype=np.float32)[:, None, None]
_MIRRORED_POSE: Final = np.array([-1, 1, -1, 1, 1], dtype=np.float32)


def run(bench: Workbench, folder: Path) -> Path:
    """Evaluate the model that takes poses with one limit after another lifted, and write the report `tap-limits`."""
    model = ModelSession(bench.use(bench.models / f"{MODEL}.onnx"))
    presses = presses_of(bench, SCHEDULE, figures=True)
    usual = freeze_presses(presses, SEED)
    report = Report("tap-limits", folder, __file__, bench.used, quick=bench.quick)
    report.say(
        f"`{model.name}` (training {model.contract.training_sha256[:12]}) through the runtime's session, on the "
        f"{len(usual)} sequences half a pitch apart of `posed-taps` (sha256 {usual.presses.sha256()[:12]}): unseen "
        "figures, pads of their own, stated and true errors of the poses "
        f"{USUAL[0]} mm and {USUAL[1]:g} degree where not stated otherwise. PSNR in dB, full scale "
        f"{MAX_INDENTATION_MM} mm; gains are over one tap under the same conditions, paired, 95 % intervals by figure. "
        "Run time: median of a scan, one thread."
    )
    rows = [_row(model, usual, {"known": known}, known) for known in tracked(_KNOWN, "taps", "row")]
    report.table(rows, "By what is known of the sensor: constants of its pad, gains of its taxels.", "known")
    rows = []
    for name, off in tracked(_WITHOUT.items(), "taps", "row"):
        rows.append(_row(model, freeze_presses(presses, SEED, Nuisances().without(*off)), {"without": name}, NOTHING))
    ideal = freeze_presses(presses, SEED, Nuisances().without(*_WITHOUT[_EVERYTHING]))
    rows.append(_row(model, ideal, {"without": f"{_EVERYTHING}, pad known, poses exact"}, ALL, (0.0, 0.0)))
    report.table(rows, "By what does not disturb the readings; nothing known of pad and gains in all but the last row.")
    report.table(
        [
            _row(model, usual, {"averaged": name}, NOTHING, mirrored=both)
            for name, both in (("no", False), ("yes", True))
        ],
        "Averaged with the mirror image of the pattern of the mirrored window, which ought to be the same: what that "
        "gains is the network's own error, and takes twice the run time.",
        "mirrored",
    )
    report.table(
        tap_oracle_rows(model, quick=bench.quick),
        f"What the readings hold: other figures, on pads of their own, {SCHEDULE}. The oracle knows figure, pad, "
        "gains, the place to 0.5 mm and 5 degrees, and the poses as the model does (standard deviations), and fits the "
        "simulator to the readings of all taps by Gauss-Newton, from the mean of its prior and from near the truth; "
        "the more probable of the two optima counts. No method that does not know the figure can be expected to do as "
        "well. Earlier taps show a model the figure, which the oracle knows already: its gain bounds no model's.",
        "oracle",
    )
    return report.write()


def _row(
    model: ModelSession,
    frozen: FrozenPresses,
    row: Row,
    known: str,
    errors: tuple[float, float] = USUAL,
    *,
    mirrored: bool = False,
) -> Row:
    """Return the row with the error of each number of taps."""
    pads = _gains_only(frozen) if known == _GAINS else known_pads(frozen, known)
    poses = stated_poses(np.random.default_rng(SEED), frozen.presses.poses, errors)
    each, alone = np.arange(len(frozen)), np.zeros(len(frozen))
    for taps in _TAPS:
        windows, stated = frozen.windows(taps), poses[:, :taps]
        done = infer(model, windows, pads, stated)
        patterns, run_time_us = done.patterns, done.run_time_us
        if mirrored:
            other = infer(model, windows[..., ::-1] * _MIRRORED_AXES, pads, stated * _MIRRORED_POSE)
            patterns, run_time_us = (patterns + other.patterns[..., ::-1]) / 2, run_time_us + other.run_time_us
        found = psnr_db(patterns, frozen.patterns(), MAX_INDENTATION_MM)
        if taps == 1:
            alone = found
            row |= {"one tap dB": with_interval(found, each)}
        else:
            row |= {f"gain of {taps} taps": with_interval(found - alone, each)}
        row |= {f"{taps} taps us" if taps > 1 else "one tap us": round(run_time_us)}
    return row


def _gains_only(frozen: FrozenPresses) -> list[Pad | None]:
    gains = frozen.gains.reshape(len(frozen), -1)
    return [Pad(gains=tuple(row.tolist()), gain_half_widths=(0.0,) * len(row)) for row in gains]

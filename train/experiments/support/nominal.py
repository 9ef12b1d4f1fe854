"""Evaluation of the shipped model on the nominal pad: the frozen test set, and figures that it was not trained on."""

from dataclasses import replace
from typing import Final

import numpy as np

from edge.evaluation.evaluate import judge
from edge.evaluation.test_set import FrozenSet, load_frozen_set
from edge.inference.bundled import BUNDLE_DIR
from edge.inference.onnx_session import ModelSession
from edge.terminal.progress_bar import tracked
from firmware_bridge.scans.pad_constants import GAINS, Pad
from train.data.generation_config import random_figures
from train.experiments.support.scores import pattern_cells
from train.experiments.support.shipped import ALL, NOTHING, PAD, infer
from train.experiments.support.workbench import Workbench
from train.physics.pad_draws import INPUTS, NOMINAL
from train.physics.sensor_noise import Nuisances
from train.report import Row

TEST_FIGURES: Final = 24
TEST_SEED: Final = 999
"""Seed of the figures, the same as in reports/unseen.md."""
NOMINAL_PAD: Final = Pad(**{name: getattr(NOMINAL, name) for name in INPUTS})
"""Constants that a sensor file of the nominal pad holds."""
_KNOWN: Final = {NOTHING: None, PAD: NOMINAL_PAD, ALL: replace(NOMINAL_PAD, gains=(1.0,) * GAINS)}


def nominal_rows(bench: Workbench, model: ModelSession) -> list[Row]:
    """Return errors on each set with no constants, with the pad's constants, and with pad and gains."""
    even = Nuisances().without("gain_spread")
    figures = random_figures(TEST_FIGURES, TEST_FIGURES, TEST_SEED)
    kinds = {"glyphs": figures[:TEST_FIGURES], "polygons": figures[TEST_FIGURES:]}
    bundled = load_frozen_set(bench.use(BUNDLE_DIR / "frozen.npz"))
    sets = {"frozen.npz": (bundled.thinned(8) if bench.quick else bundled, bench.frozen("test", nuisances=even))}
    for name, surfaces in kinds.items():
        read = (bench.frozen("test", surfaces), bench.frozen("test", surfaces, nuisances=even))
        sets[name] = (at_full_press(read[0]), at_full_press(read[1]))
    rows: list[Row] = []
    for name, (as_read, with_even_gains) in tracked(sets.items(), "judging", "set"):
        for known, pad in _KNOWN.items():
            frozen = with_even_gains if known == ALL else as_read
            found = infer(model, frozen.windows(model.contract.taps), [pad] * len(frozen))
            errors = judge(found.patterns, frozen, model.contract.contact_level)
            cells = pattern_cells(errors, frozen.patterns(), frozen.full_scale_mm, frozen.tap)
            rows.append({"set": name, "frames": len(frozen), "known": known} | cells)
    return rows


def at_full_press(frozen: FrozenSet) -> FrozenSet:
    """Return the last frame of every tap."""
    last = np.flatnonzero(np.diff(frozen.tap, append=-1) != 0)
    frames = ("newest", "tap", "indentation_mm", "force_n")
    return replace(frozen, **{name: getattr(frozen, name)[last] for name in frames})

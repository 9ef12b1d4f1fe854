"""Several taps over one in the paper's own comparison: its figures, its pad, turned by 5 degrees from tap to tap.

The frozen set has 72 sequences, whose intervals are as wide as the gain. A second set of ten times as many, at poses of
their own, was drawn once for this comparison; nothing is trained on it, set by it or chosen by it. Networks learn the
figures themselves, some longer than others; so one of several taps is also compared with itself, given one tap.

Source: Wu and Liu 2024, Fig. 13.
"""

from pathlib import Path
from typing import Final

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from edge.evaluation.metrics import psnr_db
from edge.evaluation.test_set import FrozenSet
from edge.inference.bundled import DEFAULT_MODEL, POSED_MODEL
from edge.inference.contract import INPUT_NAME, OUTPUT_NAME, PAD_NAME, POSES_NAME
from edge.inference.onnx_session import ModelSession
from edge.inference.pose_input import POSE_WIDTH
from edge.terminal.progress_bar import tracked
from firmware_bridge.pad_geometry import AXES
from train.data.batches import network_input
from train.data.generation_config import SEED, Generation
from train.experiments.support.shipped import infer
from train.experiments.support.workbench import Workbench
from train.freeze import freeze
from train.physics.pad_draws import KNOWN
from train.physics.sensor_noise import Nuisances
from train.report import Report, Row, with_interval
from train.surfaces.named_surfaces import SURFACES
from train.surfaces.poses import MAX_TAPS

_MORE: Final = Generation(surfaces=SURFACES, count=720, taps=MAX_TAPS, seed=2_000_029)
"""Ten times the frozen set's sequences."""
_EVERY: Final = 4
"""One frame in so many of a press is evaluated."""
_AT_ONCE: Final = 128
_WAYS: Final = (("mtsr4-int8", 4), (POSED_MODEL, 4), (POSED_MODEL, MAX_TAPS))
_OWN: Final = f"{POSED_MODEL}, its network of several taps"
"""Single taps in the network that the model has for several: the model itself has another one for them."""


def run(bench: Workbench, folder: Path) -> Path:
    """Evaluate the shipped models of several taps next to that of one, and write the report `paper-schedule`."""
    more = freeze(bench.data("paper-schedule", _MORE), Nuisances(), SEED)
    sets = {"frozen set": bench.frozen("test"), "more sequences": more}
    names = dict.fromkeys([DEFAULT_MODEL, *(name for name, _ in _WAYS)])
    models = {name: ModelSession(bench.use(bench.models / f"{name}.onnx")) for name in names}
    report = Report("paper-schedule", folder, __file__, bench.used, quick=bench.quick)
    posed = bench.models / f"{POSED_MODEL}.onnx"
    rows = [row for name, one in tracked(sets.items(), "taps", "set") for row in _rows(models, posed, name, one)]
    report.say(
        "Shipped models through the runtime's session, the paper's 18 figures on the nominal pad, no poses stated: the "
        "paper's schedule is assumed. All nuisances, gains N(1, .075). PSNR in dB over presses of 30 to 100 % of their "
        f"force; gains are over `{DEFAULT_MODEL}` with the newest tap of the same sequences, paired; 95 % intervals by "
        "sequence, and by figure as if other figures could have been drawn. Run time: median of a scan, one thread. "
        f"The last column is over the row '{_OWN}' with one tap: the same figures were trained equally long there. "
        f"sha256 of the frozen set: {sets['frozen set'].sha256()[:12]}; with more sequences: {more.sha256()[:12]}."
    )
    report.table(rows, "By model and number of taps.")
    return report.write()


def _rows(models: dict[str, ModelSession], posed: Path, name: str, frozen: FrozenSet) -> list[Row]:
    """Return a row for each model and number of taps."""
    frozen = frozen.thinned(_EVERY)
    own = _given_one_tap(posed, frozen.windows(1))
    found: dict[tuple[str, int], tuple[NDArray[np.float32], float | None]] = {
        (DEFAULT_MODEL, 1): _infer(models[DEFAULT_MODEL], frozen, 1),
        (_OWN, 1): (own, None),
    }
    found |= {(model, taps): _infer(models[model], frozen, taps) for model, taps in _WAYS}
    (one, _), truth, full_scale = found[DEFAULT_MODEL, 1], frozen.patterns(), frozen.full_scale_mm
    alone, own_alone = psnr_db(one, truth, full_scale), psnr_db(own, truth, full_scale)
    figure = np.unique(frozen.surface, return_inverse=True)[1][frozen.tap]
    rows: list[Row] = []
    for (model, taps), (patterns, run_time_us) in found.items():
        error = psnr_db(patterns, truth, full_scale)
        row: Row = {"set": name, "sequences": len(frozen.surface), "model": model, "taps": taps}
        row["PSNR dB"] = with_interval(error, frozen.tap)
        row["over one tap"] = None if model == DEFAULT_MODEL else with_interval(error - alone, frozen.tap)
        row["over one tap, by figure"] = None if model == DEFAULT_MODEL else with_interval(error - alone, figure)
        several = model == POSED_MODEL and taps > 1
        row["over its own network with one"] = with_interval(error - own_alone, frozen.tap) if several else None
        rows.append(row | {"run time us": None if run_time_us is None else round(run_time_us)})
    return rows


def _infer(model: ModelSession, frozen: FrozenSet, taps: int) -> tuple[NDArray[np.float32], float]:
    """Return the patterns (n, H, W) in [mm] of the frames with so many taps, and the run time of one in [us]."""
    windows = frozen.windows(taps)
    done = infer(model, windows, [None] * len(windows))
    return done.patterns, done.run_time_us


def _given_one_tap(path: Path, windows: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the patterns that the network of several taps gives for windows (n, 1, 3, rows, cols) of one tap."""
    graph = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    patterns: list[NDArray[np.float32]] = []
    for part in np.array_split(windows, len(windows) // _AT_ONCE + 1):
        scaled = network_input(part).unflatten(1, (-1, len(AXES))).numpy()
        given = {
            INPUT_NAME: np.concatenate([scaled, np.zeros_like(scaled)], axis=1),  # an absent tap next to it
            PAD_NAME: np.zeros((len(scaled), KNOWN), dtype=np.float32),
            POSES_NAME: np.zeros((len(scaled), 2, POSE_WIDTH), dtype=np.float32),
        }
        patterns.append(np.asarray(graph.run([OUTPUT_NAME], given)[0], dtype=np.float32))
    return np.concatenate(patterns)

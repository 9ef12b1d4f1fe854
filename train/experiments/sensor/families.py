"""The shipped model on every family of shapes on unseen pads, beside methods without a network, and its intervals.

No choice depended on these presses: networks, baselines, contact levels and the baseline that is called the best were
settled on training and validation presses, on other pads.
"""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.classical_methods import Method, bilinear, fit_gain, fit_linear_map
from edge.evaluation.metrics import psnr_db
from edge.evaluation.test_set import judge
from edge.inference.intervals import REGIONS, half_widths_mm, near_pixels, regions
from edge.inference.onnx_session import ModelSession
from edge.terminal.progress_bar import tracked
from train.data.frozen_presses import FrozenPresses, freeze_presses
from train.data.press_batches import COUNTS_PER_UNIT, read_presses
from train.data.presses import SEED, PressSet
from train.data.world import World
from train.experiments.sensor.shipped import ALL, NOTHING, SHORT, Inferred, infer_presses
from train.experiments.workbench import Figures, Workbench
from train.families.catalogue import SHARES
from train.learning.checkpoint import best_contact_level
from train.physics.gripped import MAX_INDENTATION_MM, SCALE
from train.physics.sensor_noise import Nuisances
from train.report import Report, Row, with_interval

TRAINING: Final = World(count=24_000, per_pad=48, seed=67)
VALIDATION: Final = World(count=2520, taps=7, per_pad=10, families=dict.fromkeys(SHARES, 1.0), seed=1_000_001)
"""Settings of data/gripped.npz and data/validation.npz in the Makefile."""
_MODEL: Final = (NOTHING, ALL)
_OURS: Final = tuple(SHORT[known] for known in _MODEL)
_LEVEL: Final = "90"
_NEAREST: Final = 8
_AT_ONCE: Final = 64


class Found(NamedTuple):
    """Errors of one method on the wide test set, and its run time."""

    figures: Figures
    run_time_us: float


class Baseline(NamedTuple):
    """Method from the newest tap, with the level of contact that suits validation best, and its mean PSNR there."""

    name: str
    run: Method
    contact_level: float
    validation_db: float

    def found(self, wide: FrozenPresses) -> Found:
        """Return the errors on a set, and the median run time of a scan."""
        newest, times_s = wide.windows(1)[:, 0], []
        for index in range(min(len(newest), 100)):
            started_s = time.perf_counter()
            self.run(newest[index : index + 1])
            times_s.append(time.perf_counter() - started_s)
        figures = judge(self.run(newest), wide.as_frozen_set(), self.contact_level)
        return Found(figures, 1e6 * float(np.median(times_s)))


def run(bench: Workbench, folder: Path) -> Path:
    """Evaluate all methods, and write the report `families`."""
    wide = bench.wide_test()
    model = bench.model()
    validation = freeze_presses(bench.presses("validation", VALIDATION), SEED)
    baselines = fit_baselines(bench.presses("gripped", TRAINING), validation)
    best = max(baselines, key=lambda one: one.validation_db).name
    inferred = {SHORT[known]: infer_presses(model, wide, known) for known in _MODEL}
    frozen, level = wide.as_frozen_set(), model.contract.contact_level
    found = {name: Found(judge(one.patterns, frozen, level), one.run_time_us) for name, one in inferred.items()}
    found |= {one.name: one.found(wide) for one in tracked(baselines, "judging", "baseline")}

    report = Report("families", folder, __file__, bench.used, quick=bench.quick)
    report.say(
        f"`{model.name}` (training {model.contract.training_sha256[:12]}), through the runtime's session, one tap. "
        f"Wide test set: {len(wide)} presses of {len(np.unique(wide.presses.family))} families, as many of each, on "
        f"{len(np.unique(wide.presses.pad))} pads that nothing was trained on or chosen by, sha256 "
        f"{wide.presses.sha256()[:12]}. Full scale {MAX_INDENTATION_MM} mm. 95 % intervals are by pad. Known: all "
        "constants of the pad that a sensor file holds, and the taxels' gains. Baselines see the newest tap and are "
        "fitted on the training presses, as sensors of their own read them: bilinear by one gain, the linear map by "
        f"ridge regression, the mean of the {_NEAREST} presses of nearest readings. Best of them on validation: "
        f"{best}. Run time: median of a scan, one thread."
    )
    truth, pads = wide.patterns(), wide.presses.pad
    rows: list[Row] = [
        {
            "method": name,
            "PSNR dB": with_interval(figures["psnr_db"], pads),
            "IoU": round(float(figures["contact_iou"].mean()), 3),
            "edge mm": round(float(figures["boundary_mm"].mean()), 3),
            "RMSE %": round(float(figures["rmse_percent"].mean()), 2),
            "run time us": round(run_time_us),
        }
        for name, (figures, run_time_us) in found.items()
    ]
    report.table(rows, "All families.", "methods")
    report.table(family_rows(found, best, wide), f"PSNR in dB by family; `over` is over {best}, press by press.")
    if _LEVEL in model.contract.interval_levels:
        text = f"Pixels whose truth the {_LEVEL} % interval holds, in %, by region of the predicted pattern."
        report.table(interval_rows(model, inferred, truth, wide), text, "intervals")
    with report.figure(size=(9, 5)) as figure:
        axes, families = figure.subplots(), _families(wide)
        for number, (name, one) in enumerate(found.items()):
            means = [one.figures["psnr_db"][which].mean() for _, which in families]
            axes.plot(range(len(families)), means, "o-" if name in _OURS else "x:", color=f"C{number}", label=name)
        axes.set(xticks=range(len(families)), ylabel="PSNR [dB]")
        axes.set_xticklabels([family for family, _ in families], rotation=60, ha="right")
        axes.legend(fontsize=8, ncols=2)
    return report.write()


def fit_baselines(training: PressSet, validation: FrozenPresses) -> list[Baseline]:
    """Fit all baselines to the newest presses, each read by a sensor of its own; levels are chosen on validation."""
    newest = read_presses(training.with_taps(1), Nuisances(), SEED)[:, 0]
    patterns = training.patterns.astype(np.float32)
    gain = fit_gain(bilinear(newest[:, 2], SCALE), patterns)
    matrix = fit_linear_map(newest.reshape(len(newest), -1), patterns.reshape(len(patterns), -1))
    methods: Mapping[str, Method] = {
        "bilinear": lambda some: bilinear(some[:, 2], SCALE) * gain,
        "linear map": lambda some: (some.reshape(len(some), -1) @ matrix).reshape(-1, *patterns.shape[1:]),
        f"nearest {_NEAREST}": lambda some: nearest_presses(some, newest, training.patterns, _NEAREST),
    }
    check, truth = validation.windows(1)[:, 0], validation.patterns()
    fitted: list[Baseline] = []
    for name, method in methods.items():
        found = np.asarray(method(check), dtype=np.float32)
        level = best_contact_level(found, validation.presses.touching)
        fitted.append(Baseline(name, method, level, float(psnr_db(found, truth, MAX_INDENTATION_MM).mean())))
    return fitted


def nearest_presses(
    some: NDArray[np.floating], known: NDArray[np.float32], patterns: NDArray[np.float16], count: int
) -> NDArray[np.float32]:
    """Return the mean pattern of the `count` known presses with the nearest readings, compared in network units.

    Readings are (n, 3, rows, cols) and (m, 3, rows, cols) in zeroed counts, patterns (m, H, W) in [mm].
    """
    per_unit = np.array(COUNTS_PER_UNIT, dtype=np.float32)[:, None, None]
    asked, held = ((one / per_unit).reshape(len(one), -1).astype(np.float32) for one in (some, known))
    squares, found = np.square(held).sum(axis=1), []
    for start in range(0, len(asked), _AT_ONCE):
        apart = squares - 2 * asked[start : start + _AT_ONCE] @ held.T
        nearest = np.argpartition(apart, count - 1, axis=1)[:, :count]
        found.append(patterns[nearest].mean(axis=1, dtype=np.float32))
    return np.concatenate(found)


def family_rows(found: Mapping[str, Found], best: str, wide: FrozenPresses) -> list[Row]:
    """Return the PSNR of every method by family and in total, and the model's margin over the best baseline."""
    rows: list[Row] = []
    for family, which in _families(wide):
        found_db = {name: one.figures["psnr_db"][which] for name, one in found.items()}
        pads = wide.presses.pad[which]
        row: Row = {"family": family, "presses": int(which.sum())}
        for name, values in found_db.items():
            row[name] = with_interval(values, pads) if name in _OURS else round(float(values.mean()), 2)
        for name in _OURS:
            row[f"{name}, over"] = with_interval(found_db[name] - found_db[best], pads)
        rows.append(row)
    return rows


def interval_rows(
    model: ModelSession, inferred: Mapping[str, Inferred], truth: NDArray[np.float32], wide: FrozenPresses
) -> list[Row]:
    """Return the share of pixels that the model's intervals hold, by region: of all presses, and by family."""
    contract, rows = model.contract, list[Row]()
    for name, one in inferred.items():
        region = regions(one.patterns, contract.contact_level, near_pixels(contract.scale, contract.pitch_mm))
        widths_mm = half_widths_mm(contract.interval_levels, _LEVEL, one.deviations, region)
        held = 100.0 * (np.abs(one.patterns - truth) <= widths_mm)
        pads = np.broadcast_to(wide.presses.pad[:, None, None], region.shape)
        for family, which in _families(wide) if name == SHORT[NOTHING] else [("all", np.ones(len(wide), dtype=bool))]:
            row: Row = {"family": family, "method": name}
            for number, place in enumerate(REGIONS):
                here = (region == number) & which[:, None, None]
                row[place] = with_interval(held[here], pads[here], 1) if here.any() else None
            rows.append(row)
    return rows


def _families(wide: FrozenPresses) -> list[tuple[str, NDArray[np.bool_]]]:
    """Return names in the catalogue's order with a mask of each family's presses; `all` comes last."""
    family = wide.presses.family
    some = [(name, family == name) for name in SHARES if (family == name).any()]
    return [*some, ("all", np.ones(len(wide), dtype=bool))]

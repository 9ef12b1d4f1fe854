"""The shipped model on every family of shapes on unseen pads, and on pads off the nominal one.

Of families no choice depended on the presses: networks, baselines, contact levels and the baseline that is called the
best were settled on training and validation presses, on other pads. Of pads each constant is changed alone. Shapes,
poses, depths, drags, friction and every draw of the nuisances are then the same on all pads, so that losses are press
by press; half of the shapes are the paper's, half random figures.
"""

import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Final, NamedTuple, cast

import joblib
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
from train.data.presses import SEED, PressSet, one_thread
from train.data.world import World, press_shapes
from train.experiments.workbench import SHORT, Figures, Inferred, Workbench, infer_presses, name_of
from train.families.catalogue import SHARES, Tapped, draw_shape
from train.learning.checkpoint import best_contact_level
from train.physics.gripped import MAX_INDENTATION_MM, SCALE, GrippedPad
from train.physics.pad_draws import INPUTS, NOMINAL, Pad
from train.physics.sensor_noise import Nuisances
from train.report import Report, Row, with_interval

TRAINING: Final = World(count=24_000, per_pad=48, seed=67)
VALIDATION: Final = World(count=2520, taps=7, per_pad=10, families=dict.fromkeys(SHARES, 1.0), seed=1_000_001)
"""Settings of data/gripped.npz and data/validation.npz in the Makefile."""
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


def families(bench: Workbench, report: Report) -> None:
    """Evaluate all methods on the wide test set."""
    wide = bench.wide_test()
    model = bench.model()
    validation = freeze_presses(bench.presses("validation", VALIDATION), SEED)
    baselines = fit_baselines(bench.presses("gripped", TRAINING), validation)
    best = max(baselines, key=lambda one: one.validation_db).name
    inferred = {name: infer_presses(model, wide, known) for known, name in SHORT.items()}
    frozen, level = wide.as_frozen_set(), model.contract.contact_level
    found = {name: Found(judge(one.patterns, frozen, level), one.run_time_us) for name, one in inferred.items()}
    found |= {one.name: one.found(wide) for one in tracked(baselines, "judging", "baseline")}

    report.say(
        f"{name_of(model)}, through the runtime's session, one tap. "
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
    report.table(rows, "All families.")
    report.table(family_rows(found, best, wide), f"PSNR in dB by family; `over` is over {best}, press by press.")
    if _LEVEL in model.contract.interval_levels:
        text = f"Pixels whose truth the {_LEVEL} % interval holds, in %, by region of the predicted pattern."
        report.table(interval_rows(model, inferred, truth, wide), text)


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
            row[name] = with_interval(values, pads) if name in SHORT.values() else round(float(values.mean()), 2)
        for name in SHORT.values():
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
        for family, which in _families(wide) if name == SHORT[False] else [("all", np.ones(len(wide), dtype=bool))]:
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


SHAPES_SEED: Final = 4711
CONSTANTS: Final = (*INPUTS, "pitch_mm", "free_sides")
PERCENT: Final = (5, 10, 20)


class OffPad(NamedTuple):
    """Pad with one constant changed by percent of its nominal value, or of the whole free sides."""

    constant: str
    percent: int

    @property
    def pad(self) -> Pad:
        """Constants of the changed pad."""
        nominal = getattr(NOMINAL, self.constant)
        off = self.percent / 100 * (nominal if self.constant != "free_sides" else 1.0)
        return replace(NOMINAL, **{self.constant: nominal + off})

    @property
    def can_be(self) -> bool:
        """True where such a pad is possible: rubber does not swell when pressed, and sides do not push back."""
        return self.pad.poisson <= 0.499 and self.pad.free_sides >= 0


NONE_OFF: Final = OffPad("thickness_mm", 0)


def pads(bench: Workbench, report: Report) -> None:
    """Make the presses, and evaluate the model on them."""
    percent, count = (PERCENT[-1:], 4) if bench.quick else (PERCENT, 40)
    names = CONSTANTS[:2] if bench.quick else CONSTANTS
    off = [OffPad(name, sign * part) for name in names for part in percent for sign in (-1, 1)]
    off = [NONE_OFF, *(one for one in off if one.can_be)]
    shapes = draw_shapes(count)
    pool = joblib.Parallel(n_jobs=-1, return_as="generator")
    jobs = cast(Iterator[PressSet], pool(joblib.delayed(pressed)(one.pad, shapes) for one in off))
    read = {one: freeze_presses(made, SEED) for one, made in zip(tracked(off, "pads", "pad"), jobs, strict=True)}
    model = bench.model()
    scores = {
        name: {
            one: psnr_db(infer_presses(model, frozen, known).patterns, frozen.patterns(), MAX_INDENTATION_MM)
            for one, frozen in read.items()
        }
        for known, name in SHORT.items()
    }
    plain = {name: with_interval(psnr[NONE_OFF], np.arange(count)) for name, psnr in scores.items()}
    report.say(
        f"{name_of(model)}, one tap; {count} shapes, "
        f"{count // 2} of the paper's surfaces and as many random figures, each pressed alike on every pad and read "
        "with the same draws of all nuisances. All else about a pad is nominal. PSNR on the nominal pad: "
        + "; ".join(f"{name} {value} dB" for name, value in plain.items())
        + ". Known: the constants that the model takes, and the gains; pitch and free sides it cannot be given. Free "
        "sides are off by percent of what finite elements give, upwards alone; a Poisson's ratio 20 % up cannot be."
    )
    rows = loss_rows(scores, list(read))
    report.table(rows, "PSNR lost against the nominal pad in dB, press by press, with 95 % intervals.")


def loss_rows(scores: dict[str, dict[OffPad, NDArray[np.float64]]], off: list[OffPad]) -> list[Row]:
    """Return the loss of each method on each pad, down and up side by side."""
    rows: list[Row] = []
    for constant, percent in dict.fromkeys((one.constant, abs(one.percent)) for one in off if one.percent):
        row: Row = {"constant": constant, "off by %": percent}
        for name, psnr in scores.items():
            for word, sign in (("down", -1), ("up", 1)):
                lost = psnr.get(OffPad(constant, sign * percent))
                row[f"{name}, {word}"] = (
                    None if lost is None else with_interval(psnr[NONE_OFF] - lost, np.arange(len(lost)))
                )
        rows.append(row)
    return rows


def draw_shapes(count: int) -> list[tuple[str, Tapped]]:
    """Draw shapes under the pad with their families; all pads have the same cells, and so the same heights."""
    rng = np.random.default_rng(SHAPES_SEED)
    gripped, one_tap = GrippedPad(NOMINAL), np.zeros((1, 3))
    families = [("paper", "glyph", "paper", "polygon")[number % 4] for number in range(count)]
    return [(family, draw_shape(rng, family, gripped, one_tap)) for family in families]


@one_thread()
def pressed(pad: Pad, shapes: list[tuple[str, Tapped]]) -> PressSet:
    """Press all shapes onto one pad."""
    rng = np.random.default_rng(SHAPES_SEED + 1)
    families = np.array([family for family, _ in shapes])
    return press_shapes(rng, GrippedPad(pad), families, [shape for _, shape in shapes], 0)

"""Intervals by region, family, level and number of taps, and the gain by trusting a model's own uncertainty.

The models' intervals were set on validation presses; here they are evaluated on the wide test set, on other pads, and
outside the conditions of the fit: unseen figures, gratings, a sensor file that is wrong, dead taxels.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.test_set import FrozenSet
from edge.inference.bundled import DEFAULT_MODEL, TAXELS
from edge.inference.expected_error import expect
from edge.inference.intervals import REGIONS, half_widths_mm, near_pixels, regions
from edge.inference.onnx_session import ModelSession
from edge.perception.dead_taxel_fill import load_estimator, widening
from edge.terminal.progress_bar import tracked
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.scans.pad_constants import Pad
from train.data.frozen_presses import FrozenPresses, freeze_presses
from train.data.generation_config import SEED, random_figures
from train.data.presses import join_presses
from train.errors import TrainError
from train.experiments.sensor.pads import SHAPES, OffPad, draw_shapes, pressed
from train.experiments.support.gratings import gratings
from train.experiments.support.nominal import TEST_FIGURES, TEST_SEED, at_full_press
from train.experiments.support.shipped import ALL, NOTHING, known_pads
from train.experiments.support.workbench import Workbench
from train.families.catalogue import SHARES, Tapped
from train.physics.pad_draws import INPUTS, input_scale
from train.report import Report, Row, bootstrap_interval, with_interval

MODELS: Final = (DEFAULT_MODEL, "stsr", "mtsr4-int8", "mtsr4")
WANTED: Final = (88.0, 92.0)
LEAST_UNLIKE: Final = 85.0
LEVEL: Final = "90"
_WRONG: Final = 0.1
_MOST_DEAD: Final = 4
_PIXELS_SHOWN: Final = 200


@dataclass(frozen=True, slots=True)
class Held:
    """Patterns with their deviations, and the truth, of n windows.

    Attributes:
        pattern: (n, H, W) in [mm].
        deviation: (n, H, W) in [mm].
        truth: (n, H, W) in [mm].
        region: (n, H, W), index of REGIONS.
        expected_mm: (n,) RMS error that the runtime expects; not a number where it expects none.
        group: (n,), windows of one pad or one tap, which are not independent.
        levels: the contract's half widths.
    """

    pattern: NDArray[np.float32]
    deviation: NDArray[np.float32]
    truth: NDArray[np.float32]
    region: NDArray[np.int8]
    expected_mm: NDArray[np.float64]
    group: NDArray[np.integer]
    levels: dict[str, list[float]]

    @property
    def rmse_mm(self) -> NDArray[np.float64]:
        """RMS error of each window, (n,)."""
        return np.sqrt(np.square(self.pattern - self.truth, dtype=np.float64).mean(axis=(1, 2)))

    def pick(self, which: NDArray[np.bool_]) -> "Held":
        """Return some of the windows."""
        arrays = ("pattern", "deviation", "truth", "region", "expected_mm", "group")
        return replace(self, **{name: getattr(self, name)[which] for name in arrays})

    def covered(self, level: str = LEVEL) -> NDArray[np.bool_]:
        """Return a mask of the pixels whose truth their interval holds, (n, H, W)."""
        widths = half_widths_mm(self.levels, level, self.deviation, self.region)
        return np.abs(self.pattern - self.truth) <= widths

    def coverage(self, region: int, level: str = LEVEL) -> tuple[float, float, float]:
        """Return the percentage of a region's pixels that are covered, and its 95 % interval by group."""
        there = self.region == region
        pixels = there.sum(axis=(1, 2)).astype(np.float64)
        held = (self.covered(level) & there).sum(axis=(1, 2)).astype(np.float64)
        order, start = np.unique(self.group, return_inverse=True)
        held, pixels = (np.bincount(start, weights=values, minlength=len(order)) for values in (held, pixels))
        drawn = np.random.default_rng(0).integers(len(order), size=(1000, len(order)))
        shares = 100 * held[drawn].sum(axis=1) / np.maximum(pixels[drawn].sum(axis=1), 1)
        low, high = np.quantile(shares, [0.025, 0.975])
        return 100 * float(held.sum() / max(pixels.sum(), 1)), float(low), float(high)


def run(bench: Workbench, folder: Path) -> Path:
    """Evaluate the intervals of the shipped models, and write the report `intervals`."""
    wide = bench.wide_test()
    names = [name for name in (MODELS[:1] if bench.quick else MODELS) if (bench.models / f"{name}.onnx").exists()]
    models = [ModelSession(bench.use(bench.models / f"{name}.onnx")) for name in names]
    found = {
        (model.name, known, given): hold_presses(model, wide, known, given)
        for model in tracked(models, "judging", "model")
        for known in (NOTHING, ALL)
        for given in range(1, model.contract.taps + 1)
    }
    report = Report("interval-coverage", folder, __file__, bench.used, quick=bench.quick)
    report.say(
        f"Share of the pixels whose truth the interval holds, on the wide test set: {len(wide)} presses of "
        f"{len(np.unique(wide.presses.family))} families on {len(np.unique(wide.presses.pad))} pads; 95 % intervals by "
        "pad. Regions are those of the predicted pattern: inside the contact, the pixels on both sides of its outline, "
        "up to 2 mm outside, and the rest. Nothing was set by these presses: factors are of training presses, levels "
        "of validation presses. Known: nothing, or all constants of the pad and the taxels' gains."
    )
    report.table(level_rows(found), "Coverage in % by level, region and number of taps, all families.")
    for model in models:
        if model.name.endswith("int8"):
            _tell_families(report, model, found, wide)
    model = models[0]
    unlike = unlike_rows(bench, model, wide)
    report.table(
        unlike,
        f"`{model.name}` outside the conditions of the fit: coverage in % of the 90 % interval, wanted "
        f"{LEAST_UNLIKE:g} or more. Pads off the nominal one press {SHAPES} of the paper's and random figures, with "
        "one constant off by 10 %, up and down, and nothing known. A sensor file that is wrong has every constant of "
        "the wide set's pads off by 10 %, up or down. Dead taxels are found and filled in as in the runtime.",
        "unlike",
    )
    report.table(
        expected_rows(found, wide),
        "`expected_rmse_mm` over the RMS error that came out, by family, nothing known; 95 % intervals by pad.",
        "expected",
    )
    risks = {key: one for key, one in found.items() if key[2] == max(k[2] for k in found if k[0] == key[0])}
    report.table(
        [risk_row(key, one) for key, one in risks.items()],
        "Risk against coverage: RMSE in um of all, and of the half that the model trusts most: patterns of least "
        "expected error, patterns of least expected error over their own RMS (their error over it in %), pixels of "
        "least deviation. In brackets the half that has the least true errors.",
        "risk",
    )
    with report.figure(size=(12, 4.2)) as figure:
        axes = figure.subplots(1, 3)
        held = found[model.name, NOTHING, 1]
        _plot_levels(axes[0], held)
        _plot_families(axes[1], held, wide)
        _plot_risk(axes[2], held)
    return report.write()


def hold_presses(
    model: ModelSession, frozen: FrozenPresses, known: str, given: int, pads: Sequence[Pad | None] | None = None
) -> Held:
    """Run a model on presses with the newest `given` taps, with the constants that are known, or with these pads."""
    pads = known_pads(frozen, known) if pads is None else pads
    return hold(model, frozen.windows(model.contract.taps), pads, frozen.patterns(), frozen.presses.pad, given)


def hold_frozen(model: ModelSession, frozen: FrozenSet) -> Held:
    """Run a model on a frozen set of which nothing is known."""
    taps = model.contract.taps
    return hold(model, frozen.windows(taps), [None] * len(frozen), frozen.patterns(), frozen.tap, taps)


def hold(
    model: ModelSession,
    windows: NDArray[np.float32],
    pads: Sequence[Pad | None],
    truth: NDArray[np.float32],
    group: NDArray[np.integer],
    given: int,
    widen: float = 1.0,
) -> Held:
    """Run a model as the runtime does, window by window.

    Raises:
        TrainError: the model's contract has no levels of intervals.
    """
    contract = model.contract
    if LEVEL not in contract.interval_levels or model.deviation is None:
        raise TrainError(f"model '{model.name}' has no levels of intervals: export it with --validation presses")
    patterns, deviations, expected = [], [], []
    for window, pad in zip(windows, pads, strict=True):
        gains = None
        if contract.takes_gains and pad is not None and pad.gains is not None:
            gains = np.asarray(pad.gains, dtype=np.float32).reshape(window.shape[1:])
        scaled = contract.scale_window(window, gains)
        scaled[given:] = 0
        patterns.append(model.run(scaled, contract.pad_row(pad)).copy())
        deviations.append(model.deviation * np.float32(widen))
        told = expect(contract.confidence, given, patterns[-1], deviations[-1])
        expected.append(math.nan if told is None else told.rmse)
    pattern = np.stack(patterns)
    region = regions(pattern, contract.contact_level, near_pixels(contract.scale, contract.pitch_mm))
    return Held(pattern, np.stack(deviations), truth, region, np.array(expected), group, contract.interval_levels)


_Found = Mapping[tuple[str, str, int], Held]
"""Results by model, what is known, and number of taps."""


def level_rows(found: _Found) -> list[Row]:
    """Return the coverage of every level in every region."""
    rows: list[Row] = []
    for (model, known, given), held in found.items():
        for level in held.levels:
            row: Row = {"model": model, "known": known, "taps": given, "level %": float(level)}
            rows.append(row | _region_cells(held, level))
    return rows


def _region_cells(held: Held, level: str = LEVEL) -> Row:
    cells: Row = {}
    for number, name in enumerate(REGIONS):
        share, low, high = held.coverage(number, level)
        cells[name] = f"{share:.1f} ({low:.1f}..{high:.1f})"
    return cells


def _families(wide: FrozenPresses) -> list[tuple[str, NDArray[np.bool_]]]:
    family = wide.presses.family
    return [(name, family == name) for name in SHARES if (family == name).any()]


def _tell_families(report: Report, model: ModelSession, found: _Found, wide: FrozenPresses) -> None:
    """Write the coverage by family and region, with how many lie within what was wanted, and how many could."""
    given = model.contract.taps
    held = found[model.name, NOTHING, given]
    parts = [(name, held.pick(which)) for name, which in _families(wide)]
    cells = [[part.coverage(number) for number in range(len(REGIONS))] for _, part in parts]
    flat = [cell for row in cells for cell in row]
    within = sum(WANTED[0] <= share <= WANTED[1] for share, _, _ in flat)
    could = sum(low <= WANTED[1] and high >= WANTED[0] for _, low, high in flat)
    chance = sum(math.erf((WANTED[1] - 90) / max((high - low) / 3.92, 0.1) / math.sqrt(2)) for _, low, high in flat)
    report.table(
        [{"family": name, "presses": len(part.group)} | _region_cells(part) for name, part in parts],
        f"Coverage in % of the 90 % interval of `{model.name}` with {given} taps, nothing known, by family. Of "
        f"{len(flat)} cells {within} lie within {WANTED[0]:g} to {WANTED[1]:g} %; with as many presses an exact "
        f"calibration would have {chance:.0f}. The intervals of {could} reach into that range. Below "
        f"{LEAST_UNLIKE:g} %: {sum(share < LEAST_UNLIKE for share, _, _ in flat)}.",
        f"families-{model.name}",
    )


def unlike_rows(bench: Workbench, model: ModelSession, wide: FrozenPresses) -> list[Row]:
    """Return the coverage outside the conditions of the fit."""
    figures = random_figures(TEST_FIGURES, TEST_FIGURES, TEST_SEED)
    held = {"wide test set": hold_presses(model, wide, NOTHING, model.contract.taps)}
    for name, surfaces in (("unseen glyphs", figures[:TEST_FIGURES]), ("unseen polygons", figures[TEST_FIGURES:])):
        held[name] = hold_frozen(model, at_full_press(bench.frozen("test", surfaces)))
    striped = gratings(bench)
    for name in dict.fromkeys(striped.surface.tolist()):
        taps = np.flatnonzero(striped.surface == name)
        held[Path(name).stem + " mm"] = hold_frozen(model, _frames(striped, np.isin(striped.tap, taps)))
    shapes = draw_shapes(2 if bench.quick else SHAPES)
    for constant in INPUTS[: 1 if bench.quick else None]:
        held[f"pad off by 10 %, {constant}"] = _hold_off(model, constant, shapes)
    rng = np.random.default_rng([SEED, 6])
    wrong = [_wrong(wide.pad(index, gains=True), rng) for index in range(len(wide))]
    held["wide, sensor file wrong by 10 %"] = hold_presses(model, wide, ALL, model.contract.taps, wrong)
    for dead in range(1, 2 if bench.quick else _MOST_DEAD + 1):
        held[f"wide, {dead} dead taxels"] = hold_dead(bench, model, wide, dead)
    rows: list[Row] = []
    for name, one in tracked(held.items(), "coverage", "set"):
        rows.append({"set": name, "windows": len(one.group), "all": _pixels(one)} | _region_cells(one))
    return rows


def _hold_off(model: ModelSession, constant: str, shapes: list[tuple[str, Tapped]]) -> Held:
    """Run a model on pads of which one constant is 10 % below and above the nominal one."""
    pads = [OffPad(constant, percent) for percent in (-10, 10)]
    presses = join_presses([pressed(off.pad, shapes) for off in pads if off.can_be])
    frozen = freeze_presses(presses, SEED)
    taps = model.contract.taps
    group = np.arange(len(frozen)) % len(shapes)
    return hold(model, frozen.windows(taps), [None] * len(frozen), frozen.patterns(), group, taps)


def _pixels(held: Held) -> str:
    return with_interval(100 * held.covered().mean(axis=(1, 2)), held.group, 1)


def _frames(frozen: FrozenSet, which: NDArray[np.bool_]) -> FrozenSet:
    return replace(frozen, **{n: getattr(frozen, n)[which] for n in ("newest", "tap", "indentation_mm", "force_n")})


def _wrong(pad: Pad, rng: np.random.Generator) -> Pad:
    off = {name: pad.constants[name] * (1 + _WRONG * rng.choice([-1, 1])) for name, _, _ in input_scale()}
    off["poisson"] = min(off["poisson"], 0.499)
    return replace(pad, **off)


def hold_dead(bench: Workbench, model: ModelSession, wide: FrozenPresses, dead: int) -> Held:
    """Run a model on the wide set with so many taxels of every sensor dead, filled in and widened as in the runtime."""
    estimator = load_estimator(bench.use(TAXELS), (USPA44.rows, USPA44.cols))
    windows = wide.windows(model.contract.taps).copy()
    for pad in np.unique(wide.presses.pad):
        failing = np.random.default_rng([SEED, 7, int(pad)]).permutation(USPA44.taxel_count) < dead
        fill = estimator.filler(failing.reshape(USPA44.rows, USPA44.cols))
        for index in np.flatnonzero(wide.presses.pad == pad):
            for tap in range(windows.shape[1]):
                windows[index, tap] = fill(windows[index, tap]).counts
    pads = [None] * len(wide)
    widen = widening(dead / USPA44.taxel_count)
    return hold(model, windows, pads, wide.patterns(), wide.presses.pad, model.contract.taps, widen)


def expected_rows(found: _Found, wide: FrozenPresses) -> list[Row]:
    """Return the ratio of expected to true error by family, for every model with all its taps."""
    rows: list[Row] = []
    for name, which in [*_families(wide), ("all", np.ones(len(wide), dtype=bool))]:
        row: Row = {"family": name}
        for (model, known, given), held in found.items():
            if known == NOTHING and (model, known, given + 1) not in found:
                part = held.pick(which & np.isfinite(held.expected_mm))
                error = part.rmse_mm
                ratio = part.expected_mm.sum() / error.sum()
                low, high = bootstrap_interval((part.expected_mm - error) / error.mean(), part.group)
                row[model] = f"{ratio:.2f} ({1 + low:.2f}..{1 + high:.2f})"
        rows.append(row)
    return rows


def risk_row(key: tuple[str, str, int], held: Held) -> Row:
    """Return errors of all patterns and pixels, and of the trusted half of them."""
    held = held.pick(np.isfinite(held.expected_mm))
    error, size = held.rmse_mm, np.sqrt(np.square(held.pattern, dtype=np.float64).mean(axis=(1, 2)))
    true_size = np.sqrt(np.square(held.truth, dtype=np.float64).mean(axis=(1, 2)))
    share, pixels = error / true_size, np.abs(held.pattern - held.truth).ravel()

    def halves(by: NDArray[np.floating], best: NDArray[np.floating]) -> str:
        return f"{_risk(best, by)[-1]:.1f} -> {_half(best, by):.1f} ({_half(best, best):.1f})"

    model, known, given = key
    return {
        "model": model,
        "known": known,
        "taps": given,
        "patterns, um": halves(held.expected_mm, 1e3 * error),
        "patterns, % of their RMS": halves(held.expected_mm / np.maximum(size, 1e-6), 100 * share),
        "pixels, um": halves(held.deviation.ravel(), 1e3 * pixels),
    }


def _risk(errors: NDArray[np.floating], by: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the RMS error of the share of least `by`, for every share from the first to all."""
    ordered = np.square(errors[np.argsort(by, kind="stable")], dtype=np.float64)
    return np.sqrt(np.cumsum(ordered) / np.arange(1, len(ordered) + 1))


def _half(errors: NDArray[np.floating], by: NDArray[np.floating]) -> float:
    return float(_risk(errors, by)[len(errors) // 2 - 1])


def _plot_levels(axes, held: Held) -> None:
    levels = [float(level) for level in held.levels]
    for number, name in enumerate(REGIONS):
        axes.plot(levels, [held.coverage(number, level)[0] for level in held.levels], "o-", ms=3, label=name)
    axes.plot(levels, levels, "k:", lw=1)
    axes.set(xlabel="level of the interval, %", ylabel="pixels that it holds, %", title="one tap, nothing known")
    axes.legend(fontsize=8)


def _plot_families(axes, held: Held, wide: FrozenPresses) -> None:
    parts = [(name, held.pick(which)) for name, which in _families(wide)]
    for number, region in enumerate(REGIONS):
        seen = np.array([part.coverage(number) for _, part in parts])
        away = np.abs(seen[:, 1:] - seen[:, :1]).T
        places = np.arange(len(parts)) + 0.15 * (number - 1.5)
        axes.errorbar(places, seen[:, 0], away, fmt="o", ms=3, lw=0.7, label=region)
    axes.axhspan(*WANTED, color="0.9", zorder=0)
    axes.set(xticks=range(len(parts)), ylabel="held by the 90 % interval, %", title="by family, 95 % intervals by pad")
    axes.set_xticklabels([name for name, _ in parts], rotation=75, ha="right", fontsize=7)


def _plot_risk(axes, held: Held) -> None:
    held = held.pick(np.isfinite(held.expected_mm))
    error = 1e3 * held.rmse_mm
    pixels = 1e3 * np.abs(held.pattern - held.truth).ravel()
    for name, values, by in (("patterns", error, held.expected_mm), ("pixels", pixels, held.deviation.ravel())):
        for how, order, style in (("by the model", by, "-"), ("by true error", values, ":")):
            risk = _risk(values, order)
            at = np.linspace(len(risk) // 20, len(risk) - 1, _PIXELS_SHOWN).astype(int)
            color = "C0" if name == "patterns" else "C1"
            axes.plot(100 * (at + 1) / len(risk), risk[at], style, color=color, label=f"{name}, {how}")
    axes.set(xlabel="trusted share, %", ylabel="RMSE of the trusted, um", title="risk against coverage")
    axes.legend(fontsize=8)

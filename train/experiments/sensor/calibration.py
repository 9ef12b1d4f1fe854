"""Calibration of the predicted deviations, in total and for features that the pad cannot resolve.

A tap is a low pass twice over: the layer damps features finer than its thickness, and taxels a pitch apart do not
determine waves shorter than two pitches. Finer detail is a guess from the surfaces trained on, and the deviation should
be wide there. Gratings of stripes, which no network has been trained on, test that wave by wave.
"""

from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.metrics import psnr_db
from edge.terminal.progress_bar import tracked
from firmware_bridge.pad_geometry import USPA44
from train.data.generation_config import random_figures
from train.experiments.paper.unseen import TEST_FIGURES, TEST_SEED
from train.experiments.support.band_limit import WAVELENGTHS_MM, edge_distance_mm, gratings, kept_back, let_through
from train.experiments.support.intervals import Intervals, intervals
from train.experiments.support.trainings import compact, mixed, trained
from train.experiments.support.workbench import Workbench, cost_cells
from train.learning.interval_calibration import LEVEL
from train.networks.blocks import PatternNet
from train.report import Cell, Report, Row, with_interval

NAMES: Final = ("stsr", "mtsr2", "mtsr4")
LEVELS: Final = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)
BOUNDS_PERCENT: Final = (88.0, 92.0)
"""Bounds of the share of held-out pixels that the 90 % interval is to cover, in [%]."""
EDGES_MM: Final = (-np.inf, -2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0, 4.0, np.inf)
"""Bins of the distance to the contact's edge, negative inside, in [mm]."""

_TEST, _GLYPHS = "test", "unseen glyphs"

_Found = dict[tuple[str, str], Intervals]
"""Intervals by network and frozen set."""


def run(bench: Workbench, folder: Path) -> Path:
    """Evaluate the deviations of the networks, and write the report `calibration`."""
    data, validation = mixed(bench), bench.frozen("validation")
    nets = {name: trained(bench, compact(name), data, validation) for name in NAMES}
    sets = {_TEST: bench.frozen("test"), _GLYPHS: bench.frozen("test", random_figures(TEST_FIGURES, 0, TEST_SEED))}
    found = {
        (name, tested): intervals(nets[name][0], frozen)
        for name in tracked(NAMES, "judging", "network")
        for tested, frozen in sets.items()
    }
    striped = gratings(bench)
    by_wave = {name: grating_rows(intervals(nets[name][0], striped)) for name in NAMES}
    distance_mm = {tested: edge_distance_mm(frozen.touched, frozen.scale) for tested, frozen in sets.items()}
    by_distance = [
        row for (name, tested), seen in found.items() for row in _distance_rows(name, tested, seen, distance_mm[tested])
    ]

    report = Report("calibration", folder, __file__, bench.used, quick=bench.quick)
    report.say(
        "Deviations are scaled once, on the validation position; here they are evaluated at the test position, on the "
        f"18 surfaces and on {TEST_FIGURES} glyphs that no network was trained on. Intervals of the mean are by tap."
    )
    report.say(_coverage_verdict(found))
    report.table(_reliability_rows(found, nets), "Pixels in [%] that intervals of each level cover.")
    report.table(_correlation_rows(found, distance_mm), _CORRELATION_CAPTION, "correlation")
    report.say(_unseen_verdict(found))
    report.table(by_distance, "The 90 % interval by distance to the contact's edge, inside below 0.", "distance")
    report.table(
        [{"network": name} | row for name, rows in by_wave.items() for row in rows],
        "Gratings of stripes half a wavelength wide; errors and deviations are RMS over the spread of the truth about "
        "its mean, so 1 is what an even map would err by. `layer lets through` is how much of a wave on the pad's "
        "surface reaches the magnets, against an even press. Two pitches are "
        f"{2 * USPA44.pitch_mm:g} mm.",
        "gratings",
    )
    report.say(_gratings_verdict(by_wave))
    report.table(_surface_rows(found), "The 90 % interval by surface.", "surfaces")
    _plot(report, found, by_distance, by_wave)
    return report.write()


_CORRELATION_CAPTION: Final = (
    "Correlation of the deviation with what it should follow: within a frame over its pixels, mean over frames (the "
    "error; what of the truth the layer keeps from the magnets; nearness to the contact's edge); and between frames "
    "(mean deviation and RMS error, both as shares of the indentation)."
)


def grating_rows(found: Intervals) -> list[Row]:
    """Return errors and deviations on gratings, by wavelength."""
    wavelength_mm = np.array([float(Path(name).stem.rpartition("-")[2]) for name in found.frozen.surface])
    spread = found.truth.std(axis=(1, 2))
    error = _rms(found.pattern - found.truth) / spread
    deviation = _rms(found.deviation) / spread
    percent = 100 * _rms(found.deviation) / found.frozen.indentation_mm
    covered = 100 * found.covered().mean(axis=(1, 2))
    rows: list[Row] = []
    for wave_mm in sorted(set(wavelength_mm.tolist()), reverse=True):
        mine = (wavelength_mm == wave_mm)[found.frozen.tap]
        tap = found.frozen.tap[mine]
        rows.append(
            {
                "wavelength mm": wave_mm,
                "layer lets through": round(float(let_through(wave_mm)), 3),
                "error": with_interval(error[mine], tap),
                "deviation": with_interval(deviation[mine], tap),
                "deviation % of indentation": with_interval(percent[mine], tap, 1),
                "covered %": with_interval(covered[mine], tap, 1),
            }
        )
    return rows


def correlation(a: NDArray[np.floating], b: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return Pearson's correlation along the last axis; 0 where one of the two does not vary."""
    a = a - a.mean(axis=-1, keepdims=True, dtype=np.float64)
    b = b - b.mean(axis=-1, keepdims=True, dtype=np.float64)
    size = np.sqrt((a * a).sum(axis=-1) * (b * b).sum(axis=-1))
    return np.where(size > 0, (a * b).sum(axis=-1) / np.where(size > 0, size, 1), 0.0)


def _rms(maps: NDArray[np.floating]) -> NDArray[np.floating]:
    return np.sqrt(np.mean(maps**2, axis=(1, 2)))


def _reliability_rows(found: _Found, nets: Mapping[str, tuple[PatternNet, dict[str, Any]]]) -> list[Row]:
    cost = {name: cost_cells(net) for name, (net, _) in nets.items()}
    rows: list[Row] = []
    for (name, tested), seen in found.items():
        levels: Row = {f"{100 * level:g} %": round(_percent(seen, level), 1) for level in LEVELS if level != LEVEL}
        row: Row = {"network": name, "on": tested, "taps": nets[name][0].taps}
        rows.append(row | seen.cells() | levels | cost[name])
    return rows


def _percent(seen: Intervals, level: float = LEVEL) -> float:
    return 100 * float(seen.covered(level).mean())


def _coverage_verdict(found: _Found) -> str:
    low, high = BOUNDS_PERCENT
    covered = {name: _percent(found[name, _TEST]) for name in NAMES}
    missed = [name for name, percent in covered.items() if not low <= percent <= high]
    figures = ", ".join(f"{name} {percent:.1f} %" for name, percent in covered.items())
    verdict = f"not within it: {', '.join(missed)}" if missed else "all within it"
    return f"The 90 % interval covers of the held-out taps' pixels: {figures}; bound {low:g} to {high:g} %: {verdict}."


def _unseen_verdict(found: _Found) -> str:
    wider = {
        name: float(found[name, _GLYPHS].width_percent().mean() / found[name, _TEST].width_percent().mean())
        for name in NAMES
    }
    figures = ", ".join(f"{name} {ratio:.2f}" for name, ratio in wider.items())
    right = [name for name, ratio in wider.items() if ratio > 1]
    verdict = ", ".join(right) if right else "none of them"
    return f"Width on unseen glyphs over that on the test set: {figures}; wider where the shape is new: {verdict}."


def _gratings_verdict(by_wave: Mapping[str, list[Row]]) -> str:
    parts: list[str] = []
    for name, rows in by_wave.items():
        longest, shortest = (_mean(row["deviation"]) for row in (rows[0], rows[-1]))
        share = [_mean(row["deviation % of indentation"]) for row in (rows[0], rows[-1])]
        least = min(_mean(row["covered %"]) for row in rows)
        parts.append(
            f"{name}'s deviation goes from {longest:.2f} to {shortest:.2f} of the truth's spread, which falls itself,"
            f" and from {share[0]:.1f} to {share[1]:.1f} % of the indentation; its 90 % interval covers {least:.0f} %"
            " or more"
        )
    first, last = (next(iter(by_wave.values()))[end]["wavelength mm"] for end in (0, -1))
    return f"From waves of {first:g} mm to waves of {last:g} mm: {'; '.join(parts)}."


def _correlation_rows(found: _Found, distance_mm: Mapping[str, NDArray[np.float64]]) -> list[Row]:
    rows: list[Row] = []
    for (name, tested), seen in found.items():
        count, tap = len(seen.frozen), seen.frozen.tap
        # A pad with contact all over has no edge, so no pixel is nearer to one than another.
        near = -np.nan_to_num(np.abs(distance_mm[tested]), posinf=0.0)[tap]
        back = np.abs(kept_back(seen.frozen.unit_patterns, seen.frozen.scale))[tap]
        followed = {"error": np.abs(seen.truth - seen.pattern), "kept back": back, "nearness to the edge": near}
        deviation = seen.deviation.reshape(count, -1)
        within: Row = {
            f"with {what}": with_interval(correlation(deviation, maps.reshape(count, -1)), tap)
            for what, maps in followed.items()
        }
        share = seen.frozen.indentation_mm
        frames = correlation(seen.deviation.mean(axis=(1, 2)) / share, _rms(seen.truth - seen.pattern) / share)
        rows.append({"network": name, "on": tested, **within, "between frames": round(float(frames), 2)})
    return rows


def _distance_rows(name: str, tested: str, seen: Intervals, distance_mm: NDArray[np.float64]) -> list[Row]:
    per_frame = distance_mm[seen.frozen.tap]
    tap = np.broadcast_to(seen.frozen.tap[:, None, None], per_frame.shape)
    covered, width = seen.covered(), seen.width_percent()
    rows: list[Row] = []
    for low, high in pairwise(EDGES_MM):
        inside = (per_frame > low) & (per_frame <= high) & np.isfinite(per_frame)
        if inside.any():
            rows.append(
                {
                    "network": name,
                    "on": tested,
                    "from mm": low,
                    "to mm": high,
                    "pixels %": round(100 * float(inside.mean()), 1),
                    "covered %": with_interval(100.0 * covered[inside], tap[inside], 1),
                    "width %": round(float(width[inside].mean()), 1),
                }
            )
    return rows


def _surface_rows(found: _Found) -> list[Row]:
    rows: list[Row] = []
    for name in NAMES:
        seen = found[name, _TEST]
        frozen = seen.frozen
        covered, width = (maps.mean(axis=(1, 2)) for maps in (100 * seen.covered(), seen.width_percent()))
        errors_db = psnr_db(seen.pattern, seen.truth, frozen.full_scale_mm)
        for surface in dict.fromkeys(frozen.surface.tolist()):
            mine = (frozen.surface == surface)[frozen.tap]
            rows.append(
                {
                    "network": name,
                    "surface": surface,
                    "PSNR dB": with_interval(errors_db[mine], frozen.tap[mine]),
                    "covered %": with_interval(covered[mine], frozen.tap[mine], 1),
                    "width %": round(float(width[mine].mean()), 1),
                }
            )
    return rows


def _mean(cell: Cell) -> float:
    """Return the mean from a cell that with_interval has written."""
    return float(str(cell).split()[0])


def _plot(report: Report, found: _Found, by_distance: list[Row], by_wave: Mapping[str, list[Row]]) -> None:
    with report.figure(size=(13, 4.2)) as figure:
        levels, distance, waves = figure.subplots(1, 3)
        levels.plot([0, 100], [0, 100], "k:", lw=1)
        for (name, tested), seen in found.items():
            style = {"color": f"C{NAMES.index(name)}", "ls": "-" if tested == _TEST else "--"}
            levels.plot(
                [100 * level for level in LEVELS],
                [_percent(seen, level) for level in LEVELS],
                **style,
                label=f"{name}, {tested}",
            )
            mine = [row for row in by_distance if row["network"] == name and row["on"] == tested]
            place = [f"..{row['to mm']:g}" for row in mine]
            distance.plot(place, [_mean(row["covered %"]) for row in mine], marker=".", **style)
        for number, (name, rows) in enumerate(by_wave.items()):
            wave_mm = [row["wavelength mm"] for row in rows]
            for what, marker in (("deviation", "o-"), ("error", "x:")):
                means = [_mean(row[what]) for row in rows]
                waves.plot(wave_mm, means, marker, color=f"C{number}", label=f"{name}, {what}")
        wave_mm = np.geomspace(min(WAVELENGTHS_MM), max(WAVELENGTHS_MM), 100)
        waves.plot(wave_mm, let_through(wave_mm), "k--", label="layer lets through")
        levels.set(xlabel="level of the interval [%]", ylabel="pixels covered [%]")
        distance.axhspan(*BOUNDS_PERCENT, color="0.9")
        distance.set(xlabel="distance to the contact's edge, up to [mm]", ylabel="covered by the 90 % interval [%]")
        waves.set(xlabel="wavelength of a grating [mm]", ylabel="RMS over the truth's spread", xscale="log")
        waves.set_xticks(WAVELENGTHS_MM, [f"{wave:g}" for wave in WAVELENGTHS_MM])
        waves.minorticks_off()
        for axes in (levels, waves):
            axes.legend(fontsize=7)

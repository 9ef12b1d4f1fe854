"""Dead taxels in the runtime: errors with and without detection, delay of the detection, and false alarms.

Taxels of a free pad fail; then the taps of a frozen frame follow, and its scan goes through `edge.perception.runtime`
with the bundled models, so that the pattern is the one a robot would get. Without detection, faults are a few scans
old, and the taxels' readings are used as they are. On real recordings, which have no truth, a pattern with taxels
hidden is compared with the pattern from all taxels.

Recordings are read from TACTILE_RECORDINGS, or from next to the repository; none of their scans goes into a report.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from edge.evaluation.evaluate import judge
from edge.evaluation.metrics import interval_coverage
from edge.evaluation.test_set import FrozenSet, load_frozen_set
from edge.inference.bundled import BUNDLE_DIR, TAXELS, demo_recording, find_model
from edge.inference.onnx_session import ModelSession
from edge.perception.contact_options import RuntimeOptions
from edge.perception.dead_taxel_fill import WIDENING, TaxelEstimator, load_estimator
from edge.perception.runtime import Runtime
from edge.perception.taxel_health import STUCK_SCANS, TaxelWatch
from edge.terminal.progress_bar import tracked
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.scans.scan import ABSENT, ScanSeries
from firmware_bridge.zeroing.baseline import Baseline
from train.data.generation_config import SEED
from train.data.real_grips import recorded_sets, recording_paths, recordings_folder
from train.experiments.support.workbench import Workbench
from train.physics.sensor_noise import LARGEST_COUNTS
from train.report import Report, Row, with_interval

MODELS: Final = ("stsr", "mtsr4")
MOST_DEAD: Final = 8
FAULTS: Final = ("silent", "saturated", "stuck at rest", "stuck at random")
_REST: Final = np.broadcast_to(np.array([16_000, 16_400, 38_600])[:, None, None], USPA44.scan_shape).astype(np.int32)
_BASELINE: Final = Baseline.of("4", _REST.astype(np.float32), created_unix_s=0.0, scans=100, origin="start-up")
_SCAN_NS: Final = 10_000_000
_TAXELS: Final = USPA44.taxel_count
_FREE_COUNTS: Final = np.array([0, 0, -40])[:, None, None]
"""Free pad between taps, drifted below its zero, so that the lightest frames are contacts and the free pad is not."""
_FRAMES_APART: Final = 4
_SCANS_APART: Final = 12
_MASKS: Final = 8


@dataclass
class Played:
    """Output of the runtime for every frame.

    Attributes:
        patterns: (n, H, W) in [mm].
        half_width_mm: (n, H, W) of 90 % intervals, in [mm].
        delays_scans: scans until every dead taxel was detected, for frames where it was.
        run_time_us: of the frame's scan including inference, in [us].
    """

    patterns: list[NDArray[np.float32]] = field(default_factory=list)
    half_width_mm: list[NDArray[np.float32]] = field(default_factory=list)
    delays_scans: list[int] = field(default_factory=list)
    run_time_us: list[float] = field(default_factory=list)


def run(bench: Workbench, folder: Path) -> Path:
    """Write the report `dead`; the full run takes a few minutes."""
    frozen = load_frozen_set(bench.use(BUNDLE_DIR / "frozen.npz"))
    frozen = frozen.thinned(len(frozen) // 4 if bench.quick else _FRAMES_APART)
    estimator = load_estimator(bench.use(TAXELS), (USPA44.rows, USPA44.cols))
    report = Report("dead", folder, __file__, bench.used, quick=bench.quick)
    report.say(
        f"{len(frozen)} frames of {len(np.unique(frozen.tap))} taps of the frozen test set, one in {_FRAMES_APART}, "
        f"through edge.perception.runtime; seed {SEED}. Which taxels fail is drawn for each tap, those of fewer "
        f"among those of "
        "more; a scan has noise of 1 count over the set's own. `found`: as shipped, the fault has been seen before the "
        "taps. `unfound`: what the taxels send is fed in. A silent or saturated taxel unfound has no row: it is held "
        "for 5 scans, then there was no pattern at all. Eight silent ones are "
        "taken for a wrong id map: no pattern. covered: pixels whose truth the 90 % interval holds; in "
        "brackets without the widening by the number of dead taxels. Run time: of the scan, inference and all, back "
        "to back. Intervals are by tap."
    )
    rows: list[Row] = []
    for name in MODELS:
        model = ModelSession(bench.use(find_model(name)))
        counts = (0, 1, MOST_DEAD) if bench.quick else range(MOST_DEAD + 1)
        for dead in tracked(counts, name, "count"):
            for fault in FAULTS if dead in (1, 4, 8) else ("stuck at random",):
                rows.append(_row(model, frozen, play(model, frozen, estimator, dead, fault), dead, fault, "found"))
            for fault in ("stuck at rest", "stuck at random") if dead else ():
                rows.append(_row(model, frozen, play(model, frozen, None, dead, fault), dead, fault, "unfound"))
    report.table(rows, "Errors by number of dead taxels.")
    recordings = recordings_folder()
    if recording_paths(recordings):
        caption = "Real grips: how far a pattern is from that of all taxels, when some are hidden."
        report.table(_real_rows(recordings, estimator, bench.quick), caption, "real")
    else:
        report.say("No recordings were there, so this is of simulated scans alone.")
    report.table(_alarms(recordings), "False alarms: scans of healthy pads with a taxel called dead.", "alarms")
    with report.figure() as figure:
        _draw(figure, rows)
    return report.write()


def play(model: ModelSession, frozen: FrozenSet, estimator: TaxelEstimator | None, dead: int, fault: str) -> Played:
    """Run every frame, at the end of its taps, through a runtime whose sensor has `dead` taxels.

    Args:
        model: model of the runtime.
        frozen: set whose readings are used.
        estimator: fills in dead taxels; None: the taps come before the fault is detected.
        dead: number of dead taxels.
        fault: one of FAULTS.
    """
    played = Played()
    rank = np.random.default_rng([SEED, 1]).random((len(frozen.surface), _TAXELS)).argsort(axis=1)
    high = np.array(LARGEST_COUNTS)[:, None]
    for frame, tap in enumerate(frozen.tap.tolist()):
        rng = np.random.default_rng([SEED, 2, frame])
        failing = rank[tap] < dead
        stuck = _REST.reshape(3, -1)
        if fault == "stuck at random":
            stuck = stuck + np.random.default_rng([SEED, 3, tap]).uniform(high * [[-1], [-1], [0]], high, (3, _TAXELS))
        # Thresholds are far below the default ones, so that the lightest frames are contacts too.
        runtime = Runtime(
            model,
            source="replay",
            baselines={"4": _BASELINE},
            estimator=estimator,
            options=RuntimeOptions(contact_on_counts=1.0, contact_off_counts=0.5),
        )
        series, known, took_us, result = ScanSeries("4", USPA44), None, 0.0, None
        course = list(_course(frozen, frame, model.contract.taps, STUCK_SCANS + 5 if estimator else 1))
        for number, clean in enumerate(course):
            raw = _REST + clean + np.rint(rng.normal(0, 1, _REST.shape)).astype(np.int32)
            if number:
                _fail(raw.reshape(3, -1), failing, fault, stuck)
            before_ns = time.perf_counter_ns()
            result = runtime.push(series.close(raw, number * _SCAN_NS), infer=number == len(course) - 1)
            took_us = (time.perf_counter_ns() - before_ns) / 1e3
            if known is None and dead and len(result.dead) == dead:
                known = number
        shape = frozen.unit_patterns.shape[1:]
        none = np.zeros(shape, dtype=np.float32)
        factor = model.contract.interval_factor or 0.0
        pattern = None if result is None else result.pattern
        played.patterns.append(none if pattern is None else pattern)
        deviation = None if result is None else result.deviation
        played.half_width_mm.append(none if deviation is None else factor * deviation)
        played.run_time_us.append(took_us)
        played.delays_scans += [known] if known is not None else []
    return played


def _course(frozen: FrozenSet, frame: int, taps: int, free: int) -> Iterator[NDArray[np.integer]]:
    """Yield zeroed scans (3, rows, cols): a free pad, the taps before with a free pad after each, and the frame."""
    yield from [_FREE_COUNTS] * free
    for before in reversed(range(taps - 1)):
        yield from [frozen.earlier[frozen.tap[frame], before].astype(np.int32)] * 2
        yield _FREE_COUNTS
    yield frozen.newest[frame].astype(np.int32)


def _fail(
    raw: NDArray[np.int32], failing: NDArray[np.bool_], fault: str, stuck: NDArray[np.floating | np.integer]
) -> None:
    """Overwrite the failing taxels of raw counts (3, taxels) with the readings of the fault."""
    if fault == "silent":
        raw[:, failing] = ABSENT
    elif fault == "saturated":
        raw[2, failing] = 65535
    else:
        raw[:, failing] = stuck[:, failing]


def _row(model: ModelSession, frozen: FrozenSet, played: Played, dead: int, fault: str, state: str) -> Row:
    patterns, widths_mm = np.stack(played.patterns), np.stack(played.half_width_mm)
    row: Row = {"model": model.name, "dead": dead, "fault": fault if dead else "none", "taxels": state}
    if not patterns.any():
        return row | {"no pattern": len(patterns), "found after scans": max(played.delays_scans, default=None)}
    figures = judge(patterns, frozen, model.contract.contact_level, widths_mm)
    narrow = interval_coverage(patterns, frozen.patterns(), widths_mm / (WIDENING[dead] if state == "found" else 1))
    return row | {
        "PSNR dB": with_interval(figures["psnr_db"], frozen.tap),
        "worst tenth dB": round(float(np.quantile(figures["psnr_db"], 0.1)), 1),
        "RMSE %": round(float(figures["rmse_percent"].mean()), 2),
        "IoU": round(float(figures["contact_iou"].mean()), 3),
        "covered %": f"{100 * figures['coverage_90'].mean():.1f} ({100 * narrow.mean():.1f})",
        "no pattern": sum(not pattern.any() for pattern in played.patterns),
        "found after scans": max(played.delays_scans, default=None),
        "run time us p50": round(float(np.median(played.run_time_us)), 0),
    }


def _real_rows(folder: Path, estimator: TaxelEstimator, quick: bool) -> list[Row]:
    """Return the change of single scans' patterns when taxels are hidden, left at rest or filled in as shipped."""
    model = ModelSession(find_model("stsr"))
    sets = recorded_sets(folder)
    scans = np.concatenate([one.counts[:: _SCANS_APART * (20 if quick else 1)] for one in sets])

    def pattern(scan: NDArray[np.float32]) -> NDArray[np.float32]:
        return model.run(model.contract.scale_window(scan[None])).copy()

    whole = np.stack([pattern(scan) for scan in scans])
    level = model.contract.contact_level
    rows: list[Row] = []
    for dead in (1,) if quick else (1, 2, 4, 8):
        rng = np.random.default_rng([SEED, 4, dead])
        masks = [(rng.permutation(_TAXELS) < dead).reshape(USPA44.rows, USPA44.cols) for _ in range(_MASKS)]
        apart: dict[str, list[float]] = {"at rest": [], "as shipped": []}
        alike: dict[str, list[float]] = {"at rest": [], "as shipped": []}
        z_off: dict[str, list[float]] = {"at rest": [], "as shipped": []}
        for mask in masks:
            filler = estimator.filler(mask)
            for scan, true in zip(scans, whole, strict=True):
                shipped = filler(scan).counts
                for how, counts in (("at rest", np.where(mask, np.float32(0), scan)), ("as shipped", shipped)):
                    found = pattern(counts)
                    apart[how].append(float(((found - true) ** 2).mean()))
                    both = [one >= level * one.max() for one in (found, true)]
                    alike[how].append(float((both[0] & both[1]).sum() / (both[0] | both[1]).sum()))
                    z_off[how].append(float(((counts - scan)[2][mask] ** 2).mean()))
        rows += [
            {
                "dead": dead,
                "dead taxels": how,
                "scans": len(scans),
                "masks": len(masks),
                "RMS change um": round(1e3 * float(np.sqrt(np.mean(apart[how]))), 1),
                "of the patterns' RMS %": round(100 * float(np.sqrt(np.mean(apart[how]) / (whole**2).mean())), 1),
                "IoU with it": round(float(np.mean(alike[how])), 3),
                "z off counts": round(float(np.sqrt(np.mean(z_off[how]))), 0),
            }
            for how in apart
        ]
    return rows


def _alarms(recordings: Path) -> list[Row]:
    frozen = load_frozen_set(BUNDLE_DIR / "frozen.npz")
    noise = np.random.default_rng([SEED, 5]).normal(0, 2, (50_000, *USPA44.scan_shape))
    demo = load_recording(demo_recording()).tracks[0].counts
    series: list[tuple[str, NDArray[np.integer], Baseline]] = [
        ("noise of 2 counts", _REST + np.rint(noise), _BASELINE),
        ("frozen test set, frames one after the other", _REST + frozen.newest.astype(np.int32), _BASELINE),
        ("demo", demo, Baseline.from_counts("4", demo[:100], 0.0)),
    ]
    for path in recording_paths(recordings):
        counts = load_recording(path).tracks[0].counts
        name = "real grips, zeroed "
        series.append((name + "in the grip", counts, Baseline.from_counts("4", counts[:100], 0.0)))
        series.append((name + "at the end", counts, Baseline.from_counts("4", counts[-20:], 0.0)))
    rows: dict[str, Row] = {}
    for name, counts, baseline in series:
        row = rows.setdefault(name, {"scans of": name, "scans": 0, "with an alarm": 0})
        row["scans"] = int(row["scans"] or 0) + len(counts)
        row["with an alarm"] = int(row["with an alarm"] or 0) + sum(_alarmed(counts, baseline))
    return list(rows.values())


def _alarmed(counts: Sequence[NDArray[np.integer]] | NDArray[np.integer], baseline: Baseline) -> Iterator[bool]:
    watch, series = TaxelWatch((USPA44.rows, USPA44.cols)), ScanSeries("4", USPA44)
    for number, scan in enumerate(counts):
        watch.push(series.close(scan.astype(np.int32), number * _SCAN_NS), baseline)
        yield bool(watch.reasons)


def _draw(figure: Figure, rows: Sequence[Row]) -> None:
    axes = figure.subplots()
    lines = (
        ("stuck at random", "found", "o-"),
        ("stuck at rest", "unfound", "+:"),
        ("stuck at random", "unfound", "x--"),
    )
    for name in MODELS:
        for fault, state, style in lines:
            mine = [row for row in rows if (row["model"], row["fault"], row["taxels"]) == (name, fault, state)]
            psnr_db = [float(str(row["PSNR dB"]).split()[0]) for row in mine]
            axes.plot([int(row["dead"] or 0) for row in mine], psnr_db, style, label=f"{name}, {fault}, {state}")
    axes.set(xlabel="dead taxels of 16", ylabel="PSNR [dB]")
    axes.legend(fontsize="small")

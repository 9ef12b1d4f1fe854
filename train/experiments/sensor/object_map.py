"""Map of a figure larger than the pad, fused from slides over it: error of its outline, beside a plain average.

The same command with `--models` evaluates another model; a model that takes poses gets those of the slide.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final, cast

import joblib
import numpy as np
from numpy.typing import NDArray

from edge.inference.bundled import DEFAULT_MODEL
from edge.inference.onnx_session import ModelSession
from edge.mapping.object_map import PX_PER_MM, SIZE_MM, MapLayers, ObjectMap
from edge.perception.result import Result
from edge.terminal.progress_bar import tracked
from firmware_bridge.scans.pad_constants import Pad as KnownPad
from train.data.generation_config import one_thread
from train.experiments.support.outline import OutlineError, naive_map, outline_error
from train.experiments.support.pushed import PushedSensor
from train.experiments.support.shipped import load_shipped
from train.experiments.support.workbench import Workbench
from train.physics.pad_draws import INPUTS
from train.physics.slides import FIGURE_MM, LANES_MM, SCAN_HZ, SPEED_MM_S, Slide, scaled, slide
from train.report import Report, Row, with_interval
from train.surfaces.paper_figures import figure
from train.surfaces.random_figures import glyph

WANTED_MM: Final = 0.5
FIGURES: Final = ("C", "F", "P", "S", "T", "U", "glyph:920001", "glyph:920002")
THIN_MM: Final = 4.0
STROKES: Final = {"as scaled, about 10 mm": None, f"thinned to about {THIN_MM:g} mm": THIN_MM}
PADS: Final = {"nominal": 0.0, "drawn": 1.0}
_SEED: Final = 500


@dataclass(frozen=True, slots=True)
class _Case:
    """One slide, pushed through the runtime."""

    stroke: str
    pad: str
    name: str
    layers: MapLayers
    slide: Slide
    row: Row


def run(bench: Workbench, folder: Path) -> Path:
    """Write the report `map`."""
    model = load_shipped(bench.models)
    bench.use(bench.models / f"{DEFAULT_MODEL}.onnx")
    names = FIGURES[:1] if bench.quick else FIGURES
    jobs = [
        (stroke, pad, name, _SEED + number) for pad in PADS for stroke in STROKES for number, name in enumerate(names)
    ]
    lanes_mm = LANES_MM[1:2] if bench.quick else LANES_MM
    pool = joblib.Parallel(n_jobs=-1, return_as="generator")
    slides = cast(Iterator[Slide], pool(joblib.delayed(_slide)(*job, lanes_mm) for job in jobs))
    cases: list[_Case] = []
    for (stroke, pad, name, _), made in tracked(zip(jobs, slides, strict=True), "slides", "slide", total=len(jobs)):
        cases.append(_case(model, stroke, pad, name, made, knows=False))
        if PADS[pad]:
            cases.append(_case(model, stroke, f"{pad}, constants known", name, made, knows=True))
    report = Report("map", folder, __file__, bench.used, quick=bench.quick)
    report.say(
        f"A pad slides over a raised flat figure of {FIGURE_MM:g} mm in {len(lanes_mm)} lanes along x, at "
        f"{SPEED_MM_S:g} mm/s and {SCAN_HZ:g} scans/s, with friction, a depth that rises and falls, and every "
        "nuisance of real sensors. Every scan goes through the runtime with its default options; the pose that the "
        "robot states is off by .2 mm and 1 deg (standard deviation), drawn once for each lane, since such an error "
        "does not average out. The outline is that of the contact layer at .5; its error is the root of the mean "
        "square of the distances from it to the figure's outline and back, where covered, without any alignment. "
        "Compared with the plain mean of all patterns at their poses, cut at half of its top. "
        f"Wanted: {WANTED_MM:g} mm. Means with the 95 % interval by slide; times are of one thread, in [ms] a scan."
    )
    report.show(_summary(cases), f"{model.name}, outline in [mm].")
    report.keep([case.row for case in cases])
    report.show([case.row for case in cases], "Each slide.")
    with report.figure(size=(12, 3.8)) as plot:
        shown = [case for case in cases if case.pad == "nominal"]
        for number, case in enumerate(shown):
            axes = plot.add_subplot(2, -(-len(shown) // 2), number + 1)
            half = SIZE_MM / 2
            axes.imshow(case.layers.contact, extent=(-half, half, half, -half), vmin=0, vmax=1)
            for x, y in _rings(case.slide):
                axes.plot(x, y, color="red", linewidth=0.7)
            axes.set_title(f"{case.name}: {case.row['outline_mm']:.2f} mm", fontsize=8)
            axes.set_axis_off()
    report.say(
        "Contact layer of each slide on the nominal pad, dark not touched and light touched, white not covered, with "
        "the figure's outline in red."
    )
    return report.write()


@one_thread()
def _slide(stroke: str, pad: str, name: str, seed: int, lanes_mm: tuple[float, ...]) -> Slide:
    number = name.partition(":")[2]
    outline = figure(name) if not number else glyph(int(number))
    return slide(scaled(outline, STROKES[stroke]), seed, spread=PADS[pad], lanes_mm=lanes_mm)


def _case(model: ModelSession, stroke: str, pad: str, name: str, made: Slide, *, knows: bool) -> _Case:
    """Return a slide's map and its errors."""
    known = KnownPad(**{one: getattr(made.pad, one) for one in INPUTS}) if knows else None
    results = _pushed(PushedSensor(model, known), made)
    whole, times_ms = ObjectMap(), []
    for number, (result, pose) in enumerate(zip(results, made.poses, strict=True)):
        if number and made.lane[number] != made.lane[number - 1]:
            whole.finish()
        started_s = time.thread_time()
        whole.add(result, pose)
        times_ms.append(1e3 * (time.thread_time() - started_s))
    layers = whole.layers()
    error = outline_error(layers.contact, PX_PER_MM, made.outline)
    plain = outline_error(naive_map([one.pattern for one in results], made.poses, whole.grid), PX_PER_MM, made.outline)
    row = _row(error, plain, times_ms) | {"fused": whole.fused, "doubted": whole.doubted, "light": whole.light}
    return _Case(stroke, pad, name, layers, made, {"pad": pad, "strokes": stroke, "figure": name} | row)


def _pushed(sensor: PushedSensor, made: Slide) -> list[Result]:
    results: list[Result] = []
    for number, (counts, pose) in enumerate(zip(made.counts, made.poses, strict=True)):
        if not number or made.lane[number] != made.lane[number - 1]:
            sensor.free()
        results.append(sensor.push(counts, pose=pose))
    return results


def _row(error: OutlineError, plain: OutlineError, times_ms: list[float]) -> Row:
    return {
        "outline_mm": error.rms_mm,
        "outside_mm": error.outside_mm,
        "mean_outline_mm": plain.rms_mm,
        "covered": error.covered,
        "add_ms": float(np.mean(times_ms)),
        "add_p99_ms": float(np.quantile(times_ms, 0.99)),
    }


def _summary(cases: list[_Case]) -> list[Row]:
    rows: list[Row] = []
    for pad, stroke in dict.fromkeys((case.pad, case.stroke) for case in cases):
        those = [case.row for case in cases if (case.pad, case.stroke) == (pad, stroke)]

        def column(name: str, those: list[Row] = those) -> NDArray[np.float64]:
            return np.array([row[name] for row in those], dtype=float)

        number = np.arange(len(those))
        rows.append(
            {
                "pad": pad,
                "strokes": stroke,
                "slides": len(those),
                "map": with_interval(column("outline_mm"), number),
                "plain mean": with_interval(column("mean_outline_mm"), number),
                "map within .5": f"{(column('outline_mm') <= WANTED_MM).mean():.0%}",
                "outside": with_interval(column("outside_mm"), number),
                "outline covered": f"{column('covered').mean():.0%}",
                "ms a scan": f"{column('add_ms').mean():.2f}",
                "99 %": f"{column('add_p99_ms').mean():.2f}",
            }
        )
    return rows


def _rings(made: Slide) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    import shapely

    for ring in shapely.get_parts(made.outline.boundary):
        x, y = shapely.get_coordinates(ring).T
        yield x, y

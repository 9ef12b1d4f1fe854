"""Drift of a free pad in the runtime: the remaining error at rest, and the share of a hold that is removed.

Scans of 100 Hz are played as fast as they are computed, through `edge.perception.runtime` with a bundled model: an
hour's hold takes less than half a minute. It is compared with a fixed baseline, and with a high-pass of 0.01 Hz, which
users of such sensors apply to their readings. On real recordings the true drift is the drift that is added to them.

Recordings are read from TACTILE_RECORDINGS, or from next to the repository; none of their scans goes into a report.
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from edge.evaluation.test_set import load_frozen_set
from edge.inference.bundled import BUNDLE_DIR, find_model
from edge.inference.onnx_session import ModelSession
from edge.perception.contact_options import OFF_COUNTS, ON_COUNTS, RuntimeOptions
from edge.perception.runtime import Runtime
from edge.terminal.progress_bar import tracked
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.scans.scan import ScanSeries
from firmware_bridge.zeroing.baseline import Baseline
from train.data.generation_config import SEED
from train.data.real_grips import REST_SCANS, recording_paths, recordings_folder
from train.experiments.support.workbench import Workbench
from train.report import Report, Row

MODEL: Final = "stsr-small-int8"
RATE_HZ: Final = 100
HIGH_PASS_HZ: Final = 0.01
WARMING_COUNTS: Final = 120.0
"""Drift of z over 3.5 K, in the first minutes after power-up, in [counts]."""
WARMING_S: Final = 120.0
FAST_COUNTS_PER_S: Final = 1000 / 60
EARTH_COUNTS: Final = 36.0
_NOISE_COUNTS: Final = (2.0, 2.0, 3.0)
_AXES: Final = np.array([1 / 8, 1 / 8, 1.0])[:, None, None]
_REST: Final = np.broadcast_to(np.array([16_000, 16_400, 38_600])[:, None, None], USPA44.scan_shape)
_BASELINE: Final = Baseline.of("4", _REST.astype(np.float32), 0.0, 100, "start-up")
_LEAD_S: Final = 10.0
"""Rest before each scene, in [s]."""
_CHUNK: Final = 5000
_QUICK: Final = 20
_COST_SCANS: Final = 20_000

Counts = NDArray[np.floating]


@dataclass(frozen=True, slots=True)
class Scene:
    """Loads and drifts on a pad over time.

    Attributes:
        name: name of the row.
        seconds: duration after the lead, in [s].
        drift: function from times (n,) in [s] to the drift of the rest level, (n, 3, rows, cols) in counts.
        press: function from the same times to the counts that a contact adds.
        noise: function from a generator and n to the noise of a free, cold pad's readings.
    """

    name: str
    seconds: float
    drift: Callable[[NDArray[np.floating]], Counts]
    press: Callable[[NDArray[np.floating]], Counts]
    noise: Callable[[np.random.Generator, int], Counts]


@dataclass
class Tally:
    """Result of a scene with one method.

    Attributes:
        square: sum of squared errors of rest readings.
        free: scans without contact.
        false: scans among these that the method reports as contact.
        worst_counts: largest error of summed z among the free scans.
        eaten_counts: increase of the summed z correction during presses.
        press_counts: summed z of the presses when they ended.
        steps: number of events.
        run_s: run time of the runtime; 0 for the other methods.
        scans: number of all scans.
        trace: error of mean z at rest, one value a second.
    """

    square: float = 0.0
    free: int = 0
    false: int = 0
    worst_counts: float = 0.0
    eaten_counts: float = 0.0
    press_counts: float = 0.0
    steps: int = 0
    run_s: float = 0.0
    scans: int = 0

    def __post_init__(self) -> None:
        self.trace: list[float] = []
        self._last = (0.0, 0.0)
        """Summed z of the last scan's press and of its correction."""

    def add(self, drift: Counts, press: Counts, correction: Counts, contact: NDArray[np.bool_]) -> None:
        """Add scans (n, 3, rows, cols) to the tally, with the method's correction and contact state (n,)."""
        self.scans += len(drift)
        touched = press.any(axis=(1, 2, 3))
        error = drift - correction
        free = error[~touched]
        self.square += float((free**2).sum())
        self.free += len(free)
        self.false += int((contact & ~touched).sum())
        if len(free):
            self.worst_counts = max(self.worst_counts, float(np.abs(free[:, 2].sum(axis=(1, 2))).max()))
        pressed, moved = (
            np.append(before, counts[:, 2].sum(axis=(1, 2)))
            for before, counts in zip(self._last, (press, correction), strict=True)
        )
        held = (pressed[1:] > 0) & (pressed[:-1] > 0)
        self.eaten_counts += float((moved[1:] - moved[:-1])[held].sum())
        self.press_counts += float(pressed[:-1][(pressed[:-1] > 0) & (pressed[1:] <= 0)].sum())
        self._last = float(pressed[-1]), float(moved[-1])
        self.trace += np.where(touched, np.nan, error[:, 2].mean(axis=(1, 2)))[::RATE_HZ].tolist()

    def row(self, scene: str, method: str) -> Row:
        """Return a row of the table."""
        pressed = self.press_counts + max(self._last[0], 0.0)
        eaten = round(100 * self.eaten_counts / pressed, 1) if pressed else None
        rms = math.sqrt(self.square / (48 * self.free)) if self.free else None
        return {
            "scene": scene,
            "method": method,
            "minutes": round(self.scans / RATE_HZ / 60, 1),
            "rest error RMS counts": None if rms is None else round(rms, 1),
            "largest sum of z counts": round(self.worst_counts),
            "false contact % of free scans": round(100 * self.false / self.free, 1) if self.free else None,
            "press eaten %": eaten,
            "events": self.steps if self.run_s else None,
            "run time us a scan": round(1e6 * self.run_s / self.scans, 1) if self.run_s else None,
        }


def run(bench: Workbench, folder: Path) -> Path:
    """Write the report `zeroing`."""
    report = Report("zeroing", folder, __file__, bench.used, quick=bench.quick)
    model = ModelSession(bench.use(find_model(MODEL)))
    rows: list[Row] = []
    traces: dict[str, dict[str, list[float]]] = {}
    found = recording_paths(recordings_folder())
    played = [*scenes(), *(recorded_scenes(found) if found else [])]
    for scene in tracked(played, "scenes", "scene"):
        seconds = scene.seconds / (_QUICK if bench.quick else 1)
        tallies = play(scene, seconds, model)
        rows += [tally.row(scene.name, method) for method, tally in tallies.items()]
        traces[scene.name] = {method: tally.trace for method, tally in tallies.items()}
    report.say(
        f"Seed {SEED}. `followed`: as shipped; `fixed`: the baseline as it was taken; `high-pass`: the mean of "
        f"the last {1 / (2 * math.pi * HIGH_PASS_HZ):.0f} s. Errors are of the rest level, without noise, in scans in "
        "which nothing touches; a tap begins at a summed z of "
        f"{ON_COUNTS:g} counts. Eaten: what the correction took of presses while they lasted. "
        f"Warming up: {WARMING_COUNTS:g} counts of z, time constant {WARMING_S:g} s, x and y an eighth, taxels apart "
        "by a quarter. Run time: of a scan through the runtime, inference and all, back to back."
    )
    if not found:
        report.say("No recordings were there, so this is of simulated pads alone.")
    report.table(rows, "Error and cost, by scene.")
    report.table(_cost(model, bench.quick), "What following costs a scan of a free pad, warm, back to back.", "cost")
    with report.figure(size=(9, 7)) as figure:
        _draw(figure, traces)
    return report.write()


def scenes() -> list[Scene]:
    """Return the scenes of simulated pads."""
    rng = np.random.default_rng([SEED, 41])
    taxels = _AXES * np.clip(rng.normal(1, 0.25, USPA44.scan_shape), 0.5, 1.5)
    frames = load_frozen_set(BUNDLE_DIR / "frozen.npz").newest.astype(np.float64)
    sums = frames[:, 2].sum(axis=(1, 2))
    grasp = frames[np.argsort(sums)[len(sums) // 2]]
    grasp = grasp / grasp[2].sum()

    def still(t: Counts) -> Counts:
        return np.zeros((len(t), *USPA44.scan_shape))

    def warm(t: Counts) -> Counts:
        return _times(WARMING_COUNTS * (1 - np.exp(-np.maximum(t, 0) / WARMING_S)), taxels)

    def fast(t: Counts) -> Counts:
        return _times(FAST_COUNTS_PER_S * np.clip(t, 0, 60), taxels)

    def turn(t: Counts) -> Counts:
        return _times(EARTH_COUNTS * (t % 30 > 15), np.ones(USPA44.scan_shape))

    def taps(t: Counts) -> Counts:
        return _times(4000.0 * ((t > 0) & (t % 8 > 6)), grasp)

    def hold(counts: float) -> Callable[[Counts], Counts]:
        # With a creep of 1 % a decade of time, typical of pads.
        return lambda t: _times(counts * (t > 0) * (1 + 0.01 * np.log10(1 + np.maximum(t, 0))), grasp)

    def slow(t: Counts) -> Counts:
        return _times(10.0 * np.clip(t, 0, 140), grasp)

    minute = 60.0
    return [
        Scene("at rest", 10 * minute, still, still, _noise),
        Scene("warming up", 10 * minute, warm, still, _noise),
        Scene("1000 counts in a minute", 2 * minute, fast, still, _noise),
        Scene("turned over in the earth's field", 5 * minute, turn, still, _noise),
        Scene("warming up, a tap every 8 s", 10 * minute, warm, taps, _noise),
        Scene("an hour's hold, warming up", 60 * minute, warm, hold(4000.0), _noise),
        Scene("an hour's touch of 1000 counts, no tap", 60 * minute, still, hold(1000.0), _noise),
        Scene("a press that grows by 10 counts a second", 2.5 * minute, still, slow, _noise),
    ]


def recorded_scenes(paths: Sequence[Path]) -> list[Scene]:
    """Return the scenes of real recordings: a rest with warming, and grips that last.

    Rows of the recorded noise are resampled to get enough of them: their distribution is kept, their order is not.
    """
    rng = np.random.default_rng([SEED, 42])
    taxels = _AXES * np.clip(rng.normal(1, 0.25, USPA44.scan_shape), 0.5, 1.5)
    grips, noises = [], []
    for path in paths:
        counts = load_recording(path).tracks[0].counts.astype(np.float64)
        rest = np.median(counts[-REST_SCANS:], axis=0)
        noises.append(counts[-REST_SCANS:] - rest)
        grips.append(counts[: len(counts) // 2] - rest)
    # The last rows are a free pad's only where the grip was released at the end.
    let_go = [index for index, grip in enumerate(grips) if grip[:, 2].sum(axis=(1, 2)).mean() > ON_COUNTS]
    noise = np.concatenate([noises[index] for index in let_go] or noises)
    grip = np.concatenate([grips[index] for index in let_go] or grips)

    def real_noise(rng: np.random.Generator, n: int) -> Counts:
        return noise[rng.integers(len(noise), size=n)] + rng.uniform(-0.5, 0.5, (n, *USPA44.scan_shape))

    def warm(t: Counts) -> Counts:
        return _times(WARMING_COUNTS * (1 - np.exp(-np.maximum(t, 0) / WARMING_S)), taxels)

    def held(t: Counts) -> Counts:
        there_and_back = np.abs((np.maximum(t, 0) * 60).astype(int) % (2 * len(grip) - 2) - (len(grip) - 1))
        return grip[there_and_back] * (t > 0)[:, None, None, None]

    def still(t: Counts) -> Counts:
        return np.zeros((len(t), *USPA44.scan_shape))

    return [
        Scene("real pad at rest, warmed up", 600.0, warm, still, real_noise),
        Scene("real grips, ten minutes", 600.0, still, held, real_noise),
    ]


def play(scene: Scene, seconds: float, model: ModelSession) -> dict[str, Tally]:
    """Play a scene to every method."""
    runtime = Runtime(model, source="emulated", baselines={"4": _BASELINE}, unix_time_s=lambda: 0.0)
    series, rng = ScanSeries("4", USPA44), np.random.default_rng([SEED, 43])
    tallies = {name: Tally() for name in ("followed", "fixed", "high-pass")}
    mean = np.zeros(USPA44.scan_shape)
    touching = dict.fromkeys(tallies, False)
    scans = int((seconds + _LEAD_S) * RATE_HZ)
    for first in range(0, scans, _CHUNK):
        number = np.arange(first, min(first + _CHUNK, scans))
        t = number / RATE_HZ - _LEAD_S
        drift, press = scene.drift(t), scene.press(t)
        if not len(press):
            continue
        off = np.rint(drift + press + scene.noise(rng, len(t)))
        counts = (_REST + off).astype(np.int32)
        batch = [series.close(one, int(n * 1e9 / RATE_HZ), whole=True) for n, one in zip(number, counts, strict=True)]
        start_s = time.perf_counter()
        results = [runtime.push(scan) for scan in batch]
        tallies["followed"].run_s += time.perf_counter() - start_s
        moved: list[Counts] = []
        for index, result in enumerate(results):
            tallies["followed"].steps += len(result.events)
            if index and result.baseline is results[index - 1].baseline:
                moved.append(moved[-1])
            else:
                moved.append((result.baseline or _BASELINE).counts - _BASELINE.counts)
        contact = np.array([bool(result.contact) for result in results])
        tallies["followed"].add(drift, press, np.stack(moved), contact)
        passed, mean = _means(off, mean)
        for name, correction in (("fixed", np.zeros_like(off)), ("high-pass", passed)):
            z_counts = (off - correction)[:, 2].sum(axis=(1, 2))
            contact, touching[name] = _contacts(z_counts, touching[name])
            tallies[name].add(drift, press, correction, contact)
    return tallies


def _times(course: Counts, shape: Counts) -> Counts:
    return course[:, None, None, None] * shape


def _noise(rng: np.random.Generator, n: int) -> Counts:
    return rng.standard_normal((n, *USPA44.scan_shape)) * np.array(_NOISE_COUNTS)[:, None, None]


def _means(off: Counts, mean: Counts) -> tuple[Counts, Counts]:
    share = 2 * math.pi * HIGH_PASS_HZ / RATE_HZ
    means = np.empty_like(off)
    for index, one in enumerate(off):
        mean = mean + share * (one - mean)
        means[index] = mean
    return means, mean


def _contacts(z_counts: Counts, contact: bool) -> tuple[NDArray[np.bool_], bool]:
    found = np.empty(len(z_counts), dtype=bool)
    for index, counts in enumerate(z_counts.tolist()):
        contact = counts >= (OFF_COUNTS if contact else ON_COUNTS)
        found[index] = contact
    return found, contact


def _cost(model: ModelSession, quick: bool) -> list[Row]:
    rng = np.random.default_rng([SEED, 44])
    count = _COST_SCANS // (_QUICK if quick else 1)
    counts = (_REST + np.rint(_noise(rng, count))).astype(np.int32)
    series = ScanSeries("4", USPA44)
    scans = [series.close(one, int(n * 1e9 / RATE_HZ), whole=True) for n, one in enumerate(counts)]
    took_us: dict[str, list[float]] = {"fixed": [], "followed": []}
    runtimes = {
        name: Runtime(
            model,
            source="emulated",
            baselines={"4": _BASELINE},
            options=RuntimeOptions(follow_drift=name == "followed"),
        )
        for name in took_us
    }
    for first in range(0, count, 500):  # alternating, so that load on the machine slows both
        part = scans[first : first + 500]
        for name, runtime in runtimes.items():
            start_s = time.perf_counter()
            for scan in part:
                runtime.push(scan)
            took_us[name].append(1e6 * (time.perf_counter() - start_s) / len(part))
    return [
        {"baseline": name, "us a scan, least": round(min(us), 2), "us a scan, median": round(float(np.median(us)), 2)}
        for name, us in took_us.items()
    ]


def _draw(figure: Figure, traces: dict[str, dict[str, list[float]]]) -> None:
    names = list(traces)
    columns = 3
    grid = figure.subplots(math.ceil(len(names) / columns), columns, squeeze=False)
    for axes, name in zip(grid.flat, names, strict=False):
        for method, trace in traces[name].items():
            axes.plot(np.arange(len(trace)) / 60, trace, label=method, linewidth=1)
        axes.set_title(name, fontsize="small")
        axes.tick_params(labelsize="x-small")
        axes.set_ylim(-60, 150)
    for axes in grid.flat[len(names) :]:
        axes.set_axis_off()
    grid[0][0].legend(fontsize="x-small")
    figure.supxlabel("minutes")
    figure.supylabel("error of the rest level, mean z [counts]; gaps: touched")

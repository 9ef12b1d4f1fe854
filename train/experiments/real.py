"""Real recordings, of which nobody knows the true pattern: hide a taxel, and see who tells what it reads.

A scan with one taxel dead is super-resolved; the pattern, weighed back into that taxel as the paper's degradation does,
is compared with what the taxel did read. So are its neighbours' mean, which is what bilinear interpolation gives in
its place, and least squares from the other fifteen. The same is done with simulated scans: there the sensor is the one
the networks know, and the true pattern can be weighed back too, which is as well as the method can do.

Recordings are read where TACTILE_RECORDINGS says, else beside the repository; no scan of theirs goes into a report.

Source: Wu and Liu 2024, Eq. 7-8 (degradation).
"""

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.baseline import LOAD_LIMIT_COUNTS
from firmware_bridge.geometry import USPA44
from train.batches import Draw, WindowBatches
from train.dataset import Sequences
from train.experiments.hidden_taxel import (
    BILINEAR,
    OTHERS,
    SIMULATED,
    ScanSet,
    Told,
    fit_gamma,
    hidden_taxels,
    recorded_sets,
    recording_paths,
    recordings_folder,
    simulated_sets,
    z_of,
)
from train.experiments.report import Report, Row, bootstrap_interval
from train.experiments.trainings import compact, mixed, trained
from train.experiments.workbench import Workbench, cost_cells
from train.freeze import SCALE, SEED
from train.nuisances import Nuisances

NETWORKS: Final = ("stsr",)
"""Single scans are asked about, so the network of one tap."""
_FITTED_ON: Final = 4000
_QUICK_FITTED_ON: Final = 100
_TAXELS: Final = USPA44.taxel_count
_TIMED_RUNS: Final = 30


def run(bench: Workbench, folder: Path) -> Path:
    """Write the report `real`.

    Raises:
        DatasetError: there are no recordings, without which only a quick run does, or one cannot be read.
    """
    recorded = _recorded(bench.quick)
    data = mixed(bench)
    validation = bench.frozen("validation")
    nets = {name: trained(bench, compact(name), data, validation)[0] for name in NETWORKS}
    readings, patterns = _simulated(data, _QUICK_FITTED_ON if bench.quick else _FITTED_ON)
    gamma, unexplained = fit_gamma(patterns, z_of(readings))
    simulated = simulated_sets(bench.frozen("test"))

    report = Report("real", folder, quick=bench.quick)
    report.say(
        f"Each of the {_TAXELS} taxels is hidden in turn: it reads 0 on all axes, as dead ones do in training. Errors "
        "are of z, over scans in which some taxel reads more than "
        f"{LOAD_LIMIT_COUNTS:g} counts; x and y are not degraded to, as patterns are of z. What a method says is "
        "brought to counts by one gain for z, fitted on the fifteen other taxels of the same set of scans; the linear "
        f"methods give counts. gamma = {gamma:.2f} mm^0.5 fits true patterns of simulated taps to their z best and "
        f"leaves {100 * unexplained:.1f} % of z's energy unexplained. Linear methods: z from the other fifteen z by "
        "least squares, fitted on simulated taps, or on the other trials (all sensors). Intervals are by trial and "
        "sensor."
    )
    rows: list[Row] = []
    tables: dict[str, Mapping[str, NDArray[np.float64]]] = {}
    for source, sets in (("recordings", recorded), ("simulated", simulated)):
        if not sets:
            report.say("No recordings were there, so this is of simulated scans alone.")
            continue
        told = hidden_taxels(sets, nets, gamma, readings)
        cost = {name: cost_cells(net) for name, net in nets.items()} | _classical_cost(readings)
        rows += [
            {"scans": source, "method": name} | _cells(sets, say) | cost.get(name, {}) for name, say in told.items()
        ]
        tables[source] = {name: _percent_by_taxel(sets, say) for name, say in told.items()}
        report.say(_verdict(source, sets, told))
    report.table(rows, "Error of a hidden taxel's z. Range: between the least and the most that the taxel read.")
    for source, by_taxel in tables.items():
        report.table(_taxel_rows(by_taxel), f"RMS error by taxel and z in % of its range, {source}.", source)
    _plot(report, tables)
    return report.write()


def _recorded(quick: bool) -> list[ScanSet]:
    """Real scans; a quick run may find none."""
    folder = recordings_folder()
    if quick and not recording_paths(folder):
        return []
    return recorded_sets(folder)


def _simulated(data: Sequences, count: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Readings (n, 3, rows, cols) of simulated taps in zeroed counts, and their patterns (n, H, W) in [mm]."""
    draw = Draw(nuisances=Nuisances())  # without dead taxels: a method has to learn what a taxel that lives reads
    some = data.newest(1).pick(np.linspace(0, len(data) - 1, min(count, len(data))).astype(int))
    batches = WindowBatches(some.at_scale(SCALE), draw, (1.0,), batch=100, seed=SEED)
    parts = []
    while sum(len(part[0]) for part in parts) < count:
        parts.append(batches.draw(len(parts)))
    return np.concatenate([windows[:, 0] for windows, _ in parts]), np.concatenate([maps for _, maps in parts])


def _ranges(sets: Sequence[ScanSet]) -> dict[str, NDArray[np.floating]]:
    """Of every sensor's taxels, (taxels,) in counts, over all of its trials."""
    sensors = {scans.sensor for scans in sets}
    all_z = {name: np.concatenate([scans.z for scans in sets if scans.sensor == name]) for name in sensors}
    return {name: np.maximum(np.ptp(z, axis=0), 1.0) for name, z in all_z.items()}


def _errors(sets: Sequence[ScanSet], said: Sequence[NDArray[np.floating]]) -> list[NDArray[np.floating]]:
    return [word - scans.z for scans, word in zip(sets, said, strict=True)]


def _cells(sets: Sequence[ScanSet], said: Sequence[NDArray[np.floating]]) -> Row:
    errors, ranges = _errors(sets, said), _ranges(sets)
    groups = np.repeat(np.arange(len(sets)), [len(part) for part in errors])
    square = np.concatenate([(part**2).mean(axis=1) for part in errors])
    shares = [part / ranges[scans.sensor] for scans, part in zip(sets, errors, strict=True)]
    square_share = np.concatenate([(part**2).mean(axis=1) for part in shares])
    return {
        "RMS error counts": _root_with_interval(square, groups, 0),
        "RMS error % of range": _root_with_interval(1e4 * square_share, groups, 1),
        "correlation": round(_correlation(sets, said, lambda scans: scans.sensor), 2),
        "correlation within a trial": round(_correlation(sets, said, lambda scans: f"{scans.sensor} {scans.trial}"), 2),
    }


def _root_with_interval(squares: NDArray[np.floating], groups: NDArray[np.integer], digits: int) -> str:
    low, high = np.sqrt(bootstrap_interval(squares, groups))
    return f"{float(np.sqrt(squares.mean())):.{digits}f} ({low:.{digits}f}..{high:.{digits}f})"


def _correlation(
    sets: Sequence[ScanSet], said: Sequence[NDArray[np.floating]], group: Callable[[ScanSet], str]
) -> float:
    """Mean over groups and taxels of the correlation over scans, where both vary."""
    found: list[float] = []
    for name in dict.fromkeys(group(scans) for scans in sets):
        mine = [(scans.z, word) for scans, word in zip(sets, said, strict=True) if group(scans) == name]
        truth, words = (np.concatenate(parts).astype(np.float64) for parts in zip(*mine, strict=True))
        for taxel in range(_TAXELS):
            if min(truth[:, taxel].std(), words[:, taxel].std()) > 0:
                found.append(float(np.corrcoef(truth[:, taxel], words[:, taxel])[0, 1]))
    return float(np.mean(found)) if found else 0.0


def _percent_by_taxel(sets: Sequence[ScanSet], said: Sequence[NDArray[np.floating]]) -> NDArray[np.float64]:
    ranges = _ranges(sets)
    shares = [part / ranges[scans.sensor] for scans, part in zip(sets, _errors(sets, said), strict=True)]
    return 100 * np.sqrt((np.concatenate(shares) ** 2).mean(axis=0))


def _taxel_rows(by_taxel: Mapping[str, NDArray[np.float64]]) -> list[Row]:
    return [
        {"row": taxel // USPA44.cols, "column": taxel % USPA44.cols, "axis": "z"}
        | {name: round(float(percent[taxel]), 1) for name, percent in by_taxel.items()}
        for taxel in range(_TAXELS)
    ]


def _verdict(source: str, sets: Sequence[ScanSet], told: Told) -> str:
    rms = {name: float(np.sqrt(np.mean(np.concatenate(_errors(sets, said)) ** 2))) for name, said in told.items()}
    order = sorted(rms, key=lambda name: rms[name])
    network = NETWORKS[0]
    against = ", ".join(f"{rms[network] / rms[name]:.2f} times that of {name}" for name in order if name != network)
    scans = sum(len(part.counts) for part in sets)
    return (
        f"On {source} ({len(sets)} sets, {scans} scans) the least error is that of {order[0]}; the error of "
        f"{network} is {against}."
    )


def _classical_cost(readings: NDArray[np.float32]) -> dict[str, Row]:
    z = z_of(readings[:1])
    weights = np.ones((_TAXELS, _TAXELS), dtype=np.float32)
    cost: Row = {"MMAC": round(_TAXELS * (_TAXELS - 1) / 1e6, 4), "run time ms": _run_time_ms(lambda: z @ weights)}
    linear = {"parameters": _TAXELS * (_TAXELS - 1)} | cost
    return {BILINEAR: {"parameters": 0} | cost, SIMULATED: linear, OTHERS: linear}


def _run_time_ms(call: Callable[[], object]) -> float:
    times_ms: list[float] = []
    for _ in range(_TIMED_RUNS):
        started_s = time.perf_counter()
        call()
        times_ms.append(1e3 * (time.perf_counter() - started_s))
    return round(float(np.median(times_ms)), 4)


def _plot(report: Report, tables: Mapping[str, Mapping[str, NDArray[np.float64]]]) -> None:
    shape = (USPA44.rows, USPA44.cols)
    most = max((len(by_taxel) for by_taxel in tables.values()), default=1)
    with report.figure(size=(2.4 * most, 2.9 * len(tables))) as figure:
        grid = figure.subplots(len(tables), most, squeeze=False)
        for axes in grid.ravel():
            axes.axis("off")
        for line, (source, by_taxel) in zip(grid, tables.items(), strict=True):
            highest = max(float(percent.max()) for percent in by_taxel.values())
            for axes, (name, percent) in zip(line, by_taxel.items(), strict=False):
                axes.imshow(percent.reshape(shape), vmin=0, vmax=highest)
                axes.set_title(f"{source}\n{name}", fontsize=8)
                for taxel, value in enumerate(percent):
                    place = (taxel % USPA44.cols, taxel // USPA44.cols)
                    axes.annotate(f"{value:.0f}", place, ha="center", va="center", color="w", fontsize=8)

"""Speed in HR patterns a second: batched convolutions against one 99 x 99 convolution per scan."""

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from edge.terminal.progress_bar import tracked
from firmware_bridge.pad_geometry import USPA44
from train.experiments.support.workbench import Workbench
from train.physics.tpsf import Kernel, spread, spread_by_fft
from train.report import Report, Row

_SCALE = 10
LEAST_TIMES = 100
_SIDE = 99
"""Side of the direct kernel in [px], as in the authors' code; 79 reaches between any two pixels of 40 x 40."""
_BATCH = 64
"""Batch size, small enough for the intermediate maps to stay in a core's cache."""
_DIRECT = "direct, 99 x 99 per scan"

Route = Callable[[Tensor, Tensor, float, Kernel], Tensor]


def direct(depth: Tensor, beta_mm: Tensor, pixel_mm: float, kernel: Kernel) -> Tensor:
    """Convolve each map with its own 99 x 99 kernel, one after the other; (n, H, W), the maps' unit times [mm^2]."""
    along_mm = (torch.arange(_SIDE) - _SIDE // 2) * pixel_mm
    radius_mm = torch.hypot(along_mm[:, None], along_mm[None, :])
    responses: list[Tensor] = []
    for image, beta in zip(depth, beta_mm, strict=True):
        ratio = radius_mm / beta
        weights = torch.exp(-(ratio**2)) if kernel == "gaussian" else torch.exp(-ratio)
        responses.append(torch.nn.functional.conv2d(image[None, None], weights[None, None], padding=_SIDE // 2)[0, 0])
    return pixel_mm**2 * torch.stack(responses)


def run(bench: Workbench, folder: Path) -> Path:
    """Time the routes on the same maps in one run, alternating, and write the table.

    Args:
        bench: if quick, fewer maps and rounds.
        folder: where the report goes.
    """
    maps, rounds = (8, 2) if bench.quick else (32, 7)
    depth, beta_mm = _contacts(16 * _BATCH)
    report = Report("psf_speed", folder, __file__, bench.used, quick=bench.quick)
    rows = _compare("gaussian", {"two matrix products": spread, "FFT": spread_by_fft}, depth, beta_mm, maps, rounds)
    rows += _compare("exponential", {"FFT": spread_by_fft}, depth, beta_mm, maps, rounds)
    routes = [row for row in rows if row["route"] != _DIRECT]
    least = min(float(str(row["times the direct"])) for row in routes)
    report.say(
        f"Asked for: {LEAST_TIMES} times the patterns a second of the direct route. The slowest of the others makes "
        f"{least:.0f} times as many: {'met' if least >= LEAST_TIMES else 'not met'}."
    )
    report.table(
        rows,
        f"Patterns of 40 x 40 per second on {torch.get_num_threads()} threads, each with its own beta, in batches of "
        f"{_BATCH}; the direct route on {maps} maps. Best of {rounds} rounds, the routes in turns.",
    )
    with report.figure() as figure:
        axes = figure.subplots()
        names = [f"{row['kernel']}\n{row['route']}" for row in rows]
        axes.bar(names, [float(str(row["patterns per second"])) for row in rows])
        axes.set(yscale="log", ylabel="patterns per second")
    return report.write()


def _compare(
    kernel: Kernel, routes: dict[str, Route], depth: Tensor, beta_mm: Tensor, maps: int, rounds: int
) -> list[Row]:
    """Return the rates of the direct route, on the first `maps` alone, and of the others, with their differences."""
    pixel_mm = USPA44.pixel_pitch_mm(_SCALE)
    few, few_mm = depth[:maps], beta_mm[:maps]
    batches = list(zip(depth.split(_BATCH), beta_mm.split(_BATCH), strict=True))

    def through(route: Route) -> Callable[[], object]:
        return lambda: [route(part, beta, pixel_mm, kernel) for part, beta in batches]

    timed: dict[str, Callable[[], object]] = {_DIRECT: lambda: direct(few, few_mm, pixel_mm, kernel)}
    timed |= {name: through(route) for name, route in routes.items()}
    seconds = _best_of(rounds, timed)
    truth = direct(few, few_mm, pixel_mm, kernel)
    slow = maps / seconds[_DIRECT]
    rows: list[Row] = [{"kernel": kernel, "route": _DIRECT, "patterns per second": round(slow)}]
    for name, route in routes.items():
        rate = len(depth) / seconds[name]
        off = (route(few, few_mm, pixel_mm, kernel) - truth).abs().max() / truth.max()
        rows.append(
            {
                "kernel": kernel,
                "route": name,
                "patterns per second": round(rate),
                "times the direct": round(rate / slow),
                "largest difference / largest response": float(off),
            }
        )
    return rows


def _contacts(count: int) -> tuple[Tensor, Tensor]:
    """Draw random rectangles and a beta for each, of 0.3 to 3 mm."""
    rng = np.random.default_rng(0)
    size = USPA44.rows * _SCALE
    depth = np.zeros((count, size, size), dtype=np.float32)
    for image in depth:
        top, left = rng.integers(0, size // 2, 2)
        height, width = rng.integers(4, size // 2, 2)
        image[top : top + height, left : left + width] = 1.0
    return torch.from_numpy(depth), torch.as_tensor(rng.uniform(0.3, 3.0, count), dtype=torch.float32)


def _best_of(rounds: int, timed: dict[str, Callable[[], object]]) -> dict[str, float]:
    """Return the shortest time of each in [s]; they alternate, so that load on the machine affects all of them."""
    best = dict.fromkeys(timed, float("inf"))
    for _ in tracked(range(rounds), "routes", "round"):
        for name, work in timed.items():
            start = time.perf_counter()
            work()
            best[name] = min(best[name], time.perf_counter() - start)
    return best

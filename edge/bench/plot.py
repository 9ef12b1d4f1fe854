"""Picture of a bench: PSNR against run time, with the Pareto front; needs matplotlib."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from edge.bench.errors import BenchError
from edge.bench.record import FrontRow, front
from firmware_bridge.extras import how_to_install

_LABELS: Final = 34
"""Number of labels, one above the other, that fill the picture's height."""


def draw(rows: Sequence[FrontRow], path: Path, title: str) -> None:
    """Write the picture.

    Raises:
        BenchError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
        from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter
    except ImportError as error:
        raise BenchError(
            f"{path.name} is not written, as matplotlib is not installed: {how_to_install('bench')}"
        ) from error
    figure = Figure(figsize=(12, 6), layout="constrained")
    figure.suptitle(title, fontsize=9)
    sides: dict[str, Callable[[FrontRow], float]] = {
        "paced p50 [us]": lambda row: row.paced_p50_us,
        "back to back p50 [us]": lambda row: row.back_to_back_p50_us,
    }
    for axes, (label, time_us) in zip(figure.subplots(1, 2, sharey=True), sides.items(), strict=True):
        points = [(time_us(row), row.psnr_db) for row in rows]
        best = front([(x, row.rmse_percent) for (x, _), row in zip(points, rows, strict=True)])
        on_front = sorted(point for point, is_best in zip(points, best, strict=True) if is_best)
        axes.step(*zip(*on_front, strict=True), where="post", color="tab:orange", label="Pareto front", zorder=1)
        colours = ["tab:orange" if is_best else "tab:blue" for is_best in best]
        axes.scatter(*zip(*points, strict=True), c=colours, zorder=2)
        # Names stand in a column at the right, in the order of their points, so that they do not cover each other.
        order = sorted(range(len(rows)), key=lambda i: points[i][1])
        low, high = axes.get_ylim()
        heights = _spread([points[i][1] for i in order], gap=(high - low) / _LABELS)
        axes.set_ylim(low, max(high, heights[-1]))
        for i, height in zip(order, heights, strict=True):
            row = rows[i]
            axes.annotate(
                f"{row.name} ({row.given}) {row.psnr_db:.2f}",
                xy=points[i],
                xytext=(1.03, height),
                textcoords=("axes fraction", "data"),
                fontsize=7,
                va="center",
                color=colours[i],
                arrowprops={"arrowstyle": "-", "linewidth": 0.4, "color": "0.6", "relpos": (0, 0.5)},
                annotation_clip=False,
            )
        axes.set(xscale="log", xlabel=label)
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.grid(visible=True, alpha=0.3)
        axes.legend(loc="center left", fontsize=8)
    figure.axes[0].set_ylabel("PSNR [dB]")
    figure.savefig(path, dpi=130)


def _spread(values: Sequence[float], gap: float) -> list[float]:
    """Move rising values apart until `gap` lies between neighbours, about the middle of each crowd."""
    crowds: list[list[float]] = []
    for value in values:
        crowds.append([value])
        while len(crowds) > 1 and _top(crowds[-2], gap) + gap > _bottom(crowds[-1], gap):
            crowds[-2:] = [crowds[-2] + crowds[-1]]
    return [_bottom(crowd, gap) + gap * place for crowd in crowds for place in range(len(crowd))]


def _bottom(crowd: Sequence[float], gap: float) -> float:
    return sum(crowd) / len(crowd) - gap * (len(crowd) - 1) / 2


def _top(crowd: Sequence[float], gap: float) -> float:
    return sum(crowd) / len(crowd) + gap * (len(crowd) - 1) / 2

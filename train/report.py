"""Report of an experiment: tables as CSV and Markdown, a plot as PNG, and the command and machine that made them."""

import csv
import shlex
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from edge.bench.provenance import provenance
from train.data.presses import SEED

Cell = str | int | float | None
Row = dict[str, Cell]


class Report:
    """Collector of an experiment's results, written as NAME.md, NAME.csv and, where it has a plot, NAME.png.

    The head of the page names the experiment's source, and the models and frozen sets that it has used by then. A quick
    run was cut short for a test: said at the top of the page.
    """

    def __init__(
        self, name: str, folder: Path, source: str, models: Iterable[Path] = (), *, quick: bool = False
    ) -> None:
        self._path = folder / name
        self._source = source
        self._models = models
        self._quick = quick
        self._parts: list[str] = []
        folder.mkdir(parents=True, exist_ok=True)

    def say(self, text: str) -> None:
        """Add a paragraph to the page."""
        self._parts.append(text)

    def table(self, rows: Sequence[Row], caption: str, part: str = "") -> None:
        """Add a table to the page, and write it as NAME.csv or NAME-PART.csv."""
        self.show(rows, caption)
        with self._file(".csv", part).open("w", newline="") as file:
            writer = csv.DictWriter(file, _columns(rows), lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)

    def show(self, rows: Sequence[Row], caption: str) -> None:
        """Add a table to the page."""
        columns = _columns(rows)
        lines = [" | ".join(columns), " | ".join("---" for _ in columns)]
        lines += [" | ".join(_shown(row.get(column)) for column in columns) for row in rows]
        self._parts.append("\n".join([caption, "", *(f"| {line} |" for line in lines)]))

    @contextmanager
    def figure(self, size: tuple[float, float] = (8, 5)) -> Iterator[Figure]:
        """Add a plot to the page, saved as NAME.png."""
        figure = Figure(figsize=size, layout="constrained")
        FigureCanvasAgg(figure)
        yield figure
        path = self._file(".png")
        figure.savefig(path, dpi=110, metadata={"Software": None})
        self._parts.append(f"![{path.stem}]({path.name})")

    def write(self) -> Path:
        """Write the page, and say where it lies."""
        head = [f"# {self._path.name}", str(provenance(_command(), [self._source], self._models, SEED))]
        if self._quick:
            head.append("**A quick run, for the tests: no figure here means anything.**")
        page = self._file(".md")
        page.write_text("\n\n".join(head + self._parts) + "\n")
        return page

    def _file(self, suffix: str, part: str = "") -> Path:
        return self._path.with_name(self._path.name + (f"-{part}" if part else "") + suffix)


def bootstrap_interval(values: NDArray[np.floating], taps: NDArray[np.integer], seed: int = 0) -> tuple[float, float]:
    """Return the 95 % interval of the mean of (n,) values, resampled by tap: frames of one tap are not independent."""
    order, start = np.unique(taps, return_inverse=True)
    sums = np.bincount(start, weights=values, minlength=len(order))
    counts = np.bincount(start, minlength=len(order))
    drawn = np.random.default_rng(seed).integers(len(order), size=(2000, len(order)))
    means = sums[drawn].sum(axis=1) / counts[drawn].sum(axis=1)
    low, high = np.quantile(means, [0.025, 0.975])
    return float(low), float(high)


def with_interval(values: NDArray[np.floating], taps: NDArray[np.integer], digits: int = 2, sign: str = "") -> str:
    """Format the mean of (n,) values with its interval, as tables show it: 35.92 (35.5..36.3); `sign` "+" shows it."""
    low, high = bootstrap_interval(values, taps)
    form = f"{sign}.{digits}f"
    return f"{float(np.mean(values)):{form}} ({low:{form}}..{high:{form}})"


def _columns(rows: Sequence[Row]) -> list[str]:
    return list(dict.fromkeys(column for row in rows for column in row))


def _shown(cell: Cell) -> str:
    if cell is None:
        return "-"
    return f"{cell:.4g}" if isinstance(cell, float) else str(cell)


def _command() -> str:
    """Return the command line of this process."""
    spec = sys.modules["__main__"].__spec__
    module = ["-m", spec.name.removesuffix(".__main__")] if spec else []
    return shlex.join(["python", *module, *sys.argv[1:]])

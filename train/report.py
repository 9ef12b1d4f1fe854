"""Report of an experiment: a page of paragraphs and tables, with the command and machine that made them."""

import shlex
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edge.bench.provenance import provenance
from train.data.presses import SEED

Cell = str | int | float | None
Row = dict[str, Cell]


class Report:
    """Collector of an experiment's results, written as NAME.md and, where it has pictures, NAME.png.

    The head of the page names the experiment's source, and the models and frozen sets that it has used by then.
    """

    def __init__(self, name: str, folder: Path, source: str, models: Iterable[Path] = ()) -> None:
        self._path = folder / f"{name}.md"
        self._source = source
        self._models = models
        self._parts: list[str] = []
        folder.mkdir(parents=True, exist_ok=True)

    def say(self, text: str) -> None:
        """Add a paragraph to the page."""
        self._parts.append(text)

    def table(self, rows: Sequence[Row], caption: str) -> None:
        """Add a table to the page."""
        self._parts.append(f"{caption}\n\n{markdown(rows)}")

    def pictures(self, patterns: Sequence[tuple[str, NDArray[np.floating]]], rows: int, caption: str) -> None:
        """Add named patterns (H, W) in [mm] to the page, in so many rows."""
        from matplotlib.figure import Figure  # of the development environment alone, where reports are made

        columns = -(-len(patterns) // rows)
        figure = Figure(figsize=(2.2 * columns + 1, 2.5 * rows), layout="constrained")
        grid = figure.subplots(rows, columns, squeeze=False)
        most = max(float(pattern.max()) for _, pattern in patterns)
        for axes, (name, pattern) in zip(grid.flat, patterns, strict=False):
            axes.set_title(name, fontsize=8)
            axes.imshow(pattern, vmin=0, vmax=most)
        for axes in grid.flat:
            axes.axis("off")
        figure.colorbar(grid[0, 0].images[0], ax=grid, label="pattern [mm]")
        path = self._path.with_suffix(".png")
        figure.savefig(path, dpi=100, metadata={"Software": None})
        self._parts.append(f"{caption}\n\n![{path.stem}]({path.name})")

    def write(self) -> Path:
        """Write the page, and return its path."""
        head = [f"# {self._path.stem}", str(provenance(_command(), [self._source], self._models, SEED))]
        self._path.write_text("\n\n".join(head + self._parts) + "\n")
        return self._path


def markdown(rows: Sequence[Row]) -> str:
    """Return rows as a table in Markdown, with the columns of all of them."""
    columns = list(dict.fromkeys(column for row in rows for column in row))
    lines = [columns, ["---"] * len(columns), *([_shown(row.get(column)) for column in columns] for row in rows)]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def bootstrap_interval(values: NDArray[np.floating], taps: NDArray[np.integer]) -> tuple[float, float]:
    """Return the 95 % interval of the mean of (n,) values, resampled by tap: frames of one tap are not independent."""
    order, start = np.unique(taps, return_inverse=True)
    sums = np.bincount(start, weights=values, minlength=len(order))
    counts = np.bincount(start, minlength=len(order))
    drawn = np.random.default_rng(0).integers(len(order), size=(2000, len(order)))
    means = sums[drawn].sum(axis=1) / counts[drawn].sum(axis=1)
    low, high = np.quantile(means, [0.025, 0.975])
    return float(low), float(high)


def with_interval(values: NDArray[np.floating], taps: NDArray[np.integer], digits: int = 2, sign: str = "") -> str:
    """Format the mean of (n,) values with its interval, as tables show it: 35.92 (35.5..36.3); `sign` "+" shows it."""
    low, high = bootstrap_interval(values, taps)
    form = f"{sign}.{digits}f"
    return f"{float(np.mean(values)):{form}} ({low:{form}}..{high:{form}})"


def _shown(cell: Cell) -> str:
    if cell is None:
        return "-"
    return f"{cell:.4g}" if isinstance(cell, float) else str(cell)


def _command() -> str:
    """Return the command line of this process."""
    spec = sys.modules["__main__"].__spec__
    module = ["-m", spec.name.removesuffix(".__main__")] if spec else []
    return shlex.join(["python", *module, *sys.argv[1:]])

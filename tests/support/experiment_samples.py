"""Samples for the experiments' tests: one quick workbench, so that datasets and networks are made once a session."""

from pathlib import Path

import numpy as np
import pytest
from bridge_samples import write_recording

from train.experiments.workbench import Workbench


def quick_bench(tmp_path_factory: pytest.TempPathFactory) -> Workbench:
    folder = tmp_path_factory.getbasetemp() / "quick"
    return Workbench(folder / "data", folder / "checkpoints", quick=True)


REST = np.array([15_900, 16_430, 38_600])[:, None, None] + 11 * np.arange(16).reshape(4, 4)


def save_recordings(folder: Path) -> None:
    """Write two trials of two sensors: one grips all the time, the other lets go; its last rows are the rest level."""
    for trial, released in (("trial-a", False), ("trial-b", True)):
        for sensor in ("sensor1", "sensor2"):
            (folder / trial).mkdir(parents=True, exist_ok=True)
            write_recording(folder / trial / f"xela_{sensor}.csv", REST + grip(released))


def grip(released: bool) -> np.ndarray:
    """Counts above rest, (60, 3, 4, 4): every row another, one in ten sent again."""
    rng = np.random.default_rng(int(released))
    pressed = 900 + rng.integers(-300, 300, (60, 3, 4, 4))
    if released:
        pressed[30:] = 0
    pressed[10:30:10] = pressed[9:29:10]
    return pressed


def tables_of(page: Path) -> list[list[dict[str, str]]]:
    """Return the tables of a report, each as rows by column."""
    tables, columns = [], None
    for line in page.read_text().splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")] if line.startswith("| ") else None
        if cells is None:
            columns = None
        elif columns is None:
            columns = cells
            tables.append([])
        elif set(cells) != {"---"}:
            tables[-1].append(dict(zip(columns, cells, strict=True)))
    return tables

"""Comparison of two benches of one machine: ratios of run times, with intervals.

The intervals cover variation between the blocks of a run. They do not cover variation from run to run, as on a shared
host; the machine's peak, measured in both, gives a hint of that.
"""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from edge.bench.errors import BenchError
from edge.bench.ratios import Ratio, ratio_of
from edge.bench.record import Record, RunTimeRow

_DECIDING = ("cpu", "architecture", "usable_cores", "numpy", "onnxruntime")


@dataclass(frozen=True, slots=True)
class Compared:
    """Ratios of a row that is in both benches: new over old."""

    name: str
    threads: int
    load: bool
    back_to_back: Ratio
    paced: Ratio


@dataclass(frozen=True, slots=True)
class Comparison:
    """Comparison of two benches.

    Attributes:
        rows: rows that are in both.
        only_old: rows that the new one lacks, as texts.
        only_new: rows that the old one lacks, as texts.
        differences: other differences, as texts.
        peak: threads to the ratio of the machine's peaks.
    """

    rows: tuple[Compared, ...]
    only_old: tuple[str, ...]
    only_new: tuple[str, ...]
    differences: tuple[str, ...]
    peak: dict[int, float]


def compared(new: Record, old: dict[str, Any], path: Path) -> Comparison:
    """Compare a bench with an earlier one's JSON.

    Raises:
        BenchError: the JSON is damaged.
    """
    try:
        olds = {_key(row): row for row in old["run_times"]}
        news = {_key(asdict(row)): row for row in new.run_times}
        rows = tuple(_ratios(row, olds[key]) for key, row in news.items() if key in olds)
        peaks = {int(threads): peak for threads, peak in old["peak_gmac_s"].items()}
        return Comparison(
            rows=rows,
            only_old=tuple(row_text(*key) for key in olds if key not in news),
            only_new=tuple(row_text(*key) for key in news if key not in olds),
            differences=tuple(_differences(new, old)),
            peak={threads: peak / peaks[threads] for threads, peak in new.peak_gmac_s.items() if threads in peaks},
        )
    except (AttributeError, LookupError, TypeError, ArithmeticError, ValueError) as error:
        raise BenchError(f"{path} is damaged ({repr(error)[:200]}): run that bench again") from error


def row_text(name: str, threads: int, load: bool) -> str:
    """Return a row in words."""
    return f"{name}, {threads} thread{'s' * (threads > 1)}{', under load' * load}"


def _key(row: dict[str, Any]) -> tuple[str, int, bool]:
    return row["name"], row["threads"], row["load"]


def _ratios(new: RunTimeRow, old: dict[str, Any]) -> Compared:
    return Compared(
        name=new.name,
        threads=new.threads,
        load=new.load,
        back_to_back=ratio_of(new.back_to_back.block_p50_us, old["back_to_back"]["block_p50_us"], paired=False),
        paced=ratio_of(new.paced.times.block_p50_us, old["paced"]["times"]["block_p50_us"], paired=False),
    )


def _differences(new: Record, old: dict[str, Any]) -> Iterator[str]:
    machine = asdict(new.machine)
    for key in _DECIDING:
        if machine[key] != old["machine"][key]:
            yield f"{key} is {machine[key]}, was {old['machine'][key]}"
    for key in ("rate_hz", "ticks"):
        if new.settings[key] != old["settings"][key]:
            yield f"{key} is {new.settings[key]}, was {old['settings'][key]}"
    if not old["complete"]:
        yield "the earlier bench was stopped before its end"

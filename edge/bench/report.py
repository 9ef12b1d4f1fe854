"""Report of a bench: Markdown, section by section, with each line as it is measured."""

from collections.abc import Sequence
from typing import Final

from edge.bench.accuracy import FORCE_RANGE_N, ErrorRow
from edge.bench.compare import Compared, Comparison, row_text
from edge.bench.ratios import Ratio
from edge.bench.record import Facts, FrontRow, Record, RunTimeRow
from edge.bench.timing import Times

FULL_TICKS: Final = 3000
"""Fewest ticks for which p99.9 rests on more than the longest few."""
ERROR_COLUMNS: Final = (
    *("method", "taps given", "PSNR dB", "RMSE %", "SSIM", "global SSIM", "IoU", "edge mm", "covered %"),
    "force error %",
)
_PERCENTILES: Final = ("p50 us", "p99 us", "p99.9 us", "max us")
FRONT_COLUMNS: Final = ("front", "method", "taps given", "RMSE %", "PSNR dB", "paced p50 us", "back to back p50 us")
AGAINST_COLUMNS: Final = ("method", "run time / peer's", "peer's / run time")
COMPARE_COLUMNS: Final = ("method", "threads", "other core", "back to back p50, new / old", "paced p50, new / old")


def line(cells: Sequence[str]) -> str:
    """Return a row of a Markdown table."""
    return f"| {' | '.join(cells)} |"


def head(columns: Sequence[str]) -> str:
    """Return the head of a Markdown table."""
    return f"{line(columns)}\n{'|---' * len(columns)}|"


def about(record: Record) -> str:
    """Describe the date, the command, the machine and the settings."""
    settings = record.settings
    few = "" if settings["ticks"] >= FULL_TICKS else f" (fewer than {FULL_TICKS}: p99.9 and misses mean little)"
    return (
        f"{record.date}, `{record.command}`\n\n{record.machine}. {settings['ticks']} ticks a row at "
        f"{settings['rate_hz']:g} Hz{few}; threads {' and '.join(map(str, settings['threads']))}; "
        f"{'alone, and with ' + settings['load'] if settings['load'] else 'alone'}."
    )


def error_text(floor_percent: float) -> str:
    """Describe the table of errors."""
    return (
        "Frozen test set, means over all frames. Force error is RMS in % of "
        f"{FORCE_RANGE_N:g} N, of what patterns sum up to, by the one factor that suits true patterns best: those "
        f"themselves are {floor_percent:.2f} % off."
    )


def error_line(row: ErrorRow) -> str:
    """Return errors as a row of the table."""
    error = row.error
    cells = (
        f"{error['psnr_db']:.2f}",
        f"{error['rmse_percent']:.2f}",
        *(f"{error[name]:.3f}" for name in ("ssim", "ssim_global", "contact_iou")),
        f"{error['boundary_mm']:.2f}",
        f"{100 * error['coverage_90']:.1f}" if "coverage_90" in error else "-",
        f"{error['force_percent']:.2f}",
    )
    return line((row.name, str(row.given), *cells))


def surface_table(rows: Sequence[ErrorRow]) -> str:
    """Return PSNR in [dB] of each surface as a table, with a column for each error."""
    lines = [head(["surface, PSNR dB", *(f"{row.name} ({row.given})" for row in rows)])]
    for surface in rows[0].psnr_db_by_surface if rows else ():
        lines.append(line([surface, *(f"{row.psnr_db_by_surface[surface]:.1f}" for row in rows)]))
    return "\n".join(lines)


def run_time_columns(rate_hz: float) -> tuple[str, ...]:
    """Return the columns of the table of run times."""
    return (
        *("method", "threads", "other core", "MMAC"),
        *(f"back to back {figure}" for figure in _PERCENTILES),
        *("GMAC/s", "% of peak"),
        *(f"{rate_hz:g} Hz {figure}" for figure in _PERCENTILES),
        *("missed", "CPU %", "start-up ms", "MB"),
    )


def run_time_text(peak_gmac_s: dict[int, float]) -> str:
    """Describe the table of run times."""
    peaks = ", ".join(
        f"{peak:.0f} GMAC/s on {threads} thread{'s' * (threads > 1)}" for threads, peak in peak_gmac_s.items()
    )
    return (
        "Each row in a process of its own, with all taps that the method takes; only a model that takes poses is "
        "faster with fewer, and not measured so. Missed: ticks whose inference was not done when the next was due. "
        "Start-up is from the spawn to the first pattern, MB the most memory resident till then. % of peak is of the "
        "best float32 matrix product of numpy or onnxruntime, measured in this "
        f"run: {peaks}. Rows in 8-bit integers may pass 100 %, as one instruction does more of them."
    )


def run_time_line(row: RunTimeRow, fact: Facts) -> str:
    """Return run times as a row of the table."""
    name = f"{row.name} (run time only{', weights ' + fact.weights if fact.weights else ''})"
    cells = (
        name if fact.kind == "peer" else row.name,
        str(row.threads),
        "busy" if row.load else "idle",
        f"{fact.macs / 1e6:.2f}" + (f" without {', '.join(fact.uncounted)}" if fact.uncounted else ""),
        *_percentiles(row.back_to_back),
        f"{row.gmac_s:.1f}",
        f"{row.peak_percent:.1f}",
        *_percentiles(row.paced.times),
        f"{row.paced.missed} of {row.paced.ticks}",
        f"{row.paced.cpu_percent:.1f}",
        f"{row.start_up_ms:.0f}",
        "-" if row.resident_mb is None else f"{row.resident_mb:.0f}",
    )
    return line(cells)


def front_text(rows: Sequence[RunTimeRow]) -> str:
    """Describe the table of the front."""
    threads = min(row.threads for row in rows)
    return (
        f"On {threads} thread{'s' * (threads > 1)}, the other core idle. * is on the Pareto front: no other is at "
        "least as good in both RMSE and paced p50."
    )


def front_line(row: FrontRow) -> str:
    """Return error against run time as a row of the table."""
    return line(
        (
            "*" if row.on_front else "",
            row.name,
            str(row.given),
            f"{row.rmse_percent:.2f}",
            f"{row.psnr_db:.2f}",
            f"{row.paced_p50_us:.0f}",
            f"{row.back_to_back_p50_us:.0f}",
        )
    )


def against_text(peer: str, weights: str | None) -> str:
    """Describe the table of ratios to the peer."""
    nobody = f" Its weights are {weights}: its run time is valid, its patterns are not." if weights else ""
    return (
        f"Against {peer}, run time only.{nobody} Both in one process, block by block in turn, back to back on one "
        "thread; medians with 95 % intervals."
    )


def against_line(name: str, ratio: Ratio) -> str:
    """Return a ratio to the peer, both ways, as a row of the table."""
    return line((name, str(ratio), str(Ratio(1 / ratio.ratio, 1 / ratio.high, 1 / ratio.low))))


def compare_text(path: str, comparison: Comparison) -> str:
    """Describe the table of ratios to an earlier bench."""
    peaks = ", ".join(f"{ratio:.2f} on {threads}" for threads, ratio in comparison.peak.items()) or "not in both"
    lines = [
        f"New over old, {path}: medians with 95 % intervals of what varies within a run; * where 1 is outside. "
        f"The machine's peak, new over old, by threads: {peaks}."
    ]
    for label, texts in (
        ("Not the same", comparison.differences),
        ("Not in this bench", comparison.only_old),
        ("Not in the earlier one", comparison.only_new),
    ):
        if texts:
            lines.append(f"{label}: {'; '.join(texts)}.")
    return "\n\n".join(lines)


def compare_line(row: Compared) -> str:
    """Return ratios to an earlier bench as a row of the table."""
    ratios = (f"{ratio}{' *' * ratio.differs}" for ratio in (row.back_to_back, row.paced))
    return line((row.name, str(row.threads), "busy" if row.load else "idle", *ratios))


def progress_text(name: str, threads: int, load: bool) -> str:
    """Name the row that is being measured."""
    return f"run time of {row_text(name, threads, load)}"


def _percentiles(times: Times) -> tuple[str, str, str, str]:
    few = times.runs < 1000
    p999 = "-" if few else f"{times.p999_us:.0f}"
    return f"{times.p50_us:.0f}", f"{times.p99_us:.0f}", p999, f"{times.max_us:.0f}"

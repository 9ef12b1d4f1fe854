"""Section of the bench on the inference that a scene makes unnecessary."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from edge.bench.contenders import Subject
from edge.bench.gate_savings import Saving, savings
from edge.bench.live_report import Page
from edge.bench.record import Record
from edge.bench.report import head, line
from edge.evaluation.test_set import FrozenSet
from edge.inference.bundled import DEFAULT_MODEL
from edge.inference.onnx_session import ModelSession

MODELS: Final = (DEFAULT_MODEL, "mtsr4-int8")
COLUMNS: Final = ("left out", "model", "scans", "inferred %", "CPU us a scan", "taps used", "PSNR dB")
_TEXT: Final = (
    "Taps of the test set through the runtime, held for a second, with a second of rest after each; back to back, so "
    "that CPU is that of warm caches. Each row leaves out one thing more."
)


def show_savings(everyone: Sequence[Subject], frozen: FrozenSet, record: Record, page: Page) -> None:
    """Measure, show and record the savings of those of MODELS that are among `everyone`."""
    shown = [Path(subject.path) for subject in everyone if subject.name in MODELS and subject.path is not None]
    if not shown:
        return
    page.section("What a scene spares", _TEXT, head(COLUMNS))
    for path in page.tracked(shown, "scenes", "model"):
        page.progress(f"what a scene spares {path.stem}")
        for saving in savings(ModelSession(path), frozen):
            record.savings.append(saving)
            page.say(saving_line(saving))


def saving_line(row: Saving) -> str:
    """Return a row of the table."""
    shares = (f"{100 * row.inferred / row.scans:.1f}", f"{row.cpu_us:.0f}", f"{row.taps_used:.2f}")
    return line((row.left_out, row.model, str(row.scans), *shares, f"{row.psnr_db:.2f}"))

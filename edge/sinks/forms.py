"""Sinks as a user writes them."""

from pathlib import Path
from typing import Final

from edge.contract import Contract
from edge.errors import UsageError
from edge.sinks.base import Sink

FORMS: Final = ("status", "jsonl:FILE", "jsonl:- (stdout)", "npz:FILE.npz")


def open_sink(text: str, contract: Contract, *, patient: bool = True) -> Sink:
    """Open the sink that `text` names.

    Args:
        text: one of FORMS.
        contract: says which maps will come, and their shapes.
        patient: wait for slow readers, rather than leave records out.

    Raises:
        UsageError: no such form; the forms are listed.
        SinkError: it cannot be opened.
    """
    # Each loaded only where it is used: start-up time and memory are for what runs.
    form, _, target = text.partition(":")
    if text == "status":
        from edge.sinks.status import StatusSink

        return StatusSink()
    if form == "jsonl" and target:
        from edge.sinks.jsonl import JsonLinesSink

        return JsonLinesSink(target, patient=patient)
    if form == "npz" and target.endswith(".npz"):
        from edge.sinks.npz import NpzSink

        scan_shape, deviations = (3, contract.rows, contract.cols), contract.interval_factor is not None
        return NpzSink(Path(target), scan_shape, contract.pattern_shape, deviations=deviations)
    raise UsageError(f"no sink {text!r}; sinks are {', '.join(FORMS)}")

"""One JSON record a line, flushed as it is written, since a robot reads it live."""

import errno
import os
import sys
from collections.abc import Mapping
from io import BufferedWriter
from pathlib import Path
from typing import Any, Final

import numpy as np
import orjson
from numpy.typing import NDArray

from edge.errors import SinkClosedError, SinkError
from edge.event import Event
from edge.result import Result, mask_bits
from edge.sinks.base import Sink
from edge.sinks.room import has_room, widen
from firmware_bridge.drift import Drift
from firmware_bridge.scan import Scan

_OPTIONS: Final = orjson.OPT_SERIALIZE_NUMPY | orjson.OPT_APPEND_NEWLINE
_DECIMALS: Final = 7
"""Of maps in [mm]: what is less than a nanometre apart is noise of the arithmetic."""


class JsonLinesSink(Sink):
    """Writes records into a file, or with "-" to stdout.

    Where a robot waits, a reader that is too slow for a pipe must hold up nothing: its records are left out, counted,
    and told in the first it takes again.
    """

    def __init__(self, target: str, *, patient: bool = True) -> None:
        """Open the target; a file that exists is replaced.

        Args:
            target: path, or "-".
            patient: wait for a slow reader, rather than leave records out.

        Raises:
            SinkError: it cannot be opened.
        """
        self._target = "stdout" if target == "-" else target
        self._patient = patient
        self._unwritten = 0
        try:
            self._file = _open(target)
        except OSError as error:
            if error.errno == errno.ENXIO:
                raise SinkError(f"nobody reads {self._target}: start its reader first") from error
            raise SinkError(f"cannot write records to {self._target}: {error.strerror}") from error
        if not patient:
            widen(self._file.fileno())

    @property
    def unwritten(self) -> int:
        """Records left out so far."""
        return self._unwritten

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Write one record; of what sinks left out it tells its own reader's."""
        self._write(record_line(result, {**counters, "unwritten": self._unwritten}))

    def tell(self, event: Event, counters: Mapping[str, int]) -> None:
        """Write a record of an event."""
        self._write(event_line(event, {**counters, "unwritten": self._unwritten}))

    def _write(self, line: bytes) -> None:
        if not self._patient and not has_room(self._file.fileno(), len(line)):
            self._unwritten += 1
            return
        try:
            self._file.write(line)
            self._file.flush()
        except BrokenPipeError as error:
            raise SinkClosedError(f"the reader of {self._target} has gone") from error
        except OSError as error:
            raise SinkError(f"cannot write records to {self._target}: {error.strerror}") from error

    def close(self) -> None:
        """Close the file. Every record is on its way already; what an error kept back is lost and was told."""
        try:
            self._file.close()
        except OSError:
            # The writer tries its last record again, and fails again as it did in `write`.
            return


def record_line(result: Result, counters: Mapping[str, int]) -> bytes:
    """A result as one line of JSON; absent is null, masks have bit i for taxel i."""
    scan, baseline = result.scan, result.baseline
    record: dict[str, Any] = {
        "time_ns": scan.time_ns,
        "device_time_ns": scan.device_ns,
        "sensor": scan.sensor,
        "scan": scan.number,
        "source": result.source,
        "state": result.state,
        "fresh": mask_bits(scan.fresh),
        "renewed": mask_bits(scan.renewed),
        "contact": result.contact,
        "taps_used": result.taps_used,
        "force_counts": _rounded(result.force_counts, 1),
        "force_n": _rounded(result.force_n, 4),
        "area_mm2": _rounded(result.area_mm2, 3),
        "centroid_mm": None if result.centroid_mm is None else [round(value, 4) for value in result.centroid_mm],
        "interval_mm": _rounded(result.interval_mm, 5),
        "expected_rmse_mm": _rounded(result.expected_rmse_mm, 5),
        "another_tap": result.another_tap,
        "reused_from": result.reused_from,
        "run_time_us": _rounded(result.run_time_us, 1),
        "latency_us": _rounded(result.latency_us, 1),
        "baseline": None if baseline is None else baseline.id,
        "baseline_origin": None if baseline is None else baseline.origin,
        "baseline_age_s": _rounded(result.baseline_age_s, 1),
        "drift_counts": _drift(result.drift),
        "model": result.model,
        "dead": {str(taxel): reason for taxel, reason in result.dead.items()},
        "filled": result.filled,
        "note": result.note,
        "event": result.event,
        "counters": dict(counters),
        "counts": _readings(scan),
        "pattern_unit": result.pattern_unit,
    }
    if scan.vendor is not None:
        record |= _vendor(scan)
    record["pattern"], record["deviation"] = _map(result.pattern), _map(result.deviation)
    return orjson.dumps(record, option=_OPTIONS)


def event_line(event: Event, counters: Mapping[str, int]) -> bytes:
    """An event as one line of JSON, told apart from results by its state."""
    record = {
        "time_ns": event.time_ns,
        "sensor": event.sensor,
        "state": "event",
        "event": event.kind,
        "note": event.text,
        "counters": dict(counters),
    }
    return orjson.dumps(record, option=orjson.OPT_APPEND_NEWLINE)


def _readings(scan: Scan) -> NDArray[np.int32] | list[list[list[int | None]]]:
    if scan.complete:
        return np.ascontiguousarray(scan.counts)
    readings = scan.counts.astype(object)
    readings[:, ~scan.fresh] = None
    return readings.tolist()


def _vendor(scan: Scan) -> dict[str, list[float] | float]:
    """What the vendor's software says, as far as it does: force x, y, z on the pad, and its mean temperature."""
    said: dict[str, list[float] | float] = {}
    if scan.vendor_force_n is not None:
        said["vendor_force_n"] = [round(force, 4) for force in scan.vendor_force_n]
    if scan.vendor is not None and scan.vendor.temperature_k is not None:
        said["temperature_k"] = round(float(np.nanmean(scan.vendor.temperature_k)), 2)
    return said


def _drift(drift: Drift | None) -> dict[str, Any] | None:
    if drift is None:
        return None
    return {
        "common": [round(counts, 2) for counts in drift.common_counts],
        "own": round(drift.own_counts, 2),
        "step": round(drift.step_counts, 1),
    }


def _rounded(value: float | None, decimals: int) -> float | None:
    return None if value is None else round(value, decimals)


def _map(values: NDArray[np.float32] | None) -> NDArray[np.float32] | None:
    return None if values is None else np.round(values, _DECIMALS)


def _open(target: str) -> BufferedWriter:
    if target == "-":
        if sys.stdout is None:
            raise OSError(0, "it is closed")
        # A writer of our own: what is left in sys.stdout after an error would be tried again at exit.
        return os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    path = Path(target)
    if not path.is_fifo():
        return path.open("wb")
    descriptor = os.open(path, os.O_WRONLY | os.O_NONBLOCK)  # else it would wait for a reader, however long
    os.set_blocking(descriptor, True)
    return os.fdopen(descriptor, "wb")

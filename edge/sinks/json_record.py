"""What a record says of a result, or of an event: one dictionary for every sink that writes them."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge.perception.event import Event
from edge.perception.result import Result, mask_bits
from edge.perception.wrench import Wrench
from firmware_bridge.scans.scan import Scan
from firmware_bridge.zeroing.drift_tracker import Drift


def record(result: Result, counters: Mapping[str, int]) -> dict[str, Any]:
    """All of a result but its maps; absent is None, masks have bit i for taxel i. Counts may be an array."""
    scan, baseline = result.scan, result.baseline
    said: dict[str, Any] = {
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
        "wrench": None if result.wrench is None else _wrench(result.wrench),
        "wrench_origin": result.wrench_origin,
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
        said |= _vendor(scan)
    return said


def event_record(event: Event, counters: Mapping[str, int], source: str | None) -> dict[str, Any]:
    """An event, told apart from results by its state; `source` is the kind of what is read."""
    return {
        "time_ns": event.time_ns,
        "sensor": event.sensor,
        "source": source,
        "state": "event",
        "event": event.kind,
        "note": encodable(event.text),
        "counters": dict(counters),
    }


def encodable(text: str) -> str:
    """What JSON can say of it: a file may be called by any bytes, and JSON is UTF-8."""
    return text.encode(errors="replace").decode()


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


def _wrench(wrench: Wrench) -> dict[str, list[float] | None]:
    centre = wrench.centre_of_pressure_mm
    return {
        "force_n": [round(value, 4) for value in wrench.force_n],
        "torque_n_mm": [round(value, 3) for value in wrench.torque_n_mm],
        "centre_of_pressure_mm": None if centre is None else [round(value, 3) for value in centre],
    }


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

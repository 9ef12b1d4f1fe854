"""Baselines of free pads: of a live source once, to be kept, and of recordings from where they are free and still."""

import math
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType

from edge.pipeline.run_statistics import silence_hint
from edge.pipeline.scan_reader import Source
from edge.pipeline.source_setup import refuse_emulated, with_recorded
from firmware_bridge.errors import BaselineRefusedError, DeviceError, as_typed
from firmware_bridge.links.base import Notice
from firmware_bridge.links.registry import recording_paths
from firmware_bridge.links.replay import ReplayLink
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.scan import Scan
from firmware_bridge.schedule import GIVEN_UP_S, POLL_S
from firmware_bridge.sensor_file.model import SensorFile
from firmware_bridge.zeroing.baseline import FEWEST_SCANS, Baseline, BaselineEstimator
from firmware_bridge.zeroing.free_stretch import FEWEST_RECORDED, free_stretch


def take_baselines(
    source: Source,
    *,
    stop: threading.Event | None = None,
    clock_s: Callable[[], float] = time.monotonic,
) -> dict[str, Baseline]:
    """Take the baselines of all sensors of a source, by name: medians of their first 100 complete scans, pads free.

    Raises a BaselineRefusedError where a pad moved or was loaded, or the source ended or was stopped too soon, and a
    DeviceError where no scan, or no whole new one of a sensor, arrived for a long time. No stream may read the source.
    """
    source.reserve()
    clock = (lambda: math.nan) if source.kind == "replay" else time.time  # never today's, of an old file
    estimators: dict[str, BaselineEstimator] = {}
    baselines: dict[str, Baseline] = {}
    whole_s: dict[str, float] = {}
    received_s = clock_s()
    while not (baselines and baselines.keys() == whole_s.keys()):
        if stop is not None and stop.is_set():
            raise BaselineRefusedError("stopped before every sensor was zeroed: nothing is kept")
        taken = source.take(POLL_S)
        if taken is None:
            raise BaselineRefusedError(f"the source ended before {FEWEST_SCANS} complete scans of every sensor")
        now_s = clock_s()
        if any(isinstance(arrival, Scan) for arrival in taken):
            received_s = now_s
        elif now_s - received_s > GIVEN_UP_S:
            hint = silence_hint((), source.counters)
            raise DeviceError(f"no scan from {source.name} for {GIVEN_UP_S:.0f} s: {hint}")
        for arrival in taken:
            if not isinstance(arrival, Scan):
                if isinstance(arrival, Notice) and arrival.kind in ("lost", "silent"):
                    estimators.clear()  # the sensor may read differently after the gap
                continue
            name = arrival.sensor
            if name not in whole_s or (arrival.complete and not arrival.repeated):
                whole_s[name] = now_s
            if name in baselines:
                continue
            estimator = estimators.setdefault(name, BaselineEstimator(clock=clock))
            try:
                baseline = estimator.push(arrival)
            except BaselineRefusedError as refusal:
                raise BaselineRefusedError(f"sensor {name}: {refusal}") from refusal
            if baseline is not None:
                baselines[name] = baseline
        for name in whole_s.keys() - baselines.keys():
            if now_s - whole_s[name] > GIVEN_UP_S:  # a taxel or the sensor is silent, while scans come
                lack = f"no whole new scan from sensor {name} for {GIVEN_UP_S:.0f} s"
                raise DeviceError(f"{lack}: edge-sr doctor shows what is wrong")
    return baselines


def recorded_baselines(
    text: str, sensor_file: SensorFile, rate_hz: float | None
) -> tuple[dict[str, Baseline], list[str]]:
    """Return the baselines of FILE[,FILE], and notes where each pad is free, or raise a BaselineRefusedError."""
    replay = ReplayLink(recording_paths(text), rate_hz)
    refuse_emulated(sensor_file, replay.kind, replay.origin)
    baselines = free_baselines(replay, with_recorded(sensor_file, [replay]).mountings, opening=True, rate_hz=rate_hz)
    sensors = {track.sensor for recording in replay.recordings for track in recording.tracks}
    notes = [notice.text for notice in replay.notices()]
    if sensors - baselines.keys():
        faults = "; ".join(note for note in notes if ": zeroed from " not in note)
        raise BaselineRefusedError(faults or f"fewer than {FEWEST_RECORDED} scans: expected as many of a free pad")
    return baselines, notes


def free_baselines(
    replay: ReplayLink,
    mountings: Mapping[str, Mounting],
    stored: Mapping[str, Baseline] = MappingProxyType({}),
    *,
    opening: bool = False,
    rate_hz: float | None = None,
) -> dict[str, Baseline]:
    """Return the baselines of sensors that have none in `stored`, from where the recordings are free and still.

    The replay gets a note for each sensor. `mountings` are those of taxels that still have to be put in place. With
    `opening` the first scans count, too, from which a live run would zero by itself: for baselines that are kept.
    """
    baselines: dict[str, Baseline] = {}
    for recording in replay.recordings:
        raw = recording.path.suffix.lower() == ".csv"
        held = _remedy(recording.path, rate_hz)
        for track in recording.tracks:
            name = track.sensor
            if name in stored or len(track.counts) < FEWEST_RECORDED:
                continue
            try:
                stretch = free_stretch(track.counts)
            except BaselineRefusedError as refusal:
                replay.notes.append(f"sensor {name}: {refusal}. {held}")
                continue
            doubt = "" if stretch.touched else f". Its readings hardly change: is the pad free, or held? {held}"
            if stretch.opens and not opening:
                if doubt:
                    replay.notes.append(f"sensor {name}: zeroed from its first {FEWEST_SCANS} scans{doubt}")
                continue
            first, last = int(stretch.rows[0]), int(stretch.rows[-1])
            at_ns = replay.times_ns[name][[first, last]]
            how = "still and pressed least"
            if stretch.within_counts is not None:
                how = f"pressed least; it recovers there: a taxel may be off by {stretch.within_counts:.0f} counts"
            replay.notes.append(
                f"sensor {name}: zeroed from its scans {first + 1} to {last + 1}, {at_ns[0] / 1e9:.1f} to "
                f"{at_ns[1] / 1e9:.1f} s, where the pad is {how}{doubt}"
            )
            if raw and name in mountings:
                stretch = stretch._replace(counts=mountings[name].place_counts(stretch.counts))
            created_s = math.nan
            if recording.unix_offset_ns and track.time_ns is not None:  # 0: recorded again from an undated file
                created_s = (int(track.time_ns[last]) + recording.unix_offset_ns) / 1e9
            baselines[name] = stretch.baseline(name, created_s)
    return baselines


def _remedy(path: Path, rate_hz: float | None) -> str:
    """Return what to do about a recording whose pad may never be free."""
    rate = "" if rate_hz is None else f" --rate-hz {rate_hz:g}"
    return (
        "If it holds something all the time, take the baseline of a recording of this sensor in which it lets go: "
        f"edge-sr baseline --source replay:OTHER{rate} --out zero.json; edge-sr replay {as_typed(path)}{rate} "
        "--baseline zero.json shows patterns, marked as not to be believed"
    )

"""Watch of a link while its pads are free, and its examination: all findings, and which only follow from others."""

import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.doctor import link_checks
from edge.doctor import taxel_checks as taxels
from edge.doctor.findings import Finding, judged
from edge.doctor.link_checks import Watched
from edge.doctor.taxel_checks import Samples
from edge.errors import UsageError
from edge.pipeline.source_setup import links_to, refuse_emulated, sensor_settings, stored_baselines
from edge.terminal.progress_bar import progress
from edge.validation import check_baselines, check_positive
from firmware_bridge.errors import BaselineRefusedError
from firmware_bridge.links.base import LinkReader
from firmware_bridge.links.serial_ports import latency_timer_ms
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.scan import Scan
from firmware_bridge.schedule import GIVEN_UP_S, NS_PER_S, POLL_S
from firmware_bridge.sensor_file.model import SensorFile
from firmware_bridge.zeroing import baseline as zeroing
from firmware_bridge.zeroing.baseline import LOAD_LIMIT_COUNTS, Baseline, BaselineEstimator, deformation

_LONGER: Final = "watch for longer: --drift-s 60"
_PRESSED: Final = (
    "something presses: free the pad, and repeat; this baseline is not stored. If it is free, the earlier baseline is "
    "too old: zero again, with edge-sr baseline"
)


@dataclass(frozen=True)
class Examined:
    """Findings of link and sensors, and what the guided press needs of each sensor."""

    findings: list[Finding]
    baselines: dict[str, Baseline]  # of the pads that may be zeroed
    loaded: frozenset[str]  # sensors whose pads are not free, as an earlier baseline shows


def judge(watched: Watched, unix_time_s: float) -> Examined:
    """Return all findings of a watch; `unix_time_s` dates the baselines, in [s] since 1970, NaN if unknown."""
    sampled = {name: Samples(scans) for name, scans in sorted(watched.scans.items()) if len(scans) > 1}
    fewest = 50  # scans that are judged: of fewer neither noise nor rate is known well enough
    enough = {name: samples for name, samples in sampled.items() if samples.scans >= fewest}
    half_silent = {name for name, samples in enough.items() if samples.living.mean() <= 0.5}
    baud = link_checks.check_baud(watched, len(enough))
    id_map = link_checks.check_id_map(watched, bool(half_silent))
    line_full = baud is not None and baud.verdict == "wrong"
    of_link = [link_checks.check_link(watched), baud, link_checks.check_latency(watched), id_map]
    findings = [finding for finding in of_link if finding is not None]
    if not enough:
        link_faulty = any(finding.verdict == "wrong" for finding in findings)
        remedy = "see above" if link_faulty else "is the sensor powered, and is nothing else reading it?"
        early = watched.stopped and watched.duration_s < 1 and not link_faulty  # no sensor had the time
        scans = f"{sum(samples.scans for samples in sampled.values())} scans"
        norm = f"at least {fewest} of a sensor"
        found = ("not known", scans, norm, _LONGER) if early else ("wrong", scans, norm, remedy)
        findings.append(Finding("scans", *found))
    wrong_map = id_map is not None and id_map.verdict == "wrong"
    last_ns = (scans[-1].time_ns for scans in watched.scans.values() if scans)
    newest_ns = watched.until_ns if watched.until_ns is not None else max(last_ns, default=0)
    baselines: dict[str, Baseline] = {}
    for name, samples in enough.items():
        drift, noise = taxels.check_drift(samples), taxels.check_noise(samples)
        spoiled = next((check.name for check in (noise, drift) if check.verdict != "ok"), None)
        baseline, quality = check_baseline(watched.scans[name][1:], samples.living, spoiled, unix_time_s)
        of_sensor = [
            link_checks.check_rate(samples, watched.rate_hz, line_full),
            link_checks.check_torn(samples),
            link_checks.check_lost(samples, (newest_ns - watched.scans[name][-1].time_ns) / NS_PER_S),
            taxels.check_silent(samples, wrong_map and name in half_silent),
            taxels.check_stuck(samples),
            noise,
            taxels.check_rest(samples),
            drift,
            quality,
            check_load(samples.rest_counts(), watched.references.get(name), watched.mountings.get(name)),
        ]
        if baseline is not None:
            baselines[name] = baseline
        findings += [replace(finding, sensor=name) for finding in of_sensor]
    loaded = frozenset(finding.sensor for finding in findings if finding.remedy == _PRESSED and finding.sensor)
    return Examined(findings, baselines, loaded)


def check_baseline(
    scans: Sequence[Scan], living: NDArray[np.bool_], spoiled: str | None, unix_time_s: float
) -> tuple[Baseline | None, Finding]:
    """Return the baseline of the last scans if all taxels are `living` and the pad can be zeroed, and the finding.

    `spoiled` names another finding that explains a refusal; `unix_time_s` is the time of the last scan since 1970.
    """
    needed = zeroing.FEWEST_SCANS
    norm = f"{needed} scans that span at most {' / '.join(f'{limit:.0f}' for limit in zeroing.SPREAD_LIMIT_COUNTS)}"
    if not living.all():
        lack = f"{np.count_nonzero(~living)} taxels have not arrived"
        return None, Finding("baseline", "not known", lack, norm, "see silent taxels")
    usable = [scan for scan in scans if scan.complete and scan.renewed.any()][-needed:]
    if len(usable) < needed:
        measured = f"only {len(usable)} complete scans"
        return None, Finding("baseline", "not known", measured, norm, _LONGER)
    estimator = BaselineEstimator(needed, clock=lambda: unix_time_s)
    baseline = None
    try:
        for scan in usable:
            baseline = estimator.push(scan)
    except BaselineRefusedError as refusal:
        if spoiled is not None:
            return None, Finding("baseline", "not known", "the pad is not still", norm, f"see {spoiled}")
        measured, _, remedy = str(refusal).partition(": ")
        return None, Finding("baseline", "wrong", measured, norm, remedy)
    return baseline, Finding("baseline", "ok", f"{needed} scans agree", norm)


def check_load(
    rest_counts: NDArray[np.float64], reference: Baseline | None, mounting: Mounting | None = None
) -> Finding:
    """Check by an earlier baseline whether something lies on the pad; its rest is (3, taxels), NaN where silent."""
    norm = f"z within {LOAD_LIMIT_COUNTS:.0f} counts of the baseline before"
    if reference is None:
        remedy = "a pad that was loaded from the start looks free; pass an earlier --baseline or --sensor"
        return Finding("load", "not known", "no earlier baseline to compare with", norm, remedy)
    rest = np.nan_to_num(rest_counts).reshape(reference.counts.shape)
    z = deformation(np.rint(rest).astype(np.int32) % zeroing.COUNTS_ON_CIRCLE, reference, mounting)[2].ravel()
    z[np.isnan(rest_counts[2])] = 0
    z = np.nan_to_num(z)
    taxel = int(np.abs(z).argmax())
    measured = f"z {z[taxel]:+.0f} counts on taxel {taxel} against baseline {reference.id}"
    remedy = _PRESSED if z[taxel] > 0 else "the baseline was taken of a loaded pad, or is too old: zero again"
    return judged("load", "wrong" if abs(z[taxel]) > LOAD_LIMIT_COUNTS else "ok", measured, norm, remedy)


def prepare(
    texts: Sequence[str], sensor_file: SensorFile, before: Mapping[str, Baseline], rate_hz: float | None
) -> tuple[LinkReader, SensorFile, Watched]:
    """Return a reader of the link to the source that `texts` names, its sensors' settings, and an empty watch of it."""
    if len(texts) > 1:
        raise UsageError(f"{len(texts)} sources, expected one: examine them one after the other")
    check_baselines(before, sensor_file.model_map.geometry)
    (link,), sensor_file = links_to(texts, sensor_file, rate_hz)
    watched = Watched(model=sensor_file.model_map, rate_hz=rate_hz, references=before, mountings=sensor_file.mountings)
    return LinkReader(link), sensor_file, watched


def watch(reader: LinkReader, watched: Watched, length_s: float, stop: threading.Event) -> None:
    """Watch an open link for `length_s` in [s], until `stop`, or until nothing comes any more; raises LinkLostError."""
    start_s = now_s = received_s = time.monotonic()
    link = reader.link
    try:
        with progress("watching", length_s, "s") as bar:
            while now_s - start_s < length_s and not (stop.is_set() or link.ended) and now_s - received_s <= GIVEN_UP_S:
                for scan in reader.read(POLL_S):
                    watched.scans.setdefault(scan.sensor, []).append(scan)
                    received_s = now_s
                now_s = time.monotonic()
                watched.duration_s = now_s - start_s
                bar.update(min(watched.duration_s, length_s) - bar.n)
    finally:
        watched.counters, watched.ids, watched.stopped = link.counters(), link.can_ids(), stop.is_set()
        if (line := link.serial_line()) is not None:
            watched.port, watched.baud = line
            watched.latency_ms = latency_timer_ms(watched.port)
        watched.until_ns = None if link.kind == "replay" else time.monotonic_ns()


def examine(
    *texts: str,
    sensor: str | Path | None = None,
    id_map: str | None = None,
    rate_hz: float | None = None,
    baselines: Mapping[str, Baseline] | str | Path | None = None,
    duration_s: float = 60.0,
    stop: threading.Event | None = None,
) -> list[Finding]:
    """Watch free, still pads and report faults of sensor and adapter, as `edge-sr doctor` does without a person.

    The source is one of `open_source`, with its errors; no other program may read it meanwhile. `rate_hz` is expected
    of each sensor, and `baselines` of the free pads, or their file, are by default those of the sensor file.
    """
    check_positive("duration_s", duration_s)
    sensor_file = sensor_settings(sensor, id_map)
    reader, sensor_file, watched = prepare(texts, sensor_file, stored_baselines(baselines, sensor_file), rate_hz)
    with reader:
        refuse_emulated(sensor_file, reader.link.kind, reader.link.origin)
        watch(reader, watched, duration_s, threading.Event() if stop is None else stop)
    return judge(watched, time.time()).findings

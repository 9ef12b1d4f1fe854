"""Examination of a watch: all findings, and which of them only follow from others. No I/O, no clock."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.doctor import link_checks as link
from edge.doctor import taxel_checks as taxels
from edge.doctor.findings import Finding, judged
from edge.doctor.link_checks import LineFacts
from edge.doctor.taxel_checks import FEWEST_SCANS, Samples
from firmware_bridge.errors import BaselineRefusedError
from firmware_bridge.scans.can_id_maps import USPA44_MAP, ModelMap
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.scan import Scan
from firmware_bridge.schedule import NS_PER_S
from firmware_bridge.zeroing import baseline as zeroing
from firmware_bridge.zeroing.baseline import LOAD_LIMIT_COUNTS, Baseline, BaselineEstimator, deformation


@dataclass
class Watched:
    """Data of a watch while the pads were free.

    Attributes:
        scans: of each sensor, in their order.
        counters: of the link.
        duration_s: length of the watch so far, in [s].
        facts: of the line.
        ids: the CAN ids that came; empty where the link sees none.
        model: the id map that the user chose.
        rate_hz: that a user expects of each sensor, in [Hz].
        references: earlier baselines of the free pads, by sensor.
        until_ns: end of the watch, on the clock of the scans in [ns]; None stands for the newest scan.
        mountings: of the sensors, as far as they are available.
    """

    scans: dict[str, list[Scan]] = field(default_factory=dict)
    counters: Mapping[str, int] = field(default_factory=dict)
    duration_s: float = 0.0
    facts: LineFacts = field(default_factory=LineFacts)
    ids: frozenset[int] = frozenset()
    model: ModelMap = USPA44_MAP
    rate_hz: float | None = None
    references: Mapping[str, Baseline] = field(default_factory=dict)
    until_ns: int | None = None
    mountings: Mapping[str, Mounting] = field(default_factory=dict)


_PRESSED: Final = (
    "something presses: free the pad, and repeat; this baseline is not stored. If it is free, the earlier baseline is "
    "too old: zero again, with edge-sr baseline"
)


@dataclass(frozen=True)
class Examined:
    """Findings of link and sensors, and by sensor the baselines of the pads that may be zeroed.

    The pads of `loaded` sensors are not free, as an earlier baseline shows.
    """

    findings: list[Finding]
    baselines: dict[str, Baseline]
    loaded: frozenset[str] = frozenset()


def examine(watched: Watched, unix_time_s: float) -> Examined:
    """Return all findings of a watch; `unix_time_s` dates the baselines, in [s] since 1970, NaN if unknown."""
    samples = {name: Samples(scans) for name, scans in sorted(watched.scans.items()) if len(scans) > 1}
    enough = {name: one for name, one in samples.items() if one.enough}
    half_silent = {name for name, one in enough.items() if 2 * np.count_nonzero(one.living) <= one.living.size}
    facts, counters, duration_s = watched.facts, watched.counters, watched.duration_s
    taxel_count = watched.model.geometry.taxel_count
    baud = link.check_baud(facts, counters, duration_s, len(enough), watched.rate_hz, taxel_count)
    id_map = link.check_id_map(watched.ids, watched.model, bool(half_silent))
    line_full = baud is not None and baud.verdict == "wrong"
    of_link = [link.check_link(counters, duration_s), baud]
    if facts.port is not None and enough:
        of_link.append(link.check_latency(facts, max(one.held_back_ms() for one in enough.values()), line_full))
    of_link.append(id_map)
    findings = [finding for finding in of_link if finding is not None]
    if not enough:
        link_faulty = any(finding.verdict == "wrong" for finding in findings)
        remedy = "see above" if link_faulty else "is the sensor powered, and is nothing else reading it?"
        scans = f"{sum(one.scans for one in samples.values())} scans"
        findings.append(Finding("scans", "wrong", scans, f"at least {FEWEST_SCANS} of a sensor", remedy))
    wrong_map = id_map is not None and id_map.verdict == "wrong"
    last_ns = (scans[-1].time_ns for scans in watched.scans.values() if scans)
    newest_ns = watched.until_ns if watched.until_ns is not None else max(last_ns, default=0)
    baselines: dict[str, Baseline] = {}
    for name, one in enough.items():
        drift, noise = taxels.check_drift(one), taxels.check_noise(one)
        spoiled = next((check.name for check in (noise, drift) if check.verdict != "ok"), None)
        baseline, quality = check_baseline(watched.scans[name][1:], one.living, spoiled, unix_time_s)
        of_sensor = [
            link.check_rate(one, watched.rate_hz, line_full),
            link.check_torn(one),
            link.check_lost(one, (newest_ns - watched.scans[name][-1].time_ns) / NS_PER_S),
            taxels.check_silent(one, wrong_map and name in half_silent),
            taxels.check_stuck(one),
            noise,
            taxels.check_rest(one),
            drift,
            quality,
            check_load(one.rest_counts(), watched.references.get(name), watched.mountings.get(name)),
        ]
        if baseline is not None:
            baselines[name] = baseline
        findings += [replace(finding, sensor=name) for finding in of_sensor]
    loaded = {one.sensor for one in findings if one.name == "load" and one.remedy == _PRESSED and one.sensor}
    return Examined(findings, baselines, frozenset(loaded))


def check_baseline(
    scans: Sequence[Scan], living: NDArray[np.bool_], spoiled: str | None, unix_time_s: float
) -> tuple[Baseline | None, Finding]:
    """Return the baseline of the last scans if the pad can be zeroed, and the finding on it.

    There is one only if all taxels are `living`; `spoiled` names another finding that explains a refusal. The last scan
    was at `unix_time_s`, in [s] since 1970.
    """
    needed = zeroing.FEWEST_SCANS
    norm = f"{needed} scans that span at most {' / '.join(f'{limit:.0f}' for limit in zeroing.SPREAD_LIMIT_COUNTS)}"
    if not living.any():
        return None, Finding("baseline", "not known", "no taxel has arrived", norm)
    silent = ~living.reshape(scans[0].fresh.shape)
    usable = [scan for scan in scans if (scan.fresh | silent).all() and scan.renewed.any()][-needed:]
    if len(usable) < needed:
        measured = f"only {len(usable)} complete scans"
        return None, Finding("baseline", "not known", measured, norm, "watch for longer: --drift-s 60")
    estimator = BaselineEstimator(needed, clock=lambda: unix_time_s)
    baseline = None
    try:
        for scan in usable:
            baseline = estimator.push(scan, silent if silent.any() else None)
    except BaselineRefusedError as refusal:
        if spoiled is not None:
            return None, Finding("baseline", "not known", "the pad is not still", norm, f"see {spoiled}")
        measured, _, remedy = str(refusal).partition(": ")
        return None, Finding("baseline", "wrong", measured, norm, remedy)
    whole = baseline is not None and not silent.any()
    measured = f"{needed} scans agree" + ("" if whole else f" but for {np.count_nonzero(silent)} silent taxels")
    return baseline if whole else None, Finding("baseline", "ok", measured, norm)


def check_load(
    rest_counts: NDArray[np.float64], reference: Baseline | None, mounting: Mounting | None = None
) -> Finding:
    """Check whether something lies on the pad; only an earlier baseline of the free pad can show it.

    The rest now is (3, taxels), NaN where silent. The mounting gives the direction of z, which tells a load now from
    one then; without one it is as wired.
    """
    norm = f"z within {LOAD_LIMIT_COUNTS:.0f} counts of the baseline before"
    if reference is None:
        remedy = "a pad that was loaded from the start looks free; pass an earlier --baseline or --sensor"
        return Finding("load", "not known", "no earlier baseline to compare with", norm, remedy)
    known = np.nan_to_num(rest_counts).reshape(reference.counts.shape)
    z = deformation(np.rint(known).astype(np.int32) % zeroing.COUNTS_ON_CIRCLE, reference, mounting)[2].ravel()
    z[np.isnan(rest_counts[2])] = 0
    z = np.nan_to_num(z)
    taxel = int(np.abs(z).argmax())
    measured = f"z {z[taxel]:+.0f} counts on taxel {taxel} against baseline {reference.id}"
    remedy = _PRESSED if z[taxel] > 0 else "the baseline was taken of a loaded pad, or is too old: zero again"
    return judged("load", "wrong" if abs(z[taxel]) > LOAD_LIMIT_COUNTS else "ok", measured, norm, remedy)

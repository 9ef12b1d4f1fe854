"""Watch of a link while its pads are free, and the doctor without a person."""

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from edge.doctor.examine import Watched
from edge.doctor.examine import examine as judged
from edge.doctor.findings import Finding
from edge.doctor.link_checks import line_facts
from edge.errors import UsageError
from edge.pipeline.source_setup import links_to, references, refuse_emulated, settled, with_recorded
from edge.validation import check_baselines, check_positive
from firmware_bridge.links.base import Link
from firmware_bridge.schedule import NS_PER_S
from firmware_bridge.sensor_file.model import SensorFile
from firmware_bridge.silence import GIVEN_UP_S, POLL_S
from firmware_bridge.zeroing.baseline import Baseline


def prepare(
    texts: Sequence[str], known: SensorFile, before: Mapping[str, Baseline], rate_hz: float | None
) -> tuple[Link, SensorFile, Watched]:
    """Return the link to the source that `texts` names, the facts on its sensors, and an empty watch of it.

    `before` holds earlier baselines of the free pads, by sensor; `rate_hz` is expected of each sensor, in [Hz]. Raises
    what source_setup.links_to raises, and UsageError for several sources.
    """
    if len(texts) > 1:
        raise UsageError(f"{len(texts)} sources, expected one: examine them one after the other")
    if rate_hz is not None:
        check_positive("rate_hz", rate_hz)
    check_baselines(before, known.model_map.geometry)
    (link,) = links_to(texts, known, rate_hz=rate_hz, give_up_s=0)
    known = with_recorded(known, [link])
    return link, known, Watched(model=known.model_map, rate_hz=rate_hz, references=before, mountings=known.mountings)


def watch(
    link: Link,
    watched: Watched,
    length_s: float,
    stop: threading.Event,
    *,
    tell: Callable[[int, float], object] = lambda scans, passed_s: None,
    clock_s: Callable[[], float] = time.monotonic,
) -> None:
    """Watch an open link for `length_s` in [s], or until `stop`, or until nothing comes any more; raises LinkLostError.

    `tell` is called after each read with the number of scans and the time that has passed, in [s].
    """
    start_s = now_s = received_s = clock_s()
    scans = 0
    try:
        while now_s - start_s < length_s and not (stop.is_set() or link.ended) and now_s - received_s <= GIVEN_UP_S:
            for scan in link.read(POLL_S):
                watched.scans.setdefault(scan.sensor, []).append(scan)
                received_s = now_s
                scans += 1
            now_s = clock_s()
            watched.duration_s = now_s - start_s
            tell(scans, watched.duration_s)
    finally:
        watched.counters, watched.facts, watched.ids = link.counters(), line_facts(link), link.can_ids()
        watched.until_ns = None if link.kind == "replay" else int(clock_s() * NS_PER_S)


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

    Args:
        texts: as for `open_source`, but at most one; no other program may read it meanwhile.
        sensor: as for `open_source`.
        id_map: as for `open_source`.
        rate_hz: expected rate of each sensor, in [Hz].
        baselines: of the free pads, or their file; by default those of the sensor file.
        duration_s: how long to watch, in [s].
        stop: event that ends it early.

    Raises:
        BridgeError: as for `open_source`; LinkLostError if the link is lost meanwhile.
        UsageError: as for `open_source`; several sources, or baselines or a duration that are out of range.
    """
    check_positive("duration_s", duration_s)
    known = settled(sensor, id_map)
    link, known, watched = prepare(texts, known, references(baselines, known), rate_hz)
    with link:
        refuse_emulated(known, link.kind, force=False)
        watch(link, watched, duration_s, threading.Event() if stop is None else stop)
    return judged(watched, time.time()).findings

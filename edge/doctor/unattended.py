"""Doctor without a person: watch free, still pads and judge what was seen."""

import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from edge.pipeline.source_setup import references, refuse_emulated, settled
from edge.validation import check_positive
from firmware_bridge.zeroing.baseline import Baseline

if TYPE_CHECKING:
    from edge.doctor.findings import Finding


def examine(
    *texts: str,
    sensor: str | Path | None = None,
    id_map: str | None = None,
    rate_hz: float | None = None,
    baselines: Mapping[str, Baseline] | str | Path | None = None,
    duration_s: float = 60.0,
    stop: threading.Event | None = None,
) -> "list[Finding]":
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
    from edge.doctor.examine import examine as judge
    from edge.doctor.watch import Watch

    check_positive("duration_s", duration_s)
    known = settled(sensor, id_map)
    stop = threading.Event() if stop is None else stop
    watch = Watch(texts, known, references=references(baselines, known), rate_hz=rate_hz, stop=stop)
    with watch.link:
        refuse_emulated(known, watch.link.kind, force=False)
        watch.run(duration_s)
        watched = watch.watched()
    return judge(watched, time.time()).findings

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
from firmware_bridge.scans.scan import Scan
from firmware_bridge.schedule import NS_PER_S
from firmware_bridge.sensor_file.model import SensorFile
from firmware_bridge.silence import GIVEN_UP_S, POLL_S
from firmware_bridge.zeroing.baseline import Baseline


class Watch:
    """Watch of a link.

    Attributes:
        link: the link; the caller opens and closes it.
        known: facts on its sensors, from the sensor file and the recording.
        scans: of each sensor, in their order.
        duration_s: length of the watch so far, in [s].
    """

    def __init__(
        self,
        texts: Sequence[str],
        known: SensorFile,
        *,
        references: Mapping[str, Baseline],
        rate_hz: float | None,
        stop: threading.Event,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """Prepare to watch the source that `texts` names, one at most, which raises what source_setup.links_to raises.

        Args:
            texts: the source.
            known: facts on the sensors.
            references: earlier baselines of the free pads, by sensor.
            rate_hz: expected of each sensor, in [Hz].
            stop: ends the watch when it is set.
            clock_s: the clock of the scans, monotonic, in [s].
        """
        if len(texts) > 1:
            raise UsageError(f"{len(texts)} sources, expected one: examine them one after the other")
        if rate_hz is not None:
            check_positive("rate_hz", rate_hz)
        check_baselines(references, known.model_map.geometry)
        (self.link,) = links_to(texts, known, rate_hz=rate_hz, give_up_s=0)
        self.known = with_recorded(known, [self.link])
        self.scans: dict[str, list[Scan]] = {}
        self.duration_s = 0.0
        self._references = references
        self._rate_hz = rate_hz
        self._stop = stop
        self._clock_s = clock_s

    def run(self, length_s: float, tell: Callable[[int, float], object] = lambda scans, passed_s: None) -> None:
        """Watch the open link for `length_s` in [s], or until nothing comes any more; raises LinkLostError.

        `tell` is called after each read with the number of scans and the time that has passed, in [s].
        """
        start_s = now_s = received_s = self._clock_s()
        scans = 0
        while now_s - start_s < length_s and not (self._stop.is_set() or self.link.ended):
            if now_s - received_s > GIVEN_UP_S:
                break
            for scan in self.link.read(POLL_S):
                self.scans.setdefault(scan.sensor, []).append(scan)
                received_s = now_s
                scans += 1
            now_s = self._clock_s()
            self.duration_s = now_s - start_s
            tell(scans, self.duration_s)

    def watched(self) -> Watched:
        """Return everything that has come so far, while the link is still open."""
        return Watched(
            self.scans,
            self.link.counters(),
            self.duration_s,
            line_facts(self.link),
            self.link.can_ids(),
            self.known.model_map,
            self._rate_hz,
            self._references,
            None if self.link.kind == "replay" else int(self._clock_s() * NS_PER_S),
            self.known.mountings,
        )


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
    stop = threading.Event() if stop is None else stop
    watch = Watch(texts, known, references=references(baselines, known), rate_hz=rate_hz, stop=stop)
    with watch.link:
        refuse_emulated(known, watch.link.kind, force=False)
        watch.run(duration_s)
        watched = watch.watched()
    return judged(watched, time.time()).findings

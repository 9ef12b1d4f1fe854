"""Watch of a link while its pads are free."""

import threading
import time
from collections.abc import Callable, Mapping, Sequence

from edge.doctor.examine import Watched
from edge.doctor.link_checks import line_facts
from edge.errors import UsageError
from edge.pipeline.source_setup import links_to, with_recorded
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
        """Prepare to watch.

        Args:
            texts: the source, as in edge.pipeline.source_setup.links_to; one at most.
            known: facts on the sensors.
            references: earlier baselines of the free pads, by sensor.
            rate_hz: expected of each sensor, in [Hz].
            stop: ends the watch when it is set.
            clock_s: the clock of the scans, monotonic, in [s].

        Raises:
            BridgeError: as in edge.pipeline.source_setup.links_to.
            UsageError: several sources, or a rate or references that are not valid.
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
        """Watch the open link for so long, or until nothing comes any more.

        Args:
            length_s: in [s].
            tell: called after each read with the number of scans and the time that has passed, in [s].

        Raises:
            LinkLostError: the link is gone.
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

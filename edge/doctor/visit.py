"""The doctor's look at a link: watching free pads, then asking a person for presses."""

import argparse
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Final, TextIO

from edge.doctor.examine import Examined, Watched
from edge.doctor.findings import Finding
from edge.doctor.heard import HeardIds
from edge.doctor.line_checks import line_facts
from edge.doctor.press import GuidedPress
from edge.doctor.verdicts import judge_press
from edge.wrapping import columns, wrapped
from firmware_bridge.baseline import deformation
from firmware_bridge.links.base import Link
from firmware_bridge.mounting import Mounting
from firmware_bridge.scan import Scan
from firmware_bridge.schedule import NS_PER_S

READ_TIMEOUT_S: Final = 0.1
SILENCE_S: Final = 10.0
PROGRESS_S: Final = 1.0
CLEAR_LINE: Final = "\r\x1b[K"


class Visit:
    """One look at a sensor, and what came in meanwhile.

    Attributes:
        port: of the adapter, where it is known.
        duration_s: for how long the pads were watched.
        newtons: counts per newton of the sensors that were weighed.
    """

    def __init__(
        self, options: argparse.Namespace, err: TextIO, stop: threading.Event, clock_s: Callable[[], float]
    ) -> None:
        """Prepare to look.

        Args:
            options: of `edge-sr doctor`, settled by edge.commissioned.use_sensor_file.
            err: for what is asked of a person.
            stop: ends it when it is set.
            clock_s: the clock of the scans, monotonic, in [s].
        """
        self.port: str | None = None
        self.duration_s = 0.0
        self.newtons: dict[str, float] = {}
        self._options = options
        self._err = err
        self._stop = stop
        self._clock_s = clock_s
        self._scans: dict[str, list[Scan]] = {}

    def watch(self, link: Link, heard: HeardIds) -> Watched:
        """What comes while the pads are free."""
        length_s = self._options.drift_s
        self._say(f"{link.name}: watching for {length_s:g} s; keep the pad free and still")
        start_s = shown_s = now_s = heard_s = self._clock_s()
        while now_s - start_s < length_s and not (self._stop.is_set() or link.ended):
            if now_s - heard_s > SILENCE_S:
                break
            for scan in link.read(READ_TIMEOUT_S):
                self._scans.setdefault(scan.sensor, []).append(scan)
                heard_s = now_s
            now_s = self._clock_s()
            self.duration_s = now_s - start_s
            if now_s - shown_s >= PROGRESS_S and self._err.isatty():
                shown_s = now_s
                self._err.write(f"{CLEAR_LINE}{self.duration_s:.0f} of {length_s:g} s")
                self._err.flush()
        if shown_s > start_s:
            self._err.write(CLEAR_LINE)
        return self.watched(link, heard)

    def watched(self, link: Link, heard: HeardIds) -> Watched:
        """What has come so far."""
        facts = line_facts(link)
        self.port = facts.port
        return Watched(
            self._scans,
            link.counters(),
            self.duration_s,
            facts,
            heard.ids,
            self._options.model_map,
            self._options.rate_hz,
            self._options.baselines or {},
            int(self._clock_s() * NS_PER_S) if link.kind != "replay" else None,
            self._options.mountings,
        )

    def press(self, link: Link, examined: Examined) -> dict[str, Mounting]:
        """Ask for presses on every pad that may be zeroed; what is to be corrected of their mountings."""
        found: dict[str, Mounting] = {}
        names = sorted(self._scans)
        why = self._why_no_press(link)
        for name in names:
            if why is None and name in examined.baselines:
                mounting = self._press_one(link, name, examined, len(names) > 1)
                if mounting is not None:
                    found[name] = mounting
            elif why is not None or name not in examined.baselines:
                reason = why or "the pad cannot be zeroed: mend what is wrong first"
                examined.findings.append(Finding("guided press", "not known", "left out", "", reason, name))
        return found

    def _press_one(self, link: Link, name: str, examined: Examined, several: bool) -> Mounting | None:
        baseline = examined.baselines[name]
        mounting = self._options.mountings.get(name)
        guide = GuidedPress(self._options.weight_g)
        whose = f"Sensor {name}: " if several else ""
        self._say(f"{whose}Hold the pad before you as patterns are to be drawn.")
        self._say(whose + guide.first)
        heard_s = self._clock_s()
        while not (guide.done or self._stop.is_set() or link.ended):
            if self._clock_s() - heard_s > SILENCE_S:
                why = f"no scan for {SILENCE_S:.0f} s: see to power and plug"
                examined.findings.append(Finding("guided press", "wrong", "broken off", "", why, name))
                break
            for scan in link.read(READ_TIMEOUT_S):
                if scan.sensor != name:
                    continue
                heard_s = self._clock_s()
                zeroed = deformation(scan.counts, baseline, mounting)
                ask = guide.push(zeroed, scan.time_ns / NS_PER_S)
                if ask is not None:
                    self._say(whose + ask)
        weighed = self._options.weight_g is not None
        findings, found = judge_press(guide.answer, self._options.out is not None, weighed)
        examined.findings.extend(replace(finding, sensor=name) for finding in findings)
        if guide.answer.counts_per_newton is not None:
            self.newtons[name] = guide.answer.counts_per_newton
        return found

    def _why_no_press(self, link: Link) -> str | None:
        if self._options.no_press:
            return "leave out --no-press to find order and axes"
        if link.kind == "replay":
            return "a recording cannot be pressed"
        if not self._err.isatty():
            return "nobody is at a terminal: run the doctor in one to find order and axes"
        return None

    def _say(self, text: str) -> None:
        print(*wrapped(text, columns()), sep="\n", file=self._err, flush=True)

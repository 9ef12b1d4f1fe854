"""Visit of the doctor to a link: it watches free pads, then asks a person for presses."""

import argparse
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import TextIO

from edge.doctor.examine import Examined
from edge.doctor.felt_line import FeltLine, enter_pressed
from edge.doctor.findings import Finding
from edge.doctor.press_findings import judge_press
from edge.doctor.press_guide import Guide, GuidedPress
from edge.doctor.watch import Watch
from edge.terminal.progress_bar import SECONDS, Progress
from edge.terminal.text_wrap import columns, wrapped
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.schedule import NS_PER_S
from firmware_bridge.silence import GIVEN_UP_S, POLL_S
from firmware_bridge.zeroing.baseline import deformation


class Visit:
    """Visit to the sensors of one link.

    Attributes:
        newtons: counts per newton of the sensors that were weighed.
        watched: True when the free pads were watched for the whole time.
        unfinished: True when a measurement was asked of a person, and not made.
    """

    def __init__(
        self,
        options: argparse.Namespace,
        watch: Watch,
        err: TextIO,
        stop: threading.Event,
        clock_s: Callable[[], float],
    ) -> None:
        """Prepare the visit.

        Args:
            options: of `edge-sr doctor`.
            watch: not begun yet.
            err: for requests to a person.
            stop: ends the visit when it is set.
            clock_s: the clock of the scans, monotonic, in [s].
        """
        self.newtons: dict[str, float] = {}
        self.watched = self.unfinished = False
        self._options = options
        self._err = err
        self._stop = stop
        self._clock_s = clock_s
        self._watch = watch
        self._link = watch.link

    def watch(self) -> None:
        """Watch the link while the pads are free.

        Raises:
            LinkLostError: the link is gone.
        """
        length_s = self._options.drift_s
        self._say(f"{self._link.name}: watching for {length_s:g} s; keep the pad free and still")
        with Progress("watching", length_s, SECONDS, stream=self._err, clock_s=self._clock_s) as bar:

            def show(scans: int, passed_s: float) -> None:
                if passed_s > 0:
                    bar.note(f"{scans / passed_s:.0f} scans/s")
                bar.reach(min(passed_s, length_s))

            self._watch.run(length_s, show)
        self.watched = not self._stop.is_set()

    def press(self, examined: Examined) -> dict[str, Mounting]:
        """Ask for presses on every pad that may be zeroed; returns the corrections of their mountings.

        Raises:
            LinkLostError: the link is gone.
        """
        found: dict[str, Mounting] = {}
        names = sorted(self._watch.scans)
        why = self._why_no_press()
        for name in names:
            if why is None and name in examined.baselines:
                mounting = self._press_one(name, examined, len(names) > 1)
                if mounting is not None:
                    found[name] = mounting
            elif why is not None or name not in examined.baselines:
                reason = why or "the pad cannot be zeroed: correct what is wrong first"
                examined.findings.append(Finding("guided press", "not known", "left out", "", reason, name))
        return found

    def _press_one(self, name: str, examined: Examined, several: bool) -> Mounting | None:
        geometry = self._watch.known.geometry
        guide = GuidedPress(self._options.weight_g, geometry)
        whose = f"Sensor {name}: " if several else ""
        self._say(f"{whose}Hold the pad in the orientation in which patterns are to be drawn.")
        self._lead(guide, name, examined, whose)
        weighed = self._options.weight_g is not None
        findings, found = judge_press(guide.answer, self._options.out is not None, weighed, geometry)
        self._add(findings, name, examined)
        if guide.answer.counts_per_newton is not None:
            self.newtons[name] = guide.answer.counts_per_newton
        return found

    def _add(self, findings: list[Finding], name: str, examined: Examined) -> None:
        """Add findings of what was asked of a person."""
        self.unfinished |= any(finding.verdict == "not known" for finding in findings)
        examined.findings.extend(replace(finding, sensor=name) for finding in findings)

    def _lead(self, guide: Guide, name: str, examined: Examined, whose: str) -> None:
        """Lead a person through a dialogue about one sensor."""
        baseline, mounting = examined.baselines[name], self._watch.known.mountings.get(name)
        if not (self._stop.is_set() or self._link.ended):
            self._say(whose + guide.first)
        received_s = self._clock_s()
        line = FeltLine(self._err, self._clock_s)
        enter_pressed()  # one of before is no answer to this request

        def ask(request: str | None) -> None:
            if request is not None:
                line.clear()
                self._say(whose + request)
                line.asked()

        while not (guide.done or self._stop.is_set() or self._link.ended):
            if self._clock_s() - received_s > GIVEN_UP_S:
                why = f"no scan for {GIVEN_UP_S:.0f} s: check power and plug"
                examined.findings.append(Finding("guided press", "wrong", "broken off", "", why, name))
                break
            for scan in self._link.read(POLL_S):
                if scan.sensor != name:
                    continue
                received_s = self._clock_s()
                zeroed = deformation(scan.counts, baseline, mounting)
                ask(guide.push(zeroed, scan.time_ns / NS_PER_S))
            if enter_pressed():
                ask(guide.skip())
            line.show(guide)
        line.clear()

    def _why_no_press(self) -> str | None:
        if self._options.no_press:
            return "leave out --no-press to measure order and axes"
        if self._link.kind == "replay":
            return "a recording cannot be pressed"
        if not self._err.isatty():
            return "stdin is not a terminal: run the doctor in one to measure order and axes"
        return None

    def _say(self, text: str) -> None:
        print(*wrapped(text, columns()), sep="\n", file=self._err, flush=True)

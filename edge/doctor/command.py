"""Command `edge-sr doctor`: watches a link, asks for presses, prints the findings, and keeps the results."""

import argparse
import json
import math
import os
import select
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import TextIO

from edge.doctor.examine import Examined, Watched, judge, prepare, watch
from edge.doctor.findings import Finding, page, summary, worst
from edge.doctor.guided_press import PATIENCE_S, GuidedPress, judge_force, judge_press
from edge.doctor.write_sensor_file import check_writable, keep, refuse_device
from edge.errors import UsageError
from edge.pipeline.gain_keeper import forget_learned
from edge.pipeline.source_setup import refuse_emulated, sensor_settings, stored_baselines
from edge.terminal.progress_bar import progress
from edge.terminal.stop_signals import stop_on_signals
from edge.terminal.text_wrap import columns, drawn, rewritable, wrapped
from firmware_bridge.errors import BridgeError, LinkLostError, SensorFileError
from firmware_bridge.in_place import BACKUP_SUFFIX
from firmware_bridge.links.base import LinkReader
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.schedule import GIVEN_UP_S, NS_PER_S, POLL_S
from firmware_bridge.sensor_file.model import SensorFile
from firmware_bridge.zeroing.baseline import deformation


class FeltLine:
    """Line of the load on the pad that is rewritten in place on a terminal; nothing is written elsewhere."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = drawn(stream)
        self._rewritable = rewritable(self._stream)
        self._shown_s = self.asked_s = time.monotonic()

    def show(self, felt: float) -> None:
        """Show the load, as a share of that of a press, at most ten times a second."""
        now_s = time.monotonic()
        if now_s - self._shown_s < 0.1 or not self._rewritable:
            return
        self._shown_s = now_s
        left_s = max(PATIENCE_S - (now_s - self.asked_s), 0)
        skip = ", Enter skips" if _stdin_is_terminal() else ""
        text = f"felt [{'#' * min(int(10 * felt), 10):10}] {left_s:.0f} s left{skip}"
        self._stream.write(f"\r{text[: columns() - 1]}\x1b[K")
        self._stream.flush()

    def clear(self) -> None:
        """Clear the line, for text that stays."""
        if self._rewritable:
            self._stream.write("\r\x1b[K")


def enter_pressed() -> bool:
    """Return whether Enter was pressed on the terminal since the last call; never waits."""
    if not _stdin_is_terminal() or not select.select([sys.stdin.fileno()], [], [], 0)[0]:
        return False
    return b"\n" in os.read(sys.stdin.fileno(), 1024)


def _stdin_is_terminal() -> bool:
    # Only on POSIX can a terminal be polled for input.
    return os.name == "posix" and sys.stdin is not None and not sys.stdin.closed and sys.stdin.isatty()


class Visit:
    """Visit to the sensors of one link: what is asked of a person, and what that gives.

    `mountings` are corrections of the mountings, and `newtons` the counts per newton of those that were weighed, by
    sensor; `unfinished` is true when a measurement was asked of a person, and not made.
    """

    def __init__(
        self, options: argparse.Namespace, reader: LinkReader, known: SensorFile, err: TextIO, stop: threading.Event
    ) -> None:
        """Prepare the visit; requests to a person go to `err`."""
        self.mountings: dict[str, Mounting] = {}
        self.newtons: dict[str, float] = {}
        self.unfinished = False
        self._options, self._reader, self._known = options, reader, known
        self._link = reader.link
        self._err, self._stop = err, stop

    def watch(self, watched: Watched) -> None:
        """Watch the link while the pads are free; raises LinkLostError."""
        length_s = self._options.drift_s
        self._say(f"{self._link.name}: watching for {length_s:g} s; keep the pad free and still")
        with progress("watching", length_s, "s", stream=self._err) as bar:

            def show(scans: int, passed_s: float) -> None:
                if passed_s > 0:
                    bar.set_postfix_str(f"{scans / passed_s:.0f} scans/s", refresh=False)
                bar.update(min(passed_s, length_s) - bar.n)

            watch(self._reader, watched, length_s, self._stop, tell=show)

    def press(self, names: Sequence[str], examined: Examined) -> None:
        """Ask for presses on every pad that may be zeroed, and add what is found; raises LinkLostError."""
        why = self._why_no_press()
        for name in names:
            if why is None and name in examined.baselines:
                self._press_one(name, f"Sensor {name}: " if len(names) > 1 else "", examined)
            else:
                reason = why or "the pad cannot be zeroed: correct what is wrong first"
                examined.findings.append(Finding("guided press", "not known", "left out", "", reason, name))

    def _press_one(self, name: str, whose: str, examined: Examined) -> None:
        geometry, weight_g = self._known.geometry, self._options.weight_g
        guide = GuidedPress(weight_g, geometry)
        self._say(f"{whose}Hold the pad in the orientation in which patterns are to be drawn.")
        self._lead(guide, name, examined, whose)
        findings, found = judge_press(guide.presses, geometry, kept=self._options.out is not None)
        if weight_g is not None:
            findings.append(judge_force(guide.counts_per_newton, kept=self._options.out is not None))
        self.unfinished |= any(finding.verdict == "not known" for finding in findings)
        examined.findings.extend(replace(finding, sensor=name) for finding in findings)
        if guide.counts_per_newton is not None:
            self.newtons[name] = guide.counts_per_newton
        if found is not None:
            self.mountings[name] = found

    def _lead(self, guide: GuidedPress, name: str, examined: Examined, whose: str) -> None:
        """Lead a person through a dialogue about one sensor."""
        baseline, mounting = examined.baselines[name], self._known.mountings.get(name)
        if not (self._stop.is_set() or self._link.ended):
            self._say(whose + guide.first)
        received_s = time.monotonic()
        line = FeltLine(self._err)
        enter_pressed()  # one of before is no answer to this request

        def ask(request: str | None) -> None:
            if request is not None:
                line.clear()
                self._say(whose + request)
                line.asked_s = time.monotonic()

        while not (guide.done or self._stop.is_set() or self._link.ended):
            if time.monotonic() - received_s > GIVEN_UP_S:
                why = f"no scan for {GIVEN_UP_S:.0f} s: check power and plug"
                examined.findings.append(Finding("guided press", "wrong", "broken off", "", why, name))
                break
            for scan in self._reader.read(POLL_S):
                if scan.sensor == name:
                    received_s = time.monotonic()
                    ask(guide.push(deformation(scan.counts, baseline, mounting), scan.time_ns / NS_PER_S))
            if enter_pressed():
                ask(guide.skip())
            line.show(guide.felt)
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


def run(options: argparse.Namespace, out: TextIO, err: TextIO) -> int:
    """Run `edge-sr doctor`; returns the exit code. Findings go to `out`, requests to a person to `err`, if a terminal.

    A link that was lost, and a sensor file that could not be written in the end, are raised after the findings were
    printed.
    """
    if options.forget_gains is not None:
        if options.sensor is None:
            raise UsageError("--forget-gains is of a sensor file, which was not named: add --sensor FILE")
        forget_learned(options.sensor, options.forget_gains)
        print(f"{options.sensor}: learned gains of sensor {options.forget_gains} removed", file=out)
        return 0
    known = sensor_settings(options.sensor, options.id_map)
    if options.out is not None:
        check_writable(options.out, known)
    before = stored_baselines(options.baseline, known)
    with stop_on_signals() as stop:
        reader, known, watched = prepare(options.source, known, before, options.rate_hz)
        link = reader.link
        emulated = "emulated" in (link.kind, link.origin)
        if options.out is not None and emulated:
            refuse_device(options.out, known)
        visit = Visit(options, reader, known, err, stop)
        start_s = time.monotonic()
        failed: BridgeError | None = None
        whole = False
        with reader:
            refuse_emulated(known, link.kind, options.force)
            try:
                visit.watch(watched)
                whole = not stop.is_set()
            except LinkLostError as error:
                failed = error
            examined = judge(watched, math.nan if link.kind == "replay" else time.time())
            if whole:
                try:
                    visit.press(sorted(watched.scans), examined)
                except LinkLostError as error:
                    failed = error
        if failed is not None:
            examined.findings.append(Finding("link", "wrong", f"lost: {failed}", "", "check plug and cable"))
        kept, replaced = False, options.out is not None and options.out.exists()
        if options.out is not None and failed is None and whole:
            free = {name: one for name, one in examined.baselines.items() if name not in examined.loaded}
            try:
                keep(options.out, known, watched.facts.port, free, visit.mountings, visit.newtons, emulated=emulated)
                kept = True
            except SensorFileError as error:
                failed = error
        stopped_s = time.monotonic() - start_s if stop.is_set() else None
        if options.json:
            document = {
                "source": link.name,
                "kind": link.kind,
                "id_map": known.model,
                "duration_s": round(watched.duration_s, 3),
                "stopped": stopped_s is not None,
                "verdict": worst(examined.findings),
                "findings": [finding.document() for finding in examined.findings],
                "sensor_file": str(options.out) if kept else None,
            }
            print(json.dumps(document, indent=1), file=out)
        else:
            files = [f"kept in {options.out}"] if kept else []
            files += [f"the former file is now {options.out}{BACKUP_SUFFIX}"] if kept and replaced else []
            if kept and options.weight_g is not None:
                then = f"python -m train.own {options.out} --recordings FOLDER --out mine"
                files += wrapped(f"train a model for it alone: {then}", columns())
            kind = "" if link.kind == "device" else f" ({link.kind.upper()})"
            early = "" if stopped_s is None else f"stopped after {stopped_s:.0f} s: "
            print(f"{link.name}{kind}", page(examined.findings, columns()), *files, sep="\n", file=out)
            print(*wrapped(early + summary(examined.findings), columns()), sep="\n", file=out)
        if failed is not None:
            raise failed
        if stop.is_set():
            if options.out is not None and not kept:
                print(f"{options.out}: not written, because the free pad was not measured to the end", file=err)
            return 130
    return 1 if visit.unfinished or worst(examined.findings) == "wrong" else 0

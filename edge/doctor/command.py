"""Command `edge-sr doctor`: watches a link, asks for presses, prints the findings, and keeps the results."""

import argparse
import json
import math
import os
import select
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, replace
from pathlib import Path
from typing import TextIO

import numpy as np

from edge.doctor.examine import Examined, Watched, judge, prepare, watch
from edge.doctor.findings import Finding, page, summary, worst
from edge.doctor.grip import ASK as GRIP
from edge.doctor.grip import Grip
from edge.doctor.guided_press import (
    PATIENCE_S,
    GuidedPress,
    Weighed,
    judge_force,
    judge_press,
)
from edge.doctor.rehearsal import WATCHED_S, Rehearsal
from edge.errors import UsageError
from edge.pipeline.gain_keeper import forget_learned
from edge.pipeline.source_setup import refuse_emulated, sensor_settings, stored_baselines
from edge.terminal.argument_types import columns, wrapped
from edge.terminal.stop_signals import stop_on_signals
from firmware_bridge import in_place
from firmware_bridge.errors import BridgeError, LinkLostError, SensorFileError, as_typed, harmless
from firmware_bridge.links.base import LinkReader
from firmware_bridge.links.serial_ports import serial_ports
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.schedule import GIVEN_UP_S, NS_PER_S, POLL_S
from firmware_bridge.sensor_file.model import SensorEntry, SensorFile, load_sensor_file
from firmware_bridge.sensor_file.toml_writer import changing, save_sensor_file
from firmware_bridge.zeroing.baseline import Baseline, deformation


def typed_line() -> str | None:
    """Return the last line that was typed on the terminal since the last call, or None; never waits."""
    if not _stdin_is_terminal() or not select.select([sys.stdin.fileno()], [], [], 0)[0]:
        return None
    lines = os.read(sys.stdin.fileno(), 1024).decode(errors="replace").split("\n")
    return harmless(lines[-2]) if len(lines) > 1 else None


def _stdin_is_terminal() -> bool:
    return sys.stdin is not None and not sys.stdin.closed and sys.stdin.isatty()


class Visit:
    """Visit to the sensors of one link: what is asked of a person, and what that gives."""

    def __init__(
        self,
        options: argparse.Namespace,
        reader: LinkReader,
        sensor_file: SensorFile,
        err: TextIO,
        stop: threading.Event,
        rehearsal: Rehearsal | None,
    ) -> None:
        """Prepare the visit; requests to a person, or to a `rehearsal`, go to `err`."""
        self.mountings: dict[str, Mounting] = {}  # corrections, by sensor
        self.weighed: dict[str, Weighed] = {}  # counts per newton, by sensor
        self.unfinished = False  # a measurement was asked of a person, and not made
        self._options, self._reader, self._sensor_file = options, reader, sensor_file
        self._link = reader.link
        self._err, self._stop, self._rehearsal = err, stop, rehearsal

    def watch(self, watched: Watched) -> None:
        """Watch the link while the pads are free; raises LinkLostError."""
        length_s = self._options.drift_s if self._rehearsal is None else WATCHED_S
        self._say(f"{self._link.name}: watching for {length_s:g} s; keep the pad free and still")
        watch(self._reader, watched, length_s, self._stop)

    def press(self, names: Sequence[str], examined: Examined) -> None:
        """Ask for presses on every pad that may be zeroed, and add what is found; raises LinkLostError."""
        why = self._why_no_press()
        for name in names:
            if why is None and name in examined.baselines:
                self._press_one(name, f"Sensor {name}: " if len(names) > 1 else "", examined)
            else:
                reason = why or "the pad cannot be zeroed: correct what is wrong first"
                examined.findings.append(Finding("guided press", "not known", "left out", "", reason, name))
        if why is None and len(names) == 2 and set(names) <= examined.baselines.keys():
            self._grip((names[0], names[1]), examined)

    def _press_one(self, name: str, whose: str, examined: Examined) -> None:
        geometry, answers = self._sensor_file.geometry, self._rehearsal is not None or _stdin_is_terminal()
        guide = GuidedPress(geometry, weigh=answers)
        skips = " Enter skips a request." * (self._rehearsal is None and _stdin_is_terminal())
        self._say(f"{whose}Hold the pad in the orientation in which patterns are to be drawn.{skips}")
        self._lead(guide, name, examined, whose)
        findings, mounting = judge_press(guide.presses, geometry, kept=self._options.out is not None)
        if guide.weight_g is not None:
            findings.append(judge_force(guide.weighed, kept=self._options.out is not None))
        self.unfinished |= any(finding.verdict == "not known" for finding in findings)
        if answers and guide.weight_g is None and name not in self._sensor_file.counts_per_newton:
            remedy = "forces in newtons are a quarter off either way until a weight is laid on: run the doctor again"
            findings.append(Finding("force", "not known", "no weight was laid on", "", remedy))
        examined.findings.extend(replace(finding, sensor=name) for finding in findings)
        if guide.weighed is not None and guide.weighed.plausible:
            self.weighed[name] = guide.weighed
        if mounting is not None:
            self.mountings[name] = mounting

    def _grip(self, names: tuple[str, str], examined: Examined) -> None:
        """Ask for a grip of two pads, in which each is the other's reference."""
        if self._stop.is_set() or self._link.ended:
            return
        grip = Grip(names)
        self._say(GRIP + " Enter skips." * _stdin_is_terminal())
        end_s = time.monotonic() + PATIENCE_S
        while not (grip.over or self._stop.is_set() or self._link.ended or time.monotonic() > end_s):
            for scan in self._reader.read(POLL_S):
                if scan.sensor in names:
                    mounting = self._sensor_file.mountings.get(scan.sensor)
                    zeroed = deformation(scan.counts, examined.baselines[scan.sensor], mounting)
                    grip.push(scan.sensor, scan.time_ns / NS_PER_S, float(np.nansum(zeroed[2])))
            if typed_line() is not None:
                return
        weighed, scales = self._sensor_file.counts_per_newton, dict[str, Weighed]()
        for name, (low, high) in self._sensor_file.scale_intervals.items():  # without one it is no measured scale
            scales[name] = Weighed(weighed[name], (high - low) / 2 / weighed[name])
        examined.findings.extend(grip.judge(scales | self.weighed))
        self.weighed.update(grip.weighed)

    def _lead(self, guide: GuidedPress, name: str, examined: Examined, whose: str) -> None:
        """Lead a person through a dialogue about one sensor."""
        baseline, mounting = examined.baselines[name], self._sensor_file.mountings.get(name)
        if not (self._stop.is_set() or self._link.ended):
            self._ask(whose, guide.first)
        received_s = time.monotonic()
        typed_line()  # one of before is no answer to this request
        while not (guide.done or self._stop.is_set() or self._link.ended):
            if time.monotonic() - received_s > GIVEN_UP_S:
                why = f"no scan for {GIVEN_UP_S:.0f} s: check power and plug"
                examined.findings.append(Finding("guided press", "wrong", "broken off", "", why, name))
                break
            requests: list[str | None] = []
            for scan in self._reader.read(POLL_S):
                if scan.sensor == name:
                    received_s = time.monotonic()
                    requests.append(guide.push(deformation(scan.counts, baseline, mounting), scan.time_ns / NS_PER_S))
            line = typed_line() if self._rehearsal is None else self._rehearsal.typed_line()
            if line is not None:
                requests.append(guide.type(line))
            for request in filter(None, requests):
                self._ask(whose, request)

    def _ask(self, whose: str, request: str) -> None:
        self._say(whose + request)
        if self._rehearsal is not None:
            self._rehearsal.answer(request)

    def _why_no_press(self) -> str | None:
        if self._rehearsal is not None:
            return None
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
    """Run `edge-sr doctor`; return the exit code. A link that was lost is raised after the findings were printed."""
    if options.forget_gains is not None:
        if options.sensor is None:
            raise UsageError("--forget-gains is of a sensor file, which was not named: add --sensor FILE")
        forget_learned(options.sensor, options.forget_gains)
        print(f"{options.sensor}: learned gains of sensor {options.forget_gains} removed", file=out)
        return 0
    sensor_file = sensor_settings(options.sensor, options.id_map)
    if options.out is not None:
        check_writable(options.out, sensor_file)
    before = stored_baselines(options.baseline, sensor_file)
    if options.rehearse and (options.source or sensor_file.model_map.geometry != USPA44):
        raise UsageError("--rehearse brings its own sensor, a uSPa44: leave --source and other pads out")
    with stop_on_signals() as stop, Rehearsal() if options.rehearse else nullcontext() as rehearsal:
        sources = options.source if rehearsal is None else [f"slcan:{rehearsal.port}"]
        reader, sensor_file, watched = prepare(sources, sensor_file, before, options.rate_hz)
        link = reader.link
        emulated = "emulated" in (link.kind, link.origin)
        if options.out is not None and emulated:
            refuse_device(options.out, sensor_file)
        visit = Visit(options, reader, sensor_file, err, stop, rehearsal)
        start_s = time.monotonic()
        failed: BridgeError | None = None
        whole = False
        with reader:
            refuse_emulated(sensor_file, link.kind, link.origin)
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
            free = {name: baseline for name, baseline in examined.baselines.items() if name not in examined.loaded}
            port = watched.port
            try:
                keep(options.out, sensor_file, port, free, visit.mountings, visit.weighed, emulated=emulated)
                kept = True
            except SensorFileError as error:
                failed = error
        stopped_s = time.monotonic() - start_s if stop.is_set() else None
        verdict = worst(finding.verdict for finding in examined.findings)
        if options.json:
            document = {
                "source": link.name,
                "kind": link.kind,
                "id_map": sensor_file.model,
                "duration_s": round(watched.duration_s, 3),
                "stopped": stopped_s is not None,
                "verdict": verdict,
                "findings": [asdict(finding) for finding in examined.findings],
                "sensor_file": str(options.out) if kept else None,
            }
            print(json.dumps(document, indent=1), file=out)
        else:
            files = [f"kept in {options.out}"] if kept else []
            files += [f"the former file is now {options.out}{in_place.BACKUP_SUFFIX}"] if kept and replaced else []
            if kept and visit.weighed and rehearsal is None:
                then = f"python -m train.own {as_typed(options.out)} --recordings FOLDER --out mine"
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
    return 1 if visit.unfinished or verdict == "wrong" else 0


def check_writable(path: Path, sensor_file: SensorFile) -> None:
    """Raise a SensorFileError for a file that cannot be written, and for one that is not `sensor_file`'s."""
    try:
        in_place.check_writable(path)
    except OSError as error:
        why = error.strerror or error
        raise SensorFileError(f"{path}: cannot be written: {why}: pass --out a file in a folder of yours") from error
    if path.exists() and (sensor_file.path is None or sensor_file.path.resolve() != path.resolve()):
        raise SensorFileError(
            f"{path}: left as it is, because what it holds would be lost: pass --sensor {as_typed(path)} as well, to "
            "keep what is not measured again, or another --out"
        )


def refuse_device(path: Path, sensor_file: SensorFile) -> None:
    """Raise a SensorFileError where an emulated sensor would be written into the file of a device."""
    measured = (
        entry for entry in sensor_file.sensors.values() if entry.baseline is not None or "mounting" not in entry.assumed
    )
    if path.exists() and not all(entry.emulated for entry in measured):
        raise SensorFileError(
            f"{path}: left as it is, because it is of a device, and this one is emulated: another --out"
        )


def keep(
    path: Path,
    sensor_file: SensorFile,
    port: str | None,
    baselines: Mapping[str, Baseline],
    mountings: Mapping[str, Mounting],
    weighed: Mapping[str, Weighed],
    *,
    emulated: bool = False,
) -> SensorFile:
    """Write the `sensor_file` from before with the new results, by sensor, and return it, or raise a SensorFileError.

    `port` is that of the adapter. Baselines are as they were read; `mountings` correct those before.
    """
    with changing(path):
        entries, as_wired = dict(sensor_file.sensors), Mounting(taxel_count=sensor_file.geometry.taxel_count)
        if path.exists():  # a run may have learned gains meanwhile
            for name, entry in load_sensor_file(path).sensors.items():
                entries[name] = replace(entries.get(name, entry), learned=entry.learned)
        for name in sorted({*baselines, *mountings, *weighed}):
            entry = entries.get(name, SensorEntry(as_wired, assumed=frozenset({"mounting"})))
            parts = {"mounting": mountings, "force": weighed, "baseline": baselines}
            renewed = frozenset(part for part, of_sensors in parts.items() if name in of_sensors)
            turned = mountings.get(name, as_wired)
            baseline = baselines.get(name, entry.baseline)
            if baseline is not None and turned.moves_taxels:
                counts = baseline.counts.reshape(3, -1)[:, list(turned.order)].reshape(baseline.counts.shape)
                baseline = Baseline.of(name, counts, baseline.created_unix_s, baseline.scans, baseline.origin)
            per_newton, interval = entry.counts_per_newton, entry.counts_per_newton_interval
            if name in weighed:
                per_newton = round(weighed[name].counts_per_newton, 2)
                low, high = weighed[name].interval
                interval = (round(low, 2), round(high, 2))
            pads = [None if pad is None else pad.turned(turned) for pad in (entry.pad, entry.learned)]
            entries[name] = SensorEntry(
                entry.mounting.then(turned),
                per_newton,
                baseline,
                *pads,
                assumed=entry.assumed - renewed,
                emulated=entry.emulated | renewed if emulated else entry.emulated - renewed,
                frame=entry.frame,
                counts_per_newton_interval=interval,
            )
        # A sensor of a named source is one of several, each with an adapter of its own.
        serial_number = None if port is None or any("/" in name for name in entries) else _serial_number(port)
        written = replace(sensor_file, adapter=serial_number or sensor_file.adapter, sensors=entries)
        save_sensor_file(path, written)
        return written


def _serial_number(path: str) -> str | None:
    device, ports = str(Path(path).resolve()), serial_ports()
    number = next((port.serial_number for port in ports if port.path == device), None)
    return number if [port.serial_number for port in ports].count(number) == 1 else None

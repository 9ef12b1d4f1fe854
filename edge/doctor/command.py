"""Command `edge-sr doctor`: watches a link, asks for presses, prints the findings, and keeps the results."""

import argparse
import json
import math
import time
from collections.abc import Callable
from typing import Final, TextIO

from edge.doctor.examine import examine
from edge.doctor.findings import Finding, page, summary, worst
from edge.doctor.session import Visit
from edge.doctor.watch import Watch
from edge.doctor.write_sensor_file import check_writable, keep
from edge.errors import UsageError
from edge.pipeline.gain_keeper import forget_learned
from edge.pipeline.source_setup import references, refuse_emulated, settled
from edge.terminal.stop_signals import stop_on_signals
from edge.terminal.text_wrap import columns, wrapped
from firmware_bridge.errors import LinkLostError, SensorFileError
from firmware_bridge.in_place import BACKUP_SUFFIX
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.sensor_file.model import SensorFile

EXIT_WRONG: Final = 1
EXIT_STOPPED: Final = 130


def run(
    options: argparse.Namespace,
    out: TextIO,
    err: TextIO,
    *,
    clock_s: Callable[[], float] = time.monotonic,
) -> int:
    """Run `edge-sr doctor`; returns the exit code.

    Args:
        options: of edge.doctor.options.doctor_parser.
        out: for the findings.
        err: for requests to a person; no press is asked for where it is no terminal.
        clock_s: the clock of the scans, monotonic, in [s].

    Raises:
        LinkLostError: raised after the findings until then were printed.
        BridgeError: of the source.
        RecordingError: the baseline file cannot be used, or is of another order.
        UsageError: several sources; or the sensor file is for another id map than the chosen one.
        SensorFileError: the sensor file cannot be used, or cannot be written; a failure at the end is raised after the
            findings were printed.
    """
    if options.forget_gains is not None:
        if options.sensor is None:
            raise UsageError("--forget-gains is of a sensor file, which was not named: add --sensor FILE")
        forget_learned(options.sensor, options.forget_gains)
        print(f"{options.sensor}: learned gains of sensor {options.forget_gains} removed", file=out)
        return 0
    known = settled(options.sensor, options.id_map)
    if options.out is not None:
        check_writable(
            options.out,
            known,
            presses=not options.no_press,
            weighs=options.weight_g is not None,
        )
    before = references(options.baseline, known)
    with stop_on_signals() as stop:
        watch = Watch(options.source, known, references=before, rate_hz=options.rate_hz, stop=stop, clock_s=clock_s)
        visit = Visit(options, watch, err, stop, clock_s)
        start_s = clock_s()
        lost = None
        with watch.link:
            refuse_emulated(known, watch.link.kind, options.force)
            try:
                visit.watch()
            except LinkLostError as error:
                lost = error
            watched = watch.watched()
            examined = examine(watched, math.nan if watch.link.kind == "replay" else time.time())
            mountings: dict[str, Mounting] = {}
            if lost is None and not stop.is_set():
                try:
                    mountings = visit.press(examined)
                except LinkLostError as error:
                    lost = error
        if lost is not None:
            examined.findings.append(Finding("link", "wrong", f"lost: {lost}", "", "check plug and cable"))
        kept = unwritten = None
        replaced = options.out is not None and options.out.exists()
        if options.out is not None and lost is None and visit.watched:
            try:
                kept = keep(
                    options.out,
                    watch.known,
                    watched.facts.port,
                    {name: one for name, one in examined.baselines.items() if name not in examined.loaded},
                    mountings,
                    visit.newtons,
                    emulated="emulated" in (watch.link.kind, watch.link.origin),
                )
            except SensorFileError as error:
                unwritten = error
        stopped_s = clock_s() - start_s if stop.is_set() else None
        _tell(options, watch, stopped_s, examined.findings, kept, out, replaced=replaced)
        if lost is not None:
            raise lost
        if unwritten is not None:
            raise unwritten
        if stop.is_set():
            if options.out is not None and kept is None:
                print(f"{options.out}: not written, because the free pad was not measured to the end", file=err)
            return EXIT_STOPPED
    return EXIT_WRONG if visit.unfinished or worst(examined.findings) == "wrong" else 0


def _tell(
    options: argparse.Namespace,
    watch: Watch,
    stopped_s: float | None,
    findings: list[Finding],
    kept: SensorFile | None,
    out: TextIO,
    *,
    replaced: bool,
) -> None:
    link = watch.link
    if options.json:
        document = {
            "source": link.name,
            "kind": link.kind,
            "id_map": watch.known.model,
            "duration_s": round(watch.duration_s, 3),
            "stopped": stopped_s is not None,
            "verdict": worst(findings),
            "findings": [finding.document() for finding in findings],
            "sensor_file": None if kept is None else str(options.out),
        }
        print(json.dumps(document, indent=1), file=out)
        return
    emulated = "" if link.kind == "device" else f" ({link.kind.upper()})"
    print(f"{link.name}{emulated}", file=out)
    print(page(findings, columns()), file=out)
    if kept is not None:
        print(f"kept in {options.out}", file=out)
        if replaced:
            print(f"the former file is now {options.out}{BACKUP_SUFFIX}", file=out)
    early = "" if stopped_s is None else f"stopped after {stopped_s:.0f} s: "
    print(*wrapped(early + summary(findings), columns()), sep="\n", file=out)

"""`edge-sr convert`: an .mcap as arrays or as CSV, with what was recorded of it; nothing is computed."""

import argparse
import shutil
import signal
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final, TextIO

from edge.errors import SinkError, UsageError
from edge.perception.record_fields import FIELDS, Out
from edge.pipeline.sink import check_new
from edge.sinks.converted_files import write_csv, write_npz
from edge.terminal.stop_signals import handled
from firmware_bridge.errors import as_typed
from firmware_bridge.in_place import write_in_place
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.recording.npz_recording import read_npz
from firmware_bridge.recording.tracks import Recording, Track

_NOT_IN_NPZ: Final = [
    field.name for field in FIELDS if Out.RECORD in field.out and Out.NPZ not in field.out and field.name != "pose"
]
_WITHOUT: Final = {
    ".npz": f"events, counters, the wall clock, and of each record {', '.join(_NOT_IN_NPZ)}",
    ".csv": "all but counts, times and poses: errors of poses, patterns, events, baselines, the mounting",
}
"""Parts of a recording that are not in the new file, by its ending."""


def run(options: argparse.Namespace, out: TextIO, err: TextIO) -> None:
    """Write a recording in the format that the new name ends in, as CSV a file for each sensor."""
    source, target = Path(options.recording), Path(options.new)
    ending = target.suffix.lower()
    if source.suffix.lower() in {".npz", ".csv"}:
        made = as_typed(f"mcap:{source.with_suffix('.mcap')}")
        raise UsageError(f"{source} is no .mcap: edge-sr replay {as_typed(source)} --sink {made} makes one")
    if ending not in _WITHOUT:
        raise UsageError(f"{target}: expected a name that ends in .npz or .csv")
    check_new(target)
    recording = load_recording(source)
    for note in recording.notes:
        err.write(f"edge-sr: {note}\n")
    files = _files(target, recording.tracks)
    for path in files:
        check_new(path)
    for path, tracks in files.items():
        written = _write(recording, path, tracks)
        names = ", ".join(track.sensor for track in tracks)
        emulated = ", EMULATED" if recording.origin == "emulated" else ""
        out.write(f"{path}: {written} scans of sensor {names}, {path.stat().st_size / 1e6:.2f} MB{emulated}\n")
        left_out = sum(len(track.counts) for track in tracks) - written
        if left_out:
            out.write(f"{left_out} scans are left out: a taxel gave no reading, for which a CSV has no cell\n")
    out.write(f"not in it: {_WITHOUT[ending]}\n")


def _files(target: Path, tracks: Sequence[Track]) -> Mapping[Path, Sequence[Track]]:
    """Return the files to write, and the sensors that each of them holds."""
    if target.suffix.lower() == ".npz" or len(tracks) == 1:
        return {target: tracks}
    parts = [track.sensor.replace("/", "-") for track in tracks]
    if len(set(parts)) < len(parts):
        parts = [str(number) for number in range(1, len(parts) + 1)]
    return {target.with_stem(f"{target.stem}-{part}"): [track] for part, track in zip(parts, tracks, strict=True)}


def _write(recording: Recording, path: Path, tracks: Sequence[Track]) -> int:
    """Write one file, read it back before it gets its name, and return how many scans are in it."""
    read: list[int] = []
    drafts: list[Path] = []

    def end(number: int, frame: object) -> None:
        """Remove the draft, and end; an exception might be lost in a callback, such as one of an import."""
        for draft in drafts:
            shutil.rmtree(draft.parent, ignore_errors=True)
        signal.signal(number, signal.SIG_DFL)
        signal.raise_signal(number)

    def write(draft: Path) -> None:
        drafts.append(draft)
        if path.suffix.lower() == ".npz":
            write_npz(draft, recording)
        else:
            write_csv(draft, recording, tracks[0])

    def load(draft: Path) -> None:
        if path.suffix.lower() == ".npz":
            read.append(len(read_npz(draft, ["time_ns"], 1 << 33)["time_ns"]))
        else:
            read.append(len(load_recording(draft).tracks[0].counts))

    try:
        with handled(("SIGINT", "SIGTERM", "SIGHUP"), end):
            write_in_place(path, write, load, keep_before=False)
    except OSError as error:
        raise SinkError(f"cannot write {path}: {error.strerror or error}") from error
    return read[0]

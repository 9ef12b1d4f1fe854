"""Recordings of scans, read from disk: MCAP files, CSV rows, or arrays in an npz."""

from dataclasses import replace
from pathlib import Path

from firmware_bridge.errors import NpzError, RecordingError
from firmware_bridge.recording.tracks import Recording


def load_recording(path: str | Path) -> Recording:
    """Read a recording in the format of its name's ending, or raise a RecordingError."""
    path = Path(path)
    if path.is_dir():
        there = sorted(file.name for file in path.glob("*") if file.suffix in (".mcap", ".npz", ".csv"))[:5]
        held = f"name a recording in it: {', '.join(there)}" if there else "it holds no .mcap, .npz or .csv"
        raise RecordingError(f"{path} is a folder, expected a recording: {held}")
    # Each reader is imported where it is needed: that of MCAP loads a package.
    match path.suffix.lower():
        case ".csv":
            from firmware_bridge.recording.csv_reader import load_csv as reader
        case ".npz":
            from firmware_bridge.recording.npz_recording import load_npz as reader
        case ".mcap":
            from firmware_bridge.recording.mcap_reader import load_mcap as reader
        case _:
            raise RecordingError(f"{path}: a recording ends in .csv, .npz or .mcap")
    try:
        recording = reader(path)
    except NpzError as error:
        raise RecordingError(f"{path}: {error}") from error
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror or error}") from error
    if recording.origin != "emulated":
        return recording
    return replace(recording, notes=(*recording.notes, f"{path} was recorded from an emulated sensor"))

"""Helpers of the bridge's tests: recordings, reading a link to its end, and a dead adapter."""

import csv
import os
import select
import struct
import time
import tty
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from firmware_bridge.can.slcan import STAMPED_BYTES, CanFrame, SlcanDecoder, encode_frame
from firmware_bridge.emulation.slcan_emulator import scan_frames
from firmware_bridge.errors import LinkLostError
from firmware_bridge.links.base import Link
from firmware_bridge.recording.csv_reader import csv_header
from firmware_bridge.recording.tracks import Recording, Track
from firmware_bridge.scans.can_id_maps import USPA44_MAP
from firmware_bridge.scans.scan import Scan

REAL_RECORDINGS = Path(
    os.environ.get("TACTILE_RECORDINGS", Path(__file__).parents[3] / "shared" / "recordings" / "imanlab")
)
REST_COUNTS = np.array([16_000, 16_400, 38_600])[:, None, None] + np.arange(16).reshape(4, 4) * 90


def make_counts(scans: int, seed: int = 0) -> np.ndarray:
    """Return counts of scans that all differ in every taxel, (scans, 3, 4, 4)."""
    noise = np.random.default_rng(seed).integers(0, 30, (scans, 3, 4, 4))
    return (REST_COUNTS + noise + 40 * (np.arange(scans) % 2)[:, None, None, None]).astype(np.int32)


def frames_of(scans: int, controller: int = 4, seed: int = 0) -> list[CanFrame]:
    return [frame for counts in make_counts(scans, seed) for frame in scan_frames(counts, controller)]


def cycle_lines(number: int, stamp_ms: int | None = None) -> list[bytes]:
    """Return the slcan lines of one scan; of stamped ones every eighth frame has the next millisecond."""
    lines: list[bytes] = []
    for place, (can_id, taxel) in enumerate(USPA44_MAP.wire_order("4")):
        data = bytes([9, 1, number % 256, 2, number % 256, taxel, 3, 9])
        stamped_ms = None if stamp_ms is None else (stamp_ms + place // 8) % 60_000
        lines.append(encode_frame(CanFrame(can_id, data, timestamp_ms=stamped_ms)))
    return lines


def decoded(decoder: SlcanDecoder, data: bytes) -> list[CanFrame]:
    frames: list[CanFrame] = []
    for piece in decoder.cut(data):
        if isinstance(piece, CanFrame):
            frames.append(piece)
            continue
        layout = ">H8sH" if piece.frame_bytes == STAMPED_BYTES else ">H8s"
        for id_and_length, payload, *stamp in struct.iter_unpack(layout, piece.data):
            frames.append(CanFrame(id_and_length >> 4, payload, timestamp_ms=stamp[0] if stamp else None))
    return frames


def make_recording(scans: int, rate_hz: float = 100.0, seed: int = 0) -> Recording:
    return Recording(Path("made.csv"), (Track("4", make_counts(scans, seed), None),), rate_hz)


def write_recording(path: Path, counts: np.ndarray, rate_hz: float | None = None) -> Path:
    """Write a recording as a CSV file, with its rate in a file next to it."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(csv_header())
        writer.writerows([f"{value}.0" for value in scan.reshape(3, 16).T.ravel()] for scan in counts)
    if rate_hz is not None:
        path.with_name("meta_data.csv").write_text(f"frequency_hz\n{rate_hz}\n")
    return path


def write_npz(path: Path, counts: np.ndarray, /, time_ns: Any = None, sensors: Any = None, **more: Any) -> Path:
    """Write a recording for numpy, by default of one sensor, at 100 Hz; an array of `more` that is None is left out."""
    scan = np.arange(len(counts))
    arrays: dict[str, Any] = {
        "format": "tactile-recording",
        "version": 1,
        "sensor": np.array(["4"] * len(counts) if sensors is None else sensors),
        "scan": scan,
        "time_ns": np.array(scan * 10_000_000 if time_ns is None else time_ns),
        "counts": counts,
    }
    np.savez(path, **{name: array for name, array in (arrays | more).items() if array is not None})
    return path


def wait_for(condition, within_s=60.0):
    end_s = time.monotonic() + within_s
    while not (value := condition()):
        assert time.monotonic() < end_s, "it did not come"
        time.sleep(0.005)
    return value


def read_until_lost(link: Link) -> list[Scan]:
    scans: list[Scan] = []
    with suppress(LinkLostError):
        wait_for(lambda: link.ended or scans.extend(link.read(0.05)))
    return scans


def read_scans(link: Link, count: int) -> list[Scan]:
    """Return the first scans, at least `count`."""
    scans: list[Scan] = []
    wait_for(lambda: len(scans) >= count or scans.extend(link.read(0.05)))
    return scans


def stacked(scans: list[Scan], sensor: str = "4") -> np.ndarray:
    """Return the counts of one sensor's scans, (n, 3, 4, 4)."""
    return np.stack([scan.counts for scan in scans if scan.sensor == sensor])


class SilentDevice:
    """Far end of a pseudo-terminal that takes nothing: a dead adapter, its cable in."""

    def __enter__(self):
        self.device_fd, self.client_fd = os.openpty()
        tty.setraw(self.client_fd)
        self.port = os.ttyname(self.client_fd)
        return self

    def received(self, count: int, within_s: float = 5) -> bytes:
        """Return the first bytes that came, and any that came with them."""
        data = b""
        while len(data) < count and select.select([self.device_fd], [], [], within_s)[0]:
            data += os.read(self.device_fd, 1000)
        return data

    def __exit__(self, *exc_info):
        os.close(self.device_fd)
        os.close(self.client_fd)

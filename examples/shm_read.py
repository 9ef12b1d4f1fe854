"""Act on the newest pattern of a sensor that `edge-sr --sink shm:NAME` writes: shm_read.py NAME SENSOR [--pretend].

`attach` and `latest` are a reader to copy; docs/middleware.md lists the offsets and the other contents. Linux.
"""

import mmap
import sys
import time
import zlib
from pathlib import Path
from struct import unpack_from

import numpy as np

USAGE = "usage: python shm_read.py NAME SENSOR [--pretend]; --pretend acts also on a sensor that is none"
SOURCES = ("unknown", "device", "replay", "emulated")
IN_DOUBT = 6
VERDICTS = {0: "pattern not to be believed", -1: "pattern not checked"}


def attach(name: str) -> memoryview:
    """Open the memory; raises FileNotFoundError while no writer exists."""
    with Path("/dev/shm", name).open("rb") as file:
        memory = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    if memory[:12] != b"TESR-SHM\1\0\0\0":
        raise ValueError(f"{name} is of another program, or of another version")
    return memory


def latest(memory: memoryview, sensor: str, oldest_s: float = 0.05, pretend: bool = False) -> bytes | None:
    """Return the newest whole result of a sensor, or None unless it is recent and from a device (or `pretend`)."""
    half = newest(memory).get(sensor)
    return None if half is None or refusal(half, oldest_s, pretend) else half


def refusal(half: bytes, oldest_s: float = 0.05, pretend: bool = False) -> str | None:
    """Return why nothing may be done by a result; None if it is recent and from a device (or `pretend`)."""
    age_s = (time.monotonic_ns() - unpack_from("<q", half, 16)[0]) / 1e9
    if not 0 <= age_s < oldest_s:
        return f"the newest reading is {age_s:.2f} s old, expected under {oldest_s:g}"
    source, state = unpack_from("<2i", half, 48)
    if state == IN_DOUBT:
        return "its baseline is in doubt: free the pad and zero again"
    if SOURCES[source] == "device" or pretend:
        return None
    return f"its source is {SOURCES[source]}, not a device: --pretend acts on it all the same"


def newest(memory: memoryview) -> dict[str, bytes]:
    """Return the newest whole result of each sensor, whatever its age and source."""
    found = {}
    header_bytes, slots, slot_bytes, half_bytes, first_half_at = unpack_from("<5I", memory, 12)
    sequences = memory.cast("Q")  # unlike struct, this reads eight bytes in one piece
    for slot_at in range(header_bytes, header_bytes + slots * slot_bytes, slot_bytes):
        for _ in range(100):  # again if it was overwritten during the copy
            wanted = sequences[slot_at // 8]
            if wanted == 0:  # no later slot is in use either
                return found
            half_at = slot_at + first_half_at + (wanted & 1) * half_bytes
            half = bytes(memory[half_at : half_at + half_bytes])
            checksum, _, sequence = unpack_from("<IIQ", half)
            if sequence == wanted and checksum == zlib.crc32(memoryview(half)[8:]):
                found[half[184:440].rstrip(b"\0").decode()] = half
                break
    return found


def described(memory: memoryview, half: bytes) -> str:
    """Return the force of a result in words, and the depth if its pattern is to be believed."""
    height, width, _, _, pattern_at = unpack_from("<5I", memory, 40)
    pattern = np.frombuffer(half, "<f4", height * width, pattern_at).reshape(height, width)  # NaN without one
    (trusted,) = unpack_from("<i", half, 592)
    depth = VERDICTS.get(trusted, f"{pattern.max():.3f} mm at most")
    return f"{unpack_from('<d', half, 104)[0]:.0f} counts, {depth}"


def main(name: str, sensor: str, pretend: bool) -> None:
    """Print ten lines a second while the memory exists, attaching each time, because a writer may restart."""
    while True:
        memory = attach(name)
        results = newest(memory)
        half = results.get(sensor)
        if half is None:
            why = f"no sensor {sensor}, but {', '.join(results)}" if results else "no scan came yet"
        else:
            why = refusal(half, pretend=pretend)
        print(f"nothing to act on: {why}" if half is None or why else described(memory, half), flush=True)
        time.sleep(0.1)


if __name__ == "__main__":
    if len(sys.argv) < 3 or sys.argv[3:] not in ([], ["--pretend"]):
        sys.exit(USAGE)
    try:
        main(sys.argv[1], sys.argv[2], pretend=len(sys.argv) == 4)
    except (OSError, ValueError) as error:
        sys.exit(f"{error}: expected what edge-sr --sink shm:{sys.argv[1]} writes")

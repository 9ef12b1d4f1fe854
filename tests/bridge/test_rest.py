import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from bridge_samples import REST_COUNTS

from edge.pipeline.scan_reader import Source
from firmware_bridge.can.slcan import CanFrame, encode_frame
from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.links.base import Pace
from firmware_bridge.links.reconnecting import LastingLink
from firmware_bridge.links.slcan_serial import SlcanSerialLink
from firmware_bridge.recording.tracks import Recording, Track
from firmware_bridge.scans.can_id_maps import USPA44_MAP
from firmware_bridge.scans.scan import Scan
from firmware_bridge.scans.stillness import STILL_COUNTS, Stillness

ORDER = USPA44_MAP.wire_order("4")
SCANS, PRESSED = 140, 100
LINE_BYTES = {False: 22, True: 26}


def lines(counts, *, stamped, rng, ids=tuple(can_id for can_id, _ in ORDER)):
    """The text of one scan of (16, 3) counts; bytes that mean nothing, and stamps, are random."""
    text = b""
    for can_id, xyz in zip(ids, counts, strict=True):
        noise = rng.bytes(2)
        data = noise[:1] + b"".join(int(value).to_bytes(2) for value in xyz) + noise[1:]
        text += encode_frame(CanFrame(can_id, data, timestamp_ms=int(rng.integers(60_000)) if stamped else None))
    return text


@pytest.mark.parametrize("stamped", [False, True])
def test_no_reading_moves_unseen_by_more_than_noise(stamped):
    rng = np.random.default_rng(0)
    size = LINE_BYTES[stamped]
    for rest in (np.full((16, 3), 65_535), np.zeros((16, 3), dtype=int), rng.integers(0, 65_536, (16, 3))):
        stillness = Stillness()
        stillness.learn(lines(rest, stamped=stamped, rng=rng), size)
        for change in (0, STILL_COUNTS - 1, STILL_COUNTS, 2 * STILL_COUNTS, 256, 4096, 65_535):
            for sign in (-1, 1):
                for taxel, axis in [*np.ndindex(16, 3)]:
                    counts = rest.copy()
                    counts[taxel, axis] += sign * change
                    if 0 <= counts[taxel, axis] <= 65_535:
                        text = lines(counts, stamped=stamped, rng=rng)
                        assert stillness.holds(text, size) == (change < STILL_COUNTS or (change, sign) == (16, -1))


def test_what_is_not_readings_of_a_known_sensor_is_not_still():
    rng = np.random.default_rng(1)
    rest = np.full((16, 3), 30_000)
    text, moved = (lines(rest + more, stamped=True, rng=rng) for more in (0, 100))
    other = lines(rest, stamped=True, rng=rng, ids=[can_id + 1 for can_id, _ in ORDER])
    stillness = Stillness()
    assert not stillness.holds(text, 26)
    stillness.learn(text, 26)
    assert stillness.holds(text + text, 26)
    damaged = [b"", b"t", text[1:], text.replace(b"8", b"x"), text + b"F00\r", text + b"123812345678\r"]
    for data in (*damaged, lines(rest, stamped=False, rng=rng), other, text + other, text + moved, moved):
        stillness.learn(text, 26)
        assert not stillness.holds(data, 26), data


def test_a_read_may_end_within_a_line_of_mixed_sensors():
    rng = np.random.default_rng(3)
    ids = [can_id + more for can_id, _ in ORDER for more in (0, 2)]
    rest = rng.integers(0, 65_536, (32, 3))
    text = lines(rest[:16], stamped=True, rng=rng, ids=ids[:16])
    text += lines(rest[16:], stamped=True, rng=rng, ids=ids[16:])
    stillness = Stillness()
    stillness.learn(text + text[:300], 26)
    pieces = (text * 3)[300:]
    assert all(stillness.holds(pieces[start : start + 410], 26) for start in range(0, len(pieces), 410))
    pressed = rest.copy()
    pressed[20, 2] += 40 if pressed[20, 2] < 60_000 else -40
    press = lines(pressed[16:], stamped=True, rng=rng, ids=ids[16:])
    held = [stillness.holds(press[start : start + 30], 26) for start in range(0, len(press), 30)]
    assert held == [True] * 4 + [False] + [True] * 9


@pytest.mark.parametrize(
    ("links", "pace", "restless"),
    [
        (1, Pace(still_s=0.1), ""),
        (2, Pace(still_s=0.1, together_s=0.003), ""),
        (2, Pace(still_s=0.1), "f0/4"),
    ],
)
def test_scans_at_rest_come_together_and_a_press_is_not_late(links, pace, restless):
    """The press is in the newest scan of what comes with it; a link at rest does not wake up for another."""
    rng = np.random.default_rng(2)
    counts = (REST_COUNTS + rng.integers(-3, 4, (SCANS, 3, 4, 4))).astype(np.int32)
    counts[PRESSED:, 2] += 3000
    recording = Recording(Path("made.csv"), (Track("4", counts, None),), 100.0)
    with ExitStack() as closing:
        emulators = [closing.enter_context(Emulator([recording], waits=True)) for _ in range(links)]
        named = enumerate(emulators)
        source = Source(*(LastingLink(SlcanSerialLink(emulator.port), name=f"f{index}") for index, emulator in named))
        closing.enter_context(source)
        source.set_pace(pace, [restless] if restless else [])
        taken: list[list[Scan]] = []
        end_s = time.monotonic() + 30
        while sum(map(len, taken)) < SCANS * links and time.monotonic() < end_s:
            taken.append([one for one in source.take(0.1) or () if isinstance(one, Scan)])
    for index in range(links):
        mine = [[scan for scan in together if scan.sensor == f"f{index}/4"] for together in taken]
        scans = [scan for together in mine for scan in together]
        assert [scan.number for scan in scans] == list(range(SCANS))
        assert (np.stack([scan.counts for scan in scans]) == counts).all()
        if f"f{index}/4" == restless:
            assert np.median([len(together) for together in mine if together]) <= 2
            continue
        assert max(len(together) for together in mine) >= 5
        (first,) = (together for together in mine if any(scan.number == PRESSED for scan in together))
        assert len({scan.time_ns for scan in first if scan.number >= PRESSED}) == 1
